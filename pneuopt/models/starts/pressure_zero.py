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

from pneuopt.dynamics.hooks import Log
from pneuopt.models.starts.following import PRESSURE_NAMES
from pneuopt.models.starts.friction import filter_channel
from pneuopt.models.starts.pneumatic import VALVE_SHAPE_GRID, PneumaticLog
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.units import ATMOSPHERE

PrepareLogs = Callable[[Mapping[str, Log]], Mapping[str, PneumaticLog]]
MIN_RESIDUAL_RATIO = (
    1.5  # times smaller residuals make another zero point the better one (tests/models/test_pressure_zero.py)
)
MAX_UNQUESTIONED_SHARE = (
    0.02  # the same: what a right zero point may leave unquestioned (a wrong one leaves 0.03 or more)
)
MAX_RESIDUAL_SHARE = 0.2  # of a pressure's squared rates: what a zero point that is believed leaves at most
MIN_LOG_DURATION = 1.0  # [s] of a log that is judged on its own
MAX_SAMPLES_PER_LOG = 2000  # samples of a log that are looked at
SUPPLY_PRESSURE = "supply.pressure"
ATMOSPHERE_ADDED, ATMOSPHERE_TAKEN_OFF = f"{ATMOSPHERE / 1e5:.3f} bar added", f"{ATMOSPHERE / 1e5:.3f} bar taken off"


class ZeroShift(NamedTuple):
    """What is added to the logged pressures and to the supply's [atmospheres], and what that would mean."""

    sensors: int
    supply: int
    advice: str = ""


ZERO_SHIFTS = (
    ZeroShift(0, 0),
    ZeroShift(1, 0, f"{ATMOSPHERE_ADDED}: is it a gauge sensor? Then write its unit as bar(g)"),
    ZeroShift(-1, 0, f"{ATMOSPHERE_TAKEN_OFF}: is an absolute sensor read as bar(g)? Then write its unit as bar(a)"),
    ZeroShift(
        0, 1, f"{ATMOSPHERE_ADDED} to {SUPPLY_PRESSURE}: is that too low, or a gauge pressure? Then write it in bar(g)"
    ),
)


@dataclass(frozen=True, eq=False)
class PressureZeroCheck:
    """The doubter of a pneumatic drive, for logs with pressures, motion and command.

    Parameters
    ----------
    prepare : callable
        From logs to what the start finder makes of them.
    """

    prepare: PrepareLogs

    def __call__(self, logs: Mapping[str, Log]) -> Sequence[str]:
        """Return a sentence for each pressure whose chamber's equation holds better from another zero point."""
        telling = {name: _most_active_part(log) for name, log in logs.items() if _is_informative(log)}
        left = self._doubtful_residuals(telling) if telling else {}
        together = left.values() if len(left) == len(telling) else ()
        told = list(_warning_sentences("".join(logs) if len(logs) == 1 else "", together))
        long = [] if told else [name for name in left if float(np.ptp(telling[name].measured.t)) >= MIN_LOG_DURATION]
        return told + [sentence for name in long for sentence in _warning_sentences(name, [left[name]])]

    def _doubtful_residuals(self, logs: Mapping[str, Log]) -> dict[str, dict[str, Array]]:
        """By doubtful log and logged pressure: its rates' squares, and what of them each shift leaves [Pa^2/s^2]."""
        spread = {
            name: {n: _rate_sum_of_squares(log, n) for n in _pressure_channels(log)} for name, log in logs.items()
        }
        found = [self._shift_residuals(logs, ZERO_SHIFTS[0])]
        doubtful = {
            name: log
            for name, log in logs.items()
            if any(left > MAX_UNQUESTIONED_SHARE * spread[name][n] for n, left in found[0][name].items())
        }
        found += [self._shift_residuals(doubtful, remedy) for remedy in ZERO_SHIFTS[1:]] if doubtful else []
        return {
            name: {n: np.array([spread[name][n], *(each[name][n] for each in found)]) for n in spread[name]}
            for name in doubtful
        }

    def _shift_residuals(self, logs: Mapping[str, Log], remedy: ZeroShift) -> dict[str, dict[str, float]]:
        """What a shift of the zero points leaves of each log's pressure rates [Pa^2/s^2]."""
        left: dict[str, dict[str, float]] = {}
        for name, run in self.prepare({n: _shift_zero(log, remedy) for n, log in logs.items()}).items():
            parts = [run.valve_columns(shape) for shape in _valve_shapes(logs[name])]
            left[name] = {
                n: min(_regression_residual(columns[:, k], wanted[:, k]) for columns, wanted in parts)
                if run.known_states[n].min() > 0
                else math.inf
                for k, n in enumerate(run.logged_pressures)
            }
        return left


