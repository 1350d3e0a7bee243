"""Mutated cases that a reader must take, or refuse by an error of our own in one line, within a limit of time."""

import resource
import signal
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

from pneuopt.quantities.errors import InputError

TIME_LIMIT = 2.0
"""CPU time of a case [s]: a small file that takes longer would hang at its full size."""
MAX_MESSAGE = 1000
"""Length of a message [character]: a longer one shows the file instead of its fault."""


@dataclass
class Report:
    """What came of the cases: counts and the slowest [s] by label, and each failure with its bytes and its sidecar."""

    cases: Counter[str] = field(default_factory=Counter)
    accepted: Counter[str] = field(default_factory=Counter)
    slowest: dict[str, float] = field(default_factory=dict)
    failures: list[tuple[str, str, bytes, str]] = field(default_factory=list)

    def __str__(self) -> str:
        lines = [
            f"{name:70s} {n:7d} cases, {self.accepted[name] / n:4.0%} accepted, slowest {self.slowest[name]:.3f} s"
            for name, n in sorted(self.cases.items())
        ]
        total, accepted = self.cases.total(), self.accepted.total()
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        lines.append(
            f"{total} cases, {accepted / max(total, 1):.1%} accepted, {len(self.failures)} failures, "
            f"slowest {max(self.slowest.values(), default=0.0):.3f} s, peak {peak:.0f} MB"
        )
        return "\n".join(lines)

    def check(self) -> None:
        """Assert that no case failed, and that enough of them were read for this to say something."""
        assert [failure[:2] for failure in self.failures] == [], self.failures[0]
        assert self.accepted.total() > 0.25 * self.cases.total()

    def count(self, label: str, read: Callable[[], str], raw: bytes, side: str = "") -> None:
        """Count a case, which `read` reads and says what is wrong with what it has read, "" if nothing."""
        signal.signal(signal.SIGVTALRM, _stop)
        signal.setitimer(signal.ITIMER_VIRTUAL, 5 * TIME_LIMIT)
        start, fault = time.process_time(), ""
        try:
            fault = read()
            self.accepted[label] += 1
        except InputError as error:
            text = str(error)
            fault = "" if "\n" not in text and len(text) < MAX_MESSAGE else f"message: {text[:200]!r}"
        except BaseException as error:
            fault = f"{type(error).__name__}: {str(error)[:200]}"
        finally:
            signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        spent = time.process_time() - start
        self.cases[label] += 1
        self.slowest[label] = max(spent, self.slowest.get(label, 0.0))
        fault = fault or (f"{spent:.1f} s" if spent > TIME_LIMIT else "")
        if fault:
            self.failures.append((label, fault, raw, side))


def _stop(*_: object) -> None:
    raise TimeoutError("hangs")
