"""Checks of a log's pressures by the mass balance of the chambers: the chambers' or a line's, gauge or absolute.

`LinePressureCheck`: a sensor at the valve reads the chamber's pressure plus what the line drops, which grows with the
flow: it leads the chamber. The flow is the valve's in the mass balance itself, so that a drop is tried by taking it off
the readings, the flow from the corrected pressures again. A sensor's lag has the opposite sign; a valve that is faster
than stated, or a command that is logged late, looks alike.

`PressureZeroCheck`: by Boyle's law a moving piston changes a pressure in proportion to its absolute value, and the
valve's flow depends on the ratio of absolute pressures. A gauge pressure that is read as absolute violates this,
whatever the valve's conductance and leak. If sensors and supply are all off by an atmosphere, nearly every ratio stays
the same; a wrong exponent looks alike, so this case is not detected.
"""

import itertools
import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from pneuopt.dynamics.hooks import Log
from pneuopt.models.pneumatic.cylinder import volumes
from pneuopt.models.pneumatic.starts import PRESSURE_NAMES, PneumaticLog, valve_shapes
from pneuopt.models.starts import filter_channel
from pneuopt.models.tolerances import (
    LEADS,
    MAX_RESIDUAL_SHARE,
    MAX_START_SAMPLES,
    MAX_UNQUESTIONED_SHARE,
    MAX_WORSE_LEADS,
    MIN_LOG_DURATION,
    MIN_RESIDUAL_RATIO,
    PASSES,
)
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import without_prefix
from pneuopt.quantities.units import ATMOSPHERE

PrepareLogs = Callable[[Mapping[str, Log]], Mapping[str, PneumaticLog]]


@dataclass(frozen=True, eq=False)
class LinePressureCheck:
    """Log warning hook of a pneumatic drive; `prepare` is `PneumaticStarts.prepare_logs`."""

    prepare: PrepareLogs

    def __call__(self, logs: Mapping[str, Log]) -> Sequence[str]:
        """Return a sentence for each log whose chambers' equations hold better behind a line's drop."""
        active = {name: most_active_part(log) for name, log in logs.items() if is_informative(log)}
        return [sentence for name, log in active.items() if (sentence := self._examine(name, log))]

    def _examine(self, name: str, log: Log) -> str:
        measured_balance = min(
            (self._balance(log, shape) for shape in trial_shapes(log)), key=lambda balance: balance.residual
        )
        if measured_balance.residual < MAX_UNQUESTIONED_SHARE * measured_balance.total:
            return ""
        lead, best, worse = 0.0, measured_balance, 0
        for tried in LEADS:
            balance = self._behind_line(log, measured_balance, tried)
            lead, best, worse = (tried, balance, 0) if balance.residual < best.residual else (lead, best, worse + 1)
            if worse == MAX_WORSE_LEADS:
                break
        if best.residual > min(measured_balance.residual / MIN_RESIDUAL_RATIO**2, MAX_RESIDUAL_SHARE * best.total):
            return ""
        drop = lead * max(float(np.quantile(np.abs(flow), 0.999)) for flow in best.flows)
        ratio = np.sqrt(measured_balance.residual / best.residual)
        message = f"{name}: the pressures lead the chambers by {1e3 * lead:.2g} ms, as before a line that drops up to "
        message += f"{drop / 1e5:.2g} bar (their mass balance then leaves {ratio:.1f} times smaller residuals)"
        return f"{message}: put the sensors at the cylinder, or leave them out; else raise valve.bandwidth"

    def _behind_line(self, log: Log, uncorrected: "Balance", lead: float) -> "Balance":
        """The balance of the pressures behind a line that leads so much, with its own flow."""
        balance, flows = uncorrected, uncorrected.flows
        for _ in range(PASSES):
            behind = {n: log.measured[n] - lead * flow for n, flow in zip(uncorrected.channels, flows, strict=True)}
            if min(float(np.nanmin(p)) for p in behind.values()) <= 0:
                return uncorrected
            balance = self._balance(log._replace(measured=log.measured.with_columns(behind)), uncorrected.shape)
            flows = [(old + new) / 2 for old, new in zip(flows, balance.flows, strict=True)]
        return balance

    def _balance(self, log: Log, shape: Mapping[str, float]) -> "Balance":
        run = self.prepare({"": log})[""]
        columns, rates = run.valve_columns(shape)
        geometry: Any = without_prefix({n: p.value for n, p in log.parameters.items()}, "cylinder")
        position: Any = run.known_states["position"]
        size: dict[str, Any] = dict(zip(PRESSURE_NAMES, volumes(position, geometry), strict=True))
        residual, flows = 0.0, []
        for k, channel in enumerate(run.logged_pressures):
            model = columns[:, k] @ np.linalg.lstsq(columns[:, k], rates[:, k])[0]
            residual += float(np.sum((rates[:, k] - model) ** 2))
            flows.append(np.asarray(model * size[channel] / float(np.mean(size[channel]))))
        return Balance(shape, run.logged_pressures, residual, float(np.sum(rates**2)), flows)


