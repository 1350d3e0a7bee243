"""Plants and compensators whose names are words of languages, of the exported files, or no identifiers at all."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from pneuopt.control.compensators import ControllerSnapshot
from pneuopt.control.controller import Feedforward
from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID, Form
from pneuopt.control.sensor import SensedSignal
from pneuopt.dynamics.hooks import Axis
from pneuopt.dynamics.system import System, define, names
from pneuopt.export.identifiers import RESERVED, RESERVED_FILES
from pneuopt.export.program import controller_program
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity
from problems.shared.random_controllers import RANGES, SAMPLES, Run

_WORDS = """
    v1 k1 v2 k2 V1 K1 v3 k3 v10 integral Integral derivative pid hysteresis ramp Kp kp KP kD Kd Ki N n K b B c C p P
    self restart Restart runs int lambda double class SAMPLE_TIME sample_time least largest output OUTPUT measured
    setpoint
    start_output command centre lower upper error Error unlimited integral_term dither_term pid_integral pid_N pid_Kp
    Kp_parallel Kp_parallel_term integral_first integral_next pid_integral_first pid_integral_next output_now
    command_now side_next sample sample_next In MAX min abs math exp sin
    fabs INFINITY NULL true None t#1s T#1s a__b a__b_ _a a_ __a größe Größe дом 2nd 1 x.y.z LREAL LREAL_TO_LINT Not SEL
    END_VAR transfer fault bad_samples reading t1 DB1 v1_reading int_reading int_reading_2 output_delayed to ton ctu
"""
OWN_WORDS = _WORDS.split()
ALL_WORDS = sorted(
    {*OWN_WORDS, "a b", "", "a*/b", "(*", "*)", 'q"""'} | RESERVED_FILES | frozenset().union(*RESERVED.values())
)
FORBIDDEN = {"reference", "control", ""}  # what a loop keeps for itself, and what is no name of a signal


@dataclass(frozen=True)
class HostileCompensator:
    """Adds the sum of readings, weighted by its parameters, and a filtered one, under any names.

    Parameters
    ----------
    section : str
    readings, gains, kept : tuple of str
        Of the plant's outputs, its parameters and its states; a gain and a state a reading.
    """

    section: str
    readings: tuple[str, ...]
    gains: tuple[str, ...]
    kept: tuple[str, ...]
    size: str = ""
    acts_always: bool = True
    without_gradient: tuple[str, ...] = ()

    def check(self, _on: SensedSignal, _axis: Axis | None) -> None:
        """It fits any plant that has its readings."""

    def parameters(self, _on: SensedSignal, unit: str) -> ParameterSet:
        """A gain a reading."""
        return ParameterSet({n: Parameter(0.1, unit) for n in self.gains})

    def reads(self, _on: SensedSignal) -> tuple[str, ...]:
        """Its readings."""
        return self.readings

    def motion_inputs(self, _on: SensedSignal) -> tuple[str, ...]:
        """None."""
        return ()

    def states(self, _on: SensedSignal, _command: Quantity) -> tuple[Quantity, ...]:
        """A filtered value a reading."""
        return tuple(Quantity(n, "1") for n in self.kept)

    def start(self, _on: SensedSignal, seen: ControllerSnapshot) -> list[Any]:
        """The readings so far."""
        return [seen.readings[n] for n in self.readings]

    def act(self, seen: ControllerSnapshot, x: Mapping[str, Any], p: Mapping[str, Any]) -> tuple[dict[str, Any], ca.SX]:
        """The filtered readings, and the sum."""
        after, added = {}, ca.SX(0)
        for read, gain, kept in zip(self.readings, self.gains, self.kept, strict=True):
            after[kept] = 0.5 * (x[kept] + seen.readings[read])
            added += p[gain] * (seen.readings[read] - x[kept]) + ca.sin(p[gain] * after[kept])
        return after, added


def hostile_plant(signals: list[str], measured: str) -> System:
    """States of which each is an output: any signal can be set."""
    states = [Quantity(n, "1") for n in (measured, *signals)]
    rate = Parameter(1.0, "1/s")
    return define(
        states, [Quantity("u", "V")], states, ParameterSet({"rate": rate}),
        lambda _t, x, u, p: ({n: p["rate"] * (u["u"] - v) for n, v in x.items()}, dict(x)),
    )  # fmt: skip


def hostile_run(seed: int, samples: int = SAMPLES, words: Sequence[str] = ()) -> Run:
    """A controller whose names the seed draws from `ALL_WORDS`, and its run in the library's own closed loop.

    Or six given words, each of which names a reading, a parameter and a state.
    """
    g = np.random.default_rng(seed)

    def draw(count: int) -> list[str]:
        own = g.permutation([n for n in OWN_WORDS if n not in FORBIDDEN])[: count // 2]
        other = g.permutation([n for n in ALL_WORDS if n not in {*FORBIDDEN, *own}])[: count - len(own)]
        return [str(n) for n in (*own, *other)]

    signals, gains, kept = draw(7), tuple(draw(6)), tuple(draw(6))
    signals, gains, kept = (["rate", *words], tuple(words), tuple(words)) if words else (signals, gains, kept)
    section = str(g.choice([n for n in ALL_WORDS if n not in {*FORBIDDEN, "pid", "dither", "sensor", "feedforward"}]))
    part = HostileCompensator(section, tuple(signals[1:]), gains, kept)
    pid = PID([1e-3, 5e-5][seed % 2], True, list(Form)[seed % 3], int(g.integers(2)), bool(g.integers(2)))
    dither, lead = (Dither(frequency=150.0) if g.integers(2) else None), (Feedforward() if g.integers(2) else None)
    plant = hostile_plant(signals[1:], signals[0])
    loop = ClosedLoop(plant, pid, dither, measured=signals[0], feedforward=lead, compensators=(part,))  # type: ignore[arg-type]  # names are its own
    values = {
        n: g.uniform(*RANGES[n.split(".")[1]]) for n in loop.parameters if n.startswith("pid.") and n[4:] in RANGES
    }
    values |= {"pid.lower": -g.uniform(0.5, 4.0), "pid.upper": np.inf if seed % 4 == 1 else g.uniform(0.5, 4.0)}
    values |= {f"{section}.{n}": g.uniform(-2.0, 2.0) for n in gains}
    return _run(loop, loop.parameters.with_values(values), float(g.choice([0.0, 5.0])), g, samples)


def _run(loop: ClosedLoop, parameters: ParameterSet, centre: float, g: np.random.Generator, samples: int) -> Run:
    order, plant, p = names(loop.states), names(loop.plant.states), loop.parameter_vector(parameters)
    program = controller_program(loop.controller, parameters, centre)
    shown = np.cumsum(g.normal(size=(samples, len(plant))), axis=0) * 0.05
    reference = 0.3 * np.repeat(g.normal(size=samples // 50 + 1), 50)[:samples]
    read = [plant.index(n) for n in loop.readings]
    inputs, outputs = np.column_stack([reference, shown[:, 0], shown[:, read]]), np.empty(samples)
    begun = program.start([*inputs[0], centre], program.values).full().ravel()
    first = dict(zip((v.origin for v in program.states), begun, strict=True))
    x = np.array([first.get(n, 0.0) if n not in plant else 0.0 for n in order])
    for k in range(samples):
        x[: len(plant)] = shown[k]
        x = loop.update(k * (loop.pid.sample_time or 0.0), x, [reference[k]], p).full().ravel()
        outputs[k] = x[order.index("pid.pending" if loop.pid.delay else "pid.command")] + centre
    return Run(loop, parameters, centre, inputs, outputs)