def _is_informative(log: Log) -> bool:
    """Whether it holds motion and a pressure, and the supply is known: the ratio to a guess says nothing."""
    known = SUPPLY_PRESSURE not in log.parameters.free_names
    return known and any(n in log.measured for n in ("position", "speed")) and bool(_pressure_channels(log))


def _most_active_part(log: Log) -> Log:
    """The part of a long log in which the pressures change most: enough to tell, for less than a fit's step costs."""
    data = log.measured
    if len(data) <= MAX_SAMPLES_PER_LOG:
        return log
    path = np.sum(
        [np.abs(filter_channel(data, n, 1)) / float(np.nanmean(data[n])) for n in _pressure_channels(log)], axis=0
    )
    within = np.convolve(path, np.ones(MAX_SAMPLES_PER_LOG), "valid")
    first = int(np.argmax(within))
    return log._replace(measured=data.rows(first, first + MAX_SAMPLES_PER_LOG))


def _pressure_channels(log: Log) -> list[str]:
    return [n for n in PRESSURE_NAMES if n in log.measured]


def _rate_sum_of_squares(log: Log, name: str) -> float:
    """Of a pressure's rates, squared."""
    rates = filter_channel(log.measured, name, 1)
    return float(np.sum((rates - rates.mean()) ** 2))


def _shift_zero(log: Log, remedy: ZeroShift) -> Log:
    """The log with other zero points, so many atmospheres away."""
    measured, p = log
    measured = measured.with_columns({n: measured[n] + remedy.sensors * ATMOSPHERE for n in _pressure_channels(log)})
    moved = {SUPPLY_PRESSURE: p.value(SUPPLY_PRESSURE) + remedy.supply * ATMOSPHERE}
    return Log(measured, p.with_bounds(dict.fromkeys(moved, (0.0, math.inf))).with_values(moved))


def _valve_shapes(log: Log) -> Iterator[dict[str, float]]:
    """The valve's other values, tried where they are free."""
    free = [n for n in VALVE_SHAPE_GRID if n in log.parameters.free_names]
    for values in itertools.product(*(VALVE_SHAPE_GRID[n] for n in free)):
        yield dict(zip(free, values, strict=True))


def _regression_residual(columns: Array, wanted: Array) -> float:
    """What a regression leaves; infinite where a hypothesis has left the numbers' range."""
    if not np.isfinite(columns).all() or not np.isfinite(wanted).all():
        return math.inf
    return float(np.sum((wanted - columns @ np.linalg.lstsq(columns, wanted, rcond=None)[0]) ** 2))


def _warning_sentences(name: str, logs: Collection[Mapping[str, Array]]) -> Iterator[str]:
    """One for each pressure with a better zero point in these logs together."""
    for channel in PRESSURE_NAMES:
        rows = [left[channel] for left in logs if channel in left]
        total, given, *shifted = np.sum(rows, axis=0) if rows else np.zeros(1 + len(ZERO_SHIFTS))
        best = int(np.argmin(shifted))
        if 0 < shifted[best] < min(given / MIN_RESIDUAL_RATIO**2, MAX_RESIDUAL_SHARE * total):
            better = f"leaves {math.sqrt(given / shifted[best]):.1f} times smaller residuals"
            where = f"{channel} of {name}" if name else channel
            yield f"{where}: its chamber's mass balance {better} with {ZERO_SHIFTS[1 + best].advice}"