class Balance(NamedTuple):
    """What the chambers' mass balance leaves of the pressures' rates."""

    shape: Mapping[str, float]  # of the valve
    channels: tuple[str, ...]  # the logged pressures
    residual: float  # squared residuals, summed [Pa^2/s^2]
    total: float  # squared rates, summed [Pa^2/s^2]
    flows: list[Array]  # the valve's flow into each chamber, as the rate of its pressure at its mean volume [Pa/s]


SUPPLY_PRESSURE = "supply.pressure"
ATMOSPHERE_ADDED, ATMOSPHERE_TAKEN_OFF = f"{ATMOSPHERE / 1e5:.3f} bar added", f"{ATMOSPHERE / 1e5:.3f} bar taken off"


class ZeroShift(NamedTuple):
    """Shift of the logged pressures and of the supply pressure [atmospheres], and the advice if it fits better."""

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
    """Log warning hook of a pneumatic drive; `prepare` is `PneumaticStarts.prepare_logs`."""

    prepare: PrepareLogs

    def __call__(self, logs: Mapping[str, Log]) -> Sequence[str]:
        """Return a sentence for each pressure whose chamber's equation holds better from another zero point."""
        active = {name: most_active_part(log) for name, log in logs.items() if is_informative(log)}
        left = self._doubtful_residuals(active) if active else {}
        together = left.values() if len(left) == len(active) else ()
        warnings = list(_warning_sentences("".join(logs) if len(logs) == 1 else "", together))
        long = [] if warnings else [n for n in left if float(np.ptp(active[n].measured.t)) >= MIN_LOG_DURATION]
        return warnings + [sentence for name in long for sentence in _warning_sentences(name, [left[name]])]

    def _doubtful_residuals(self, logs: Mapping[str, Log]) -> dict[str, dict[str, Array]]:
        """Squared rates of each pressure of doubtful logs, and the squared residuals with each shift [Pa^2/s^2]."""
        spread: dict[str, dict[str, float]] = {}
        for name, log in logs.items():
            rates = {n: filter_channel(log.measured, n, 1) for n in _pressure_channels(log)}
            spread[name] = {n: float(np.sum((rate - rate.mean()) ** 2)) for n, rate in rates.items()}
        by_shift = [self._shift_residuals(logs, ZERO_SHIFTS[0])]
        doubtful = {
            name: log
            for name, log in logs.items()
            if any(left > MAX_UNQUESTIONED_SHARE * spread[name][n] for n, left in by_shift[0][name].items())
        }
        by_shift += [self._shift_residuals(doubtful, remedy) for remedy in ZERO_SHIFTS[1:]] if doubtful else []
        return {
            name: {n: np.array([spread[name][n], *(each[name][n] for each in by_shift)]) for n in spread[name]}
            for name in doubtful
        }

    def _shift_residuals(self, logs: Mapping[str, Log], remedy: ZeroShift) -> dict[str, dict[str, float]]:
        """Squared residuals of each log's pressure rates with shifted zero points [Pa^2/s^2]."""
        shifted: dict[str, Log] = {}
        for name, log in logs.items():
            p, readings = log.parameters, {n: log.measured[n] for n in _pressure_channels(log)}
            measured = log.measured.with_columns({n: v + remedy.sensors * ATMOSPHERE for n, v in readings.items()})
            moved = {SUPPLY_PRESSURE: p.value(SUPPLY_PRESSURE) + remedy.supply * ATMOSPHERE}
            shifted[name] = Log(measured, p.with_bounds(dict.fromkeys(moved, (0.0, math.inf))).with_values(moved))
        left: dict[str, dict[str, float]] = {}
        for name, run in self.prepare(shifted).items():
            parts = [run.valve_columns(shape) for shape in trial_shapes(logs[name])]
            left[name] = {
                n: min(_regression_residual(columns[:, k], wanted[:, k]) for columns, wanted in parts)
                if run.known_states[n].min() > 0
                else math.inf
                for k, n in enumerate(run.logged_pressures)
            }
        return left


