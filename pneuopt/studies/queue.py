"""`CaseQueue`: which cases are computed next, how many in one go, and which of them again."""

import math
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from pneuopt.studies.outcome import CaseValues, Outcome

CHUNK_SECONDS = 0.5
"""Time that a chunk of cases shall take [s]: longer chunks lose more where a process dies, shorter ones cost more to
send."""
MAX_CHUNK = 1000
"""Cases in a chunk [1]: more hold up the table, and fill the memory where each is large."""
_TRIES = 2  # runs of a case whose process dies [1]: a second one tells a case that kills from a machine that went away


@dataclass(frozen=True)
class Chunk:
    """Cases that one process computes in one go, by name; and how often they were tried before."""

    cases: Mapping[str, CaseValues]
    tries: int = 0


class CaseQueue:
    """Hands cases out in chunks of about half a second.

    Parameters
    ----------
    cases : iterable of str and mapping or ParameterSet
        Read as they are needed.
    count : int
        How many there are.
    workers : int
        Processes or threads that share them.
    most_seconds : float
        That a chunk may take, which a limit of time may lower.
    """

    def __init__(
        self, cases: Iterable[tuple[str, CaseValues]], count: int, workers: int, most_seconds: float = math.inf
    ) -> None:
        self._fresh, self._again, self._suspect = iter(cases), deque[Chunk](), deque[Chunk]()
        self._left, self._workers, self._seconds = count, workers, min(CHUNK_SECONDS, most_seconds)
        self._done, self._spent = 0, 0.0

    def __bool__(self) -> bool:
        return self._left > 0 or bool(self._again or self._suspect)

    def take(self, *, alone: bool = True) -> Chunk | None:
        """The next chunk; None where there is none.

        Last come cases whose process has died, but only if nothing else is computed beside: a worker of a cluster takes
        along what waits for it.
        """
        if self._again:
            return self._again.popleft()
        cases = dict(next(self._fresh) for _ in range(min(self._size(), self._left)))
        self._left -= len(cases)
        if cases:
            return Chunk(cases)
        return self._suspect.popleft() if alone and self._suspect else None

    def measure(self, outcomes: Sequence[Outcome]) -> None:
        """Learn from a chunk how long cases take."""
        self._done += len(outcomes)
        self._spent += sum(o.seconds for o in outcomes if o.seconds > 0)

    def give_back(self, chunk: Chunk, reason: str) -> Iterator[tuple[str, Outcome]]:
        """Take back a chunk whose process died: its cases are tried one by one; one that dies twice is said."""
        if len(chunk.cases) > 1:
            self._again.extend(Chunk({name: values}) for name, values in chunk.cases.items())
        elif chunk.tries + 1 < _TRIES:
            self._suspect.append(Chunk(chunk.cases, chunk.tries + 1))
        else:
            for name in chunk.cases:
                yield name, Outcome(error=reason)

    def separate(self, chunk: Chunk, reason: str) -> Iterator[tuple[str, Outcome]]:
        """Take back a chunk that took too long: a case alone is said, several are tried one by one."""
        yield from self.give_back(Chunk(chunk.cases, _TRIES), reason)

    def _size(self) -> int:
        if not self._done:
            return 1
        by_time = self._seconds * self._done / max(self._spent, 1e-9)
        return max(1, math.ceil(min(by_time, MAX_CHUNK, self._left / (2 * self._workers))))
