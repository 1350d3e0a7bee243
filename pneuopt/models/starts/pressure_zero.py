"""Whether a log's pressures count from vacuum: what the air in a chamber tells of their zero point.

Boyle's law: a moving piston changes a pressure in proportion to the absolute one, and the valve's flow depends on the
ratio of absolute pressures. A gauge pressure read as absolute misses that, whatever the valve's conductance and leak.
Sensors and supply all an atmosphere off keep nearly every ratio; a wrong exponent looks the same: that is not told.
"""

import itertools
import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pneuopt.dynamics.hooks import Log
from pneuopt.models.starts.following import PRESSURES
from pneuopt.models.starts.friction import filtered
from pneuopt.models.starts.pneumatic import SHAPES, Run
from pneuopt.quantities.units import ATMOSPHERE

Array = NDArray[np.float64]
Runs = Callable[[Mapping[str, Log]], Mapping[str, Run]]
BETTER = 1.5  # times smaller residuals make another zero point the better one (tests/models/test_pressure_zero.py)
BELIEVED = 0.02  # the same: what a right zero point may leave unquestioned (a wrong one leaves 0.03 or more)
EXPLAINED = 0.2  # of a pressure's squared rates: what a zero point that is believed leaves at most
LONG = 1.0  # [s] of a log that is judged on its own
MOST = 2000  # samples of a log that are looked at
SUPPLY = "supply.pressure"
ADDED, LESS = f"{ATMOSPHERE / 1e5:.3f} bar added", f"{ATMOSPHERE / 1e5:.3f} bar taken off"


class Remedy(NamedTuple):
    """What is added to the logged pressures and to the supply's [atmospheres], and what that would mean."""

    sensors: int
    supply: int
    told: str = ""


REMEDIES = (
    Remedy(0, 0),
    Remedy(1, 0, f"{ADDED}: is it a gauge sensor? Then write its unit as bar(g)"),
    Remedy(-1, 0, f"{LESS}: is an absolute sensor read as bar(g)? Then write its unit as bar(a)"),
    Remedy(0, 1, f"{ADDED} to {SUPPLY}: is that too low, or a gauge pressure? Then write it in bar(g)"),
)


@dataclass(frozen=True, eq=False)
class PressureZeros:
    """The doubter of a pneumatic drive, for logs with pressures, motion and command.

    Parameters
    ----------
    runs : callable
        From logs to what the start finder makes of them.
    """

    runs: Runs

    def __call__(self, logs: Mapping[str, Log]) -> Sequence[str]:
        """Return a sentence for each pressure whose chamber's equation holds better from another zero point."""
        telling = {name: _liveliest(log) for name, log in logs.items() if _tells(log)}
        left = self._left(telling) if telling else {}
        together = left.values() if len(left) == len(telling) else ()
        told = list(_sentences("".join(logs) if len(logs) == 1 else "", together))
        long = [] if told else [name for name in left if float(np.ptp(telling[name].measured.t)) >= LONG]
        return told + [sentence for name in long for sentence in _sentences(name, [left[name]])]

    def _left(self, logs: Mapping[str, Log]) -> dict[str, dict[str, Array]]:
        """By doubtful log and logged pressure: its rates' squares, and what of them each shift leaves [Pa^2/s^2]."""
        spread = {name: {n: _spread(log, n) for n in _logged(log)} for name, log in logs.items()}
        found = [self._squares(logs, REMEDIES[0])]
        doubtful = {
            name: log
            for name, log in logs.items()
            if any(left > BELIEVED * spread[name][n] for n, left in found[0][name].items())
        }
        found += [self._squares(doubtful, remedy) for remedy in REMEDIES[1:]] if doubtful else []
        return {
            name: {n: np.array([spread[name][n], *(each[name][n] for each in found)]) for n in spread[name]}
            for name in doubtful
        }

    def _squares(self, logs: Mapping[str, Log], remedy: Remedy) -> dict[str, dict[str, float]]:
        """What a shift of the zero points leaves of each log's pressure rates [Pa^2/s^2]."""
        left: dict[str, dict[str, float]] = {}
        for name, run in self.runs({n: _moved(log, remedy) for n, log in logs.items()}).items():
            parts = [run.valve_columns(shape) for shape in _shapes(logs[name])]
            left[name] = {
                n: min(_squares(columns[:, k], wanted[:, k]) for columns, wanted in parts)
                if run.led[n].min() > 0
                else math.inf
                for k, n in enumerate(run.logged)
            }
        return left


def _tells(log: Log) -> bool:
    """Whether it holds motion and a pressure, and the supply is known: the ratio to a guess says nothing."""
    known = SUPPLY not in log.parameters.free_names
    return known and any(n in log.measured for n in ("position", "speed")) and bool(_logged(log))


def _liveliest(log: Log) -> Log:
    """The part of a long log in which the pressures change most: enough to tell, for less than a fit's step costs."""
    data = log.measured
    if len(data) <= MOST:
        return log
    path = np.sum([np.abs(filtered(data, n, 1)) / float(np.nanmean(data[n])) for n in _logged(log)], axis=0)
    within = np.convolve(path, np.ones(MOST), "valid")
    first = int(np.argmax(within))
    return log._replace(measured=data.rows(first, first + MOST))


def _logged(log: Log) -> list[str]:
    return [n for n in PRESSURES if n in log.measured]


def _spread(log: Log, name: str) -> float:
    """Of a pressure's rates, squared."""
    rates = filtered(log.measured, name, 1)
    return float(np.sum((rates - rates.mean()) ** 2))


def _moved(log: Log, remedy: Remedy) -> Log:
    """The log with other zero points, so many atmospheres away."""
    measured, p = log
    measured = measured.with_columns({n: measured[n] + remedy.sensors * ATMOSPHERE for n in _logged(log)})
    moved = {SUPPLY: p.value(SUPPLY) + remedy.supply * ATMOSPHERE}
    return Log(measured, p.with_bounds(dict.fromkeys(moved, (0.0, math.inf))).with_values(moved))


def _shapes(log: Log) -> Iterator[dict[str, float]]:
    """The valve's other values, tried where they are free."""
    free = [n for n in SHAPES if n in log.parameters.free_names]
    for values in itertools.product(*(SHAPES[n] for n in free)):
        yield dict(zip(free, values, strict=True))


def _squares(columns: Array, wanted: Array) -> float:
    """What a regression leaves; infinite where a hypothesis has left the numbers' range."""
    if not np.isfinite(columns).all() or not np.isfinite(wanted).all():
        return math.inf
    return float(np.sum((wanted - columns @ np.linalg.lstsq(columns, wanted, rcond=None)[0]) ** 2))


def _sentences(name: str, logs: Collection[Mapping[str, Array]]) -> Iterator[str]:
    """One for each pressure with a better zero point in these logs together."""
    for channel in PRESSURES:
        rows = [left[channel] for left in logs if channel in left]
        total, given, *shifted = np.sum(rows, axis=0) if rows else np.zeros(1 + len(REMEDIES))
        best = int(np.argmin(shifted))
        if 0 < shifted[best] < min(given / BETTER**2, EXPLAINED * total):
            better = f"leaves {math.sqrt(given / shifted[best]):.1f} times smaller residuals"
            where = f"{channel} of {name}" if name else channel
            yield f"{where}: its chamber's mass balance {better} with {REMEDIES[1 + best].told}"