def is_informative(log: Log) -> bool:
    """Whether a log has motion and a pressure, and the supply pressure is known, without which no ratio is."""
    supply_known = SUPPLY_PRESSURE not in log.parameters.free_names
    return supply_known and any(n in log.measured for n in ("position", "speed")) and bool(_pressure_channels(log))


def most_active_part(log: Log) -> Log:
    """Part of a long log in which the pressures change most, which is enough for the check and cheap."""
    data = log.measured
    if len(data) <= MAX_START_SAMPLES:
        return log
    path = np.sum(
        [np.abs(filter_channel(data, n, 1)) / float(np.nanmean(data[n])) for n in _pressure_channels(log)], axis=0
    )
    within = np.convolve(path, np.ones(MAX_START_SAMPLES), "valid")
    first = int(np.argmax(within))
    return log._replace(measured=data.rows(first, first + MAX_START_SAMPLES))


def _pressure_channels(log: Log) -> list[str]:
    return [n for n in PRESSURE_NAMES if n in log.measured]


def trial_shapes(log: Log) -> Iterator[dict[str, float]]:
    """Values of the valve's shape parameters to try, where they are free."""
    tried = valve_shapes(log.parameters, log.parameters.free_names)
    for values in itertools.product(*tried.values()):
        yield dict(zip(tried, values, strict=True))


def _regression_residual(columns: Array, wanted: Array) -> float:
    """Sum of squared residuals of a regression; infinite where a shift has made numbers overflow."""
    if not np.isfinite(columns).all() or not np.isfinite(wanted).all():
        return math.inf
    return float(np.sum((wanted - columns @ np.linalg.lstsq(columns, wanted, rcond=None)[0]) ** 2))


def _warning_sentences(name: str, logs: Collection[Mapping[str, Array]]) -> Iterator[str]:
    """Sentences, one for each pressure for which another zero point fits better in these logs together."""
    for channel in PRESSURE_NAMES:
        rows = [left[channel] for left in logs if channel in left]
        total, unshifted, *shifted = np.sum(rows, axis=0) if rows else np.zeros(1 + len(ZERO_SHIFTS))
        best = int(np.argmin(shifted))
        if 0 < shifted[best] < min(unshifted / MIN_RESIDUAL_RATIO**2, MAX_RESIDUAL_SHARE * total):
            better = f"leaves {math.sqrt(unshifted / shifted[best]):.1f} times smaller residuals"
            where = f"{channel} of {name}" if name else channel
            yield f"{where}: its chamber's mass balance {better} with {ZERO_SHIFTS[1 + best].advice}"
