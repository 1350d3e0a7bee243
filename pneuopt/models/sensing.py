"""Plants whose measured outputs have delays, lags or offsets (`with_sensors`), each a parameter of its own.

The outputs keep their names, so logs, loops and tables read them as before. Free parameters "sensor.*" are estimated
with the others and have intervals: a zero point of each log (`per_log`) for example, or the skew between two channels.
Only differences of delays are identifiable, unless the time of the inputs is exact: where one channel leads, give the
others delays.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import casadi as ca
import numpy as np

from pneuopt.dynamics.hooks import Log, Rest, RestHook, Start
from pneuopt.dynamics.system import Symbols, System, define, names, parameter_vector, stack
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import check_names, require
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity
from pneuopt.quantities.trajectories import Trajectory

Channels = tuple[str, ...]
# A sensor's delay or lag: a shorter one makes the ODE stiff and does not show in logs at 1 kHz, a longer delay is not
# followed by a Padé form of second order.
_DELAY = Parameter(1e-3, "s", lower=2e-4, upper=0.05)


def with_sensors(
    system: System,
    *,
    offset: Sequence[str] = (),
    delay: Sequence[str] = (),
    lag: Sequence[str] = (),
) -> System:
    """Add sensors to the named outputs: first a delay, then a lag, then an offset.

    Parameters
    ----------
    offset : sequence of str
        Outputs with a parameter "sensor.<name>.offset" [the output's unit], 0 by default.
    delay : sequence of str
        Outputs with "sensor.<name>.delay" [s]: a Padé form of second order,
        ``(1 - s T/2 + (s T)^2/12) / (1 + s T/2 + (s T)^2/12)``. Its gain is one at every frequency; its phase lags
        by ``(w T)^5/720`` too little, 0.08 degrees at w T = 1 (at 32 Hz for 5 ms), 2.1 degrees at w T = 2.
    lag : sequence of str
        Outputs with "sensor.<name>.lag" [s], a first-order filter's time constant.

    Returns
    -------
    System
        With the sensors' states ("sensor.*") after the plant's; it keeps the plant's validity limits, checks, rest and
        starts.

    Raises
    ------
    UnknownNameError
        If an output is unknown.

    Examples
    --------
    >>> from pneuopt.models.drives import ForceDrive
    >>> from pneuopt.models.friction import Coulomb
    >>> drive = with_sensors(ForceDrive(Coulomb()).system(), offset=["speed"], delay=["position"])
    >>> [n for n in drive.parameters if n.startswith("sensor")]
    ['sensor.speed.offset', 'sensor.position.delay']
    """
    sensors = _Sensors(system, tuple(offset), tuple(delay), tuple(lag))
    for kind, channels in (("offset", offset), ("delay", delay), ("lag", lag)):
        check_names("output", channels, names(system.outputs), f"with_sensors: {kind}")
    signals = (system.states + sensors.states, system.inputs, system.outputs, system.parameters | sensors.parameters)
    sensed = define(*signals, sensors.rates, start_hook=sensors.starts)
    finder = partial(sensors.rest, system.rest_hook) if system.rest_hook else None
    return replace(
        sensed,
        rest_hook=finder,
        hardware_check_hook=system.hardware_check_hook,
        validity_limits=system.validity_limits,
        identification_hints=system.identification_hints,
        axis=system.axis,
    )


def coarse_delay(log: Trajectory, late: str, other: str, longest: float = _DELAY.upper) -> float:
    """Delay of one of two related channels against the other by cross-correlation: a start value for its parameter.

    Parameters
    ----------
    late, other : str
        Two measurements of the same motion: two speeds, or a position and a speed; the position is differentiated.
    longest : float
        Greatest delay that is tried, in either direction [s].

    Returns
    -------
    float
        Delay [s], to a fraction of a sample; negative where the other channel is later.

    Examples
    --------
    >>> t = np.arange(1000) * 1e-3
    >>> log = Trajectory(t, {"position": -np.cos(9 * (t - 0.005)) / 9, "speed": np.sin(9 * t)})
    >>> round(coarse_delay(log, "position", "speed"), 4)
    0.005
    """
    step = float(np.median(np.diff(log.t)))
    grid = np.arange(log.t[0], log.t[-1], step)
    curves = []
    for name in (late, other):
        finite = np.isfinite(log[name])
        require(bool(finite.any()), f"channel {name!r} holds no sample")
        column = np.interp(grid, log.t[finite], log[name][finite])
        to_speed = name == "position" and (late, other) != ("position", "position")
        curves.append(np.gradient(column, grid) if to_speed else column)
    a, b = curves
    most = min(round(longest / step), len(grid) // 4)
    inner = slice(most, len(grid) - most)
    shifts = np.arange(-most, most + 1)
    match = np.array([np.corrcoef(np.roll(a, -k)[inner], b[inner])[0, 1] for k in shifts])
    best = int(np.argmax(match))
    if 0 < best < len(match) - 1:
        left, middle, right = match[best - 1 : best + 2]
        return float(step * (shifts[best] + 0.5 * (left - right) / (left - 2 * middle + right)))
    return float(step * shifts[best])


@dataclass(frozen=True, eq=False)
class _Sensors:
    """Sensors between a plant's outputs and a log."""

    plant: System
    offset: Channels
    delay: Channels
    lag: Channels

    @property
    def states(self) -> tuple[Quantity, ...]:
        """States: two for each delay (of the Padé form, in the channel's unit), one for each lag."""
        shown = {q.name: q for q in self.plant.outputs}
        late = [replace(shown[n], name=f"sensor.{n}.{part}") for n in self.delay for part in ("level", "late")]
        slow = [replace(shown[n], name=f"sensor.{n}.slow") for n in self.lag]
        return tuple(replace(q, lower=-math.inf, upper=math.inf) for q in (*late, *slow))

    @property
    def parameters(self) -> ParameterSet:
        units = {q.name: q.unit.partition("(")[0] for q in self.plant.outputs}
        out = {f"sensor.{n}.offset": Parameter(0.0, units[n]) for n in self.offset}
        out |= {f"sensor.{n}.delay": _DELAY for n in self.delay} | {f"sensor.{n}.lag": _DELAY for n in self.lag}
        return ParameterSet(out)

    def rates(self, t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:
        """Rates of the plant's and the sensors' states, and the measured outputs."""
        plant = self.plant
        xs, ps = ca.vertcat(*(x[n] for n in names(plant.states))), ca.vertcat(*(p[n] for n in plant.parameters))
        xdot, y = plant.ode(t, xs, stack(u), ps)
        rates = {n: xdot[k] for k, n in enumerate(names(plant.states))}
        shown = {n: y[k] for k, n in enumerate(names(plant.outputs))}
        for n in self.delay:
            level, late, T = x[f"sensor.{n}.level"], x[f"sensor.{n}.late"], p[f"sensor.{n}.delay"]
            # e^(-sT) = 1 - sT/(1 + sT/2 + (sT)^2/12): the input less T times the rate of its low-passed level
            rates |= {f"sensor.{n}.level": late / T, f"sensor.{n}.late": (12 * (shown[n] - level) - 6 * late) / T}
            shown[n] = shown[n] - late
        for n in self.lag:
            rates[f"sensor.{n}.slow"] = (shown[n] - x[f"sensor.{n}.slow"]) / p[f"sensor.{n}.lag"]
            shown[n] = x[f"sensor.{n}.slow"]
        return rates, shown | {n: shown[n] + p[f"sensor.{n}.offset"] for n in self.offset}

    def rest(self, finder: RestHook, parameters: ParameterSet, outputs: Mapping[str, float]) -> Rest:
        """Rest or steady motion of the plant, with settled sensors."""
        off = {n: self._parameter_value(parameters, n, "offset") for n in self.offset}
        rest = finder(parameters, {n: value - off.get(n, 0.0) for n, value in outputs.items()})
        x, u = (
            [part.get(n, 0.0) for n in names(q)]
            for part, q in ((rest.states, self.plant.states), (rest.inputs, self.plant.inputs))
        )
        xdot, y = (
            np.array(a).ravel() for a in self.plant.ode(0, x, u, parameter_vector(self.plant.parameters, parameters))
        )
        at = {n: np.array([value]) for n, value in zip(names(self.plant.outputs), y.tolist(), strict=True)}
        moving = dict(zip(names(self.plant.states), xdot.tolist(), strict=True))
        settled = self._steady_sensor_states(at, {n: np.array([moving.get(n, 0.0)]) for n in at}, parameters)
        return Rest({**rest.states, **{n: float(column[0]) for n, column in settled.items()}}, rest.inputs)

    def starts(self, logs: Mapping[str, Log]) -> Sequence[Start]:
        """Candidates of the plant, from logs corrected for delays and offsets, with settled sensors."""
        guessed: dict[str, dict[str, float]] = {name: {} for name in logs}
        # free delays by cross-correlation of position and speed, where both are logged
        for (name, log), (late, other) in itertools.product(
            logs.items(), itertools.permutations(("position", "speed"))
        ):
            key = f"sensor.{late}.delay"
            free = late in self.delay and log.parameters[key].free
            if free and other not in self.delay and late in log.measured and other in log.measured:
                p = log.parameters[key]
                guessed[name][key] = float(np.clip(coarse_delay(log.measured, late, other), p.lower, p.upper))
        plant = {name: self._correct_log(log, guessed[name]) for name, log in logs.items()}
        delays: dict[str, float] = {}
        for name in dict.fromkeys(n for guess in guessed.values() for n in guess):
            by_log = {log: guess[name] for log, guess in guessed.items() if name in guess}
            if any(logs[log].parameters[name].per_log for log in by_log):
                delays |= {f"{name}[{log}]": delay for log, delay in by_log.items()}
            else:
                delays[name] = float(np.median([*by_log.values()]))
        out = []
        for start in self.plant.starts(plant):
            states = {name: self._complete_states(start, name, log, guessed[name]) for name, log in logs.items()}
            out.append(replace(start, states=states, parameters={**start.parameters, **delays}))
        return out

    def _correct_log(self, log: Log, guessed: Mapping[str, float]) -> Log:
        """Log without the sensors' delays, lags and offsets, for the plant's starts."""
        columns, t = {}, log.measured.t
        for n in (n for n in names(self.plant.outputs) if n in log.measured):
            late = sum(
                guessed.get(f"sensor.{n}.{kind}", self._parameter_value(log.parameters, n, kind))
                for kind in ("delay", "lag")
            )
            column = log.measured[n]
            finite = np.isfinite(column)
            shifted = np.interp(t + late, t[finite], column[finite])
            columns[n] = np.where(finite, shifted, np.nan) - self._parameter_value(log.parameters, n, "offset")
        return Log(log.measured.with_columns(columns), log.parameters.select(self.plant.parameters))

    def _complete_states(self, start: Start, name: str, log: Log, guessed: Mapping[str, float]) -> Trajectory:
        run, p = start.states[name], log.parameters
        values = {n.removesuffix(f"[{name}]"): v for n, v in start.parameters.items()} | dict(guessed)
        values = {n: v for n, v in values.items() if n in p}
        p = p.with_bounds(dict.fromkeys(values, (-math.inf, math.inf))).with_values(values)
        plant = self.plant
        u, x = log.measured.matrix(names(plant.inputs)), run.matrix(names(plant.states))
        ode = plant.ode.map(len(run))
        y = np.array(ode(run.t[None], x.T, u.T, parameter_vector(plant.parameters, p))[1])
        true = dict(zip(names(plant.outputs), y, strict=True))
        return run.with_columns(
            self._steady_sensor_states(true, {n: np.gradient(column, run.t) for n, column in true.items()}, p)
        )

    def _steady_sensor_states(
        self, true: Mapping[str, Array], rate: Mapping[str, Array], p: ParameterSet
    ) -> dict[str, Array]:
        """States of the sensors for outputs that change slowly."""
        out: dict[str, Array] = {}
        for n in self.delay:
            T = self._parameter_value(p, n, "delay")
            out |= {f"sensor.{n}.level": true[n] - T / 2 * rate[n], f"sensor.{n}.late": T * rate[n]}
        for n in self.lag:
            late = self._parameter_value(p, n, "lag") + (
                self._parameter_value(p, n, "delay") if n in self.delay else 0.0
            )
            out[f"sensor.{n}.slow"] = true[n] - late * rate[n]
        return out

    def _parameter_value(self, parameters: ParameterSet, channel: str, kind: str) -> float:
        name = f"sensor.{channel}.{kind}"
        return next((known.value(name) for known in (parameters, self.parameters) if name in known), 0.0)
