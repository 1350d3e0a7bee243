"""Random sampled controllers of every form, and their run in the library's own closed loop."""

from typing import NamedTuple

import numpy as np

from pneuopt.control.compensators import COMPENSATORS
from pneuopt.control.controller import Feedforward, PositionLoop
from pneuopt.control.dither import Dither, Waveform
from pneuopt.control.gain_schedule import GainSchedule
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID, AntiWindup, Form
from pneuopt.control.sensor import Encoder, SensorLag
from pneuopt.dynamics.system import names
from pneuopt.export.program import controller_program
from pneuopt.models.friction import Viscous
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import ParameterSet

COUNT, SAMPLES = 20, 300
RESOLUTION = 1e-5  # [m] of the encoders
RANGES = {
    **dict.fromkeys(("Kp", "K"), (0.5, 20.0)),
    "Ki": (0.0, 200.0),
    "Kd": (0.0, 0.3),
    "Tf": (0.0, 0.02),
    "Ti": (0.01, 0.5),
    "Td": (0.0, 0.05),
    "N": (3.0, 20.0),
    "b": (0.0, 1.0),
    "c": (0.0, 1.0),
    "Tt": (0.01, 0.5),
    "dead_band": (0.0, 0.02),
    "reset_ratio": (0.2, 1.0),
    "reset_band": (0.0, 0.01),
    "amplitude": (0.0, 2.0),
    "offset": (-1.0, 1.0),
    "frequency": (20.0, 150.0),
    "gain": (-2.0, 5.0),
    "pressure_feedback.gain": (0.0, 1e-5),
    "acceleration_feedback.gain": (0.0, 0.1),
    "acceleration_feedback.filter": (2e-3, 0.01),
    "time": (0.01, 0.2),
    "level": (0.0, 1.0),
    "speed": (0.0, 3.0),
    "acceleration": (0.0, 0.3),
    "smoothing": (1e-3, 0.05),
    "width": (0.004, 0.02),
    "period": (0.02, 0.08),
    "filter": (0.0, 0.01),
    "tolerance": (0.025, 0.1),  # beyond a count of the sensor, within the reference's steps
    **dict.fromkeys(("Kp_slope", "Kp_curve", "K_slope", "K_curve", "position_loop_Kp_slope"), (-0.5, 0.5)),
    **dict.fromkeys(("Kp_load", "K_load"), (-1.0, 1.0)),
    "load": (2.0, 9.0),
}


class Run(NamedTuple):
    """What a controller is given and gives, sample by sample."""

    loop: ClosedLoop
    parameters: ParameterSet
    centre: float
    inputs: Array
    outputs: Array


def random_loop(seed: int) -> tuple[ClosedLoop, ParameterSet, float]:
    """A controller whose form, parts and numbers the seed draws; every form and part comes in twenty."""
    g = np.random.default_rng(seed)
    form, sensor = list(Form)[seed % 3], [None, Encoder(RESOLUTION), Encoder(), SensorLag(0.005), None][seed % 5]
    pid = PID(
        [1e-3, 2e-3, 5e-4, 1.0 / 3000][seed % 4],
        bool(seed % 7),
        form,
        int(g.integers(2)),
        bool(g.integers(2)),
        list(AntiWindup)[seed % 4 == 2],
        seed % 6 == 3,
    )
    dither = [Dither(), Dither(waveform=Waveform.TRIANGLE), Dither(analogue=True), None][int(g.integers(4))]
    lead = Feedforward() if g.integers(2) else None
    measured = "position" if seed % 4 == 1 else "speed"
    outer = PositionLoop() if seed % 8 == 1 else None
    lead = None if outer else lead
    gains = (f"pid.{form.gains[0]}", *(["position_loop.Kp"] if outer else []))
    schedule = GainSchedule(gains, -0.04, 0.05, load=5.0 if seed % 3 else None) if seed % 4 < 2 else None
    kinds = [k for k in COMPENSATORS.values() if g.integers(2)]
    loop = ClosedLoop(
        PneumaticDrive(friction=Viscous()), pid, dither, measured=measured, sensor=sensor, feedforward=lead,
        compensators=tuple(k() for k in kinds), outer=outer, schedule=schedule,
    )  # fmt: skip
    values = {
        n: g.uniform(*RANGES.get(n, RANGES[n.split(".")[1]]))
        for n in loop.parameters
        if n.split(".")[1] in RANGES and n not in loop.plant.parameters
    }
    values |= {"pid.lower": -g.uniform(0.5, 4.0), "pid.upper": g.uniform(0.5, 4.0)} if pid.limits else {}
    return loop, loop.parameters.with_values(values), float(g.choice([0.0, 5.0]))


def run_library(seed: int) -> Run:
    """The commands of the library's closed loop while its plant is moved at random."""
    loop, parameters, centre = random_loop(seed)
    g, h, p = np.random.default_rng(seed + 1000), loop.pid.sample_time or 0.0, loop.parameter_vector(parameters)
    order, plant = names(loop.states), names(loop.plant.states)
    program = controller_program(loop.controller, parameters, centre)
    motion = 0.05 * np.cumsum(g.normal(size=(SAMPLES, 2)), axis=0) * [0.02, 0.2]
    reference = 0.3 * np.repeat(g.normal(size=SAMPLES // 50), 50)
    more = g.normal(size=(SAMPLES, len(loop.motion_inputs))) * 0.1
    air = 5e5 + 1e4 * np.cumsum(g.normal(size=(SAMPLES, len(loop.readings))), axis=0)
    air[:, [n == "position" for n in loop.readings]] = motion[:, :1]
    shown = np.array([shown_signal(loop, row) for row in motion])
    inputs, outputs = np.column_stack([reference, shown, more, air]), np.empty(SAMPLES)
    begun = program.start([*inputs[0], centre], program.values).full().ravel()
    first = dict(zip((v.origin for v in program.states), begun, strict=True))
    x = np.array([first.get(n, 0.0) for n in order])
    for k in range(SAMPLES):
        x[[plant.index("position"), plant.index("speed")]] = motion[k]
        if isinstance(loop.sensor, SensorLag):
            x[order.index("sensor.reading")] = motion[k, int(loop.pid_signal.name == "speed")]
        x[[plant.index(n) for n in loop.readings]] = air[k]
        x = loop.update(k * h, x, [reference[k], *more[k]], p).full().ravel()
        by_name = dict(zip(order, x, strict=True))
        outputs[k] = by_name["pid.pending" if loop.pid.delay else "pid.command"] + centre
    return Run(loop, parameters, centre, inputs, outputs)


def shown_signal(loop: ClosedLoop, motion: Array) -> float:
    """What the hardware shows the controller: a position in counts, or the signal itself."""
    if isinstance(loop.sensor, Encoder):
        size = loop.sensor.resolution
        return float(size * np.floor(motion[0] / size + 0.5)) if size else float(motion[0])
    return float(motion[int(loop.pid_signal.name == "speed")])
