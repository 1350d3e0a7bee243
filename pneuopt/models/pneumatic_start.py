"""Where the identification of a `PneumaticDrive` starts, without a guess from the user: equation error on the logs.

The pressures' rates are linear in the valve's conductance and in conductance times leak, with everything else known or
given; the force that both pressures give makes friction the same regression as for a known force (NUMERICS section 3,
steps 1 and 2). A pressure that is not logged is integrated from the logged motion.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from pneuopt.codegen import compiled
from pneuopt.models.friction_start import Rows, candidates, filtered, motion
from pneuopt.parameters import ParameterSet
from pneuopt.system import Log, Start, System, names, vector
from pneuopt.trajectories import Trajectory

Array = NDArray[np.float64]
PRESSURES = ("pressure_a", "pressure_b")
CONDUCTANCE, LEAK = "valve.conductance", "valve.leak"


@dataclass(frozen=True, eq=False)
class PneumaticStarts:
    """The start finder of a pneumatic drive.

    Parameters
    ----------
    system : callable
        Returns the drive's System (not held: it holds this).
    areas : callable
        From the parameters' mapping to both piston areas [m^2].
    """

    system: Callable[[], System]
    areas: Callable[[Mapping[str, Any]], tuple[Any, Any]]

    def __call__(self, logs: Mapping[str, Log]) -> Sequence[Start]:
        """Return candidates: one valve, friction for each of the Stribeck velocities tried."""
        rates = _Rates(self.system())
        states = {name: self._known_states(log, rates) for name, log in logs.items()}
        valve = _valve(logs, states, rates)
        rows = {name: self._rows(log, states[name], valve, rates) for name, log in logs.items()}
        starts = candidates(rows)
        return [Start(s.states, {**s.parameters, **valve}, s.label) for s in starts]

    def _known_states(self, log: Log, rates: "_Rates") -> dict[str, Array]:
        measured, parameters = log
        position, speed, acceleration = motion(measured)
        found = {"position": position, "speed": speed, "acceleration": acceleration}
        found |= _spool(rates.system, measured, parameters)
        return found | {n: filtered(measured, n, 0) for n in PRESSURES if n in measured}

    def _rows(self, log: Log, states: dict[str, Array], valve: Mapping[str, float], rates: "_Rates") -> Rows:
        measured, parameters = log
        if not all(n in states for n in PRESSURES):
            states |= {
                n: p
                for n, p in rates.pressures(measured, states, parameters.with_values(valve)).items()
                if n not in states
            }
        force, areas = np.zeros(len(measured)), self.areas({n: q.value for n, q in parameters.items()})
        for area, sign, name in zip(areas, (1.0, -1.0), PRESSURES, strict=True):
            force = force + sign * area * (states[name] - parameters.value("ambient.pressure"))
        inertia = {"load.mass": states["acceleration"], "load.force": np.ones(len(measured))}
        kept = {n: states[n] for n in names(rates.system.states) if n in states}
        with_pressures = measured.with_columns({n: states[n] for n in PRESSURES})
        return Rows(with_pressures, parameters, states["speed"], force, inertia, kept)


class _Rates:
    """The drive's ODE along logs."""

    def __init__(self, system: System) -> None:
        self.system = system
        self._ode = compiled(system.ode)
        self._names = names(system.states)

    def of_pressures(self, measured: Trajectory, states: Mapping[str, Array], parameters: ParameterSet) -> Array:
        """Rates of both pressures at every sample [Pa/s], shape (n, 2)."""
        x = np.column_stack([states.get(n, np.zeros(len(measured))) for n in self._names])
        u, p = measured.matrix(names(self.system.inputs)), vector(self.system.parameters, parameters)
        rows = [self._names.index(n) for n in PRESSURES]
        return np.array([self._ode(t, xk, uk, p)[0][rows] for t, xk, uk in zip(measured.t, x, u, strict=True)])

    def pressures(
        self, measured: Trajectory, states: Mapping[str, Array], parameters: ParameterSet
    ) -> dict[str, Array]:
        """Both pressures integrated along the logged motion, from half the supply; ten Euler steps a sample."""
        x = np.column_stack([states.get(n, np.zeros(len(measured))) for n in self._names])
        u, p = measured.matrix(names(self.system.inputs)), vector(self.system.parameters, parameters)
        rows = [self._names.index(n) for n in PRESSURES]
        now = np.array([(parameters.value("supply.pressure") + parameters.value("ambient.pressure")) / 2] * 2)
        out = np.empty((len(measured), 2))
        steps = np.append(np.diff(measured.t), 0.0) / 10
        for k, h in enumerate(steps):
            out[k] = now
            for _ in range(10):
                x[k, rows] = now
                now = now + h * self._ode(measured.t[k], x[k], u[k], p)[0][rows]
        return dict(zip(PRESSURES, out.T, strict=True))


def _valve(logs: Mapping[str, Log], states: Mapping[str, Mapping[str, Array]], rates: _Rates) -> dict[str, float]:
    """Conductance and leak, as far as they are free, from the logs that have both pressures."""
    parameters = next(iter(logs.values())).parameters
    free = [n for n in (CONDUCTANCE, LEAK) if n in parameters.free_names]
    parts = [_valve_rows(log, states[n], rates) for n, log in logs.items() if all(p in log.measured for p in PRESSURES)]
    if not free or not parts:
        return {}
    A, y = np.concatenate([a for a, _ in parts]), np.concatenate([b for _, b in parts])
    if free == [CONDUCTANCE]:
        A = (A[:, 0] + parameters.value(LEAK) * A[:, 1])[:, None]
    if free == [LEAK]:
        y, A = y - parameters.value(CONDUCTANCE) * A[:, 0], A[:, 1:] * parameters.value(CONDUCTANCE)
    found = np.linalg.lstsq(A, y, rcond=None)[0]
    if len(free) == 2:
        found = np.array([found[0], found[1] / found[0] if found[0] > 0 else 0.0])
    bounds = [parameters[n] for n in free]
    floor = 1e-4 if LEAK in free else 0.0
    values = {n: float(np.clip(v, b.lower, b.upper)) for n, v, b in zip(free, found, bounds, strict=True)}
    return values | ({LEAK: max(values[LEAK], floor)} if LEAK in values else {})


def _valve_rows(log: Log, states: Mapping[str, Array], rates: _Rates) -> tuple[Array, Array]:
    """What multiplies C and C * leak in the pressures' rates, and the rates less what no valve gives [Pa/s]."""
    measured, parameters = log
    unit = 1e-8

    def at(conductance: float, leak: float) -> Array:
        return rates.of_pressures(measured, states, _forced(parameters, {CONDUCTANCE: conductance, LEAK: leak}))

    closed = at(1e-12, 0.0)
    edges, leaking = at(unit, 0.0) - closed, at(unit, 0.01) - closed
    target = np.column_stack([filtered(measured, n, 1) for n in PRESSURES]) - closed
    A = np.stack([edges / unit, (leaking - edges) / (0.01 * unit)], axis=-1).reshape(-1, 2)
    return A, target.ravel()


def _forced(parameters: ParameterSet, values: Mapping[str, float]) -> ParameterSet:
    """With other values and no bounds on them."""
    return parameters.with_bounds(dict.fromkeys(values, (-np.inf, np.inf))).with_values(values)


def _spool(system: System, measured: Trajectory, parameters: ParameterSet) -> dict[str, Array]:
    """The spool's states from the command, held over each sample; the lag is linear up to the clip."""
    mine = [n for n in names(system.states) if n.startswith("valve.")]
    if not mine:
        return {}
    rows = [names(system.states).index(n) for n in mine]
    span = parameters.value("valve.span")
    line = system.linearise(_middle(system), {}, parameters)
    A, B = line.A[np.ix_(rows, rows)], line.B[rows]
    h = float(np.median(np.diff(measured.t)))
    block = expm(h * np.block([[A, B], [np.zeros((1, len(mine) + 1))]]))
    Ad, Bd = block[:-1, :-1], block[:-1, -1]
    z, out = np.zeros(len(mine)), np.empty((len(measured), len(mine)))
    for k, u in enumerate(np.clip(measured["valve_voltage"], -span, span)):
        out[k] = z
        z = Ad @ z + Bd * u
    return dict(zip(mine, out.T, strict=True))


def _middle(system: System) -> Array:
    """A state at which the ODE is defined: nominal pressures and temperatures, everything else zero."""
    return np.array([q.nominal if q.name.startswith(("pressure", "temperature")) else 0.0 for q in system.states])
