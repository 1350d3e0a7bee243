"""A sample that is no number: the output is held, the states stay, a safe output, and how the controller goes on."""

from collections.abc import Mapping

import numpy as np
import pytest

from pneuopt.control.acceleration_feedback import AccelerationFeedback
from pneuopt.control.dither import Dither
from pneuopt.control.feedforward import Feedforward
from pneuopt.control.forms import Form
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.position_loop import PositionLoop
from pneuopt.control.pressure_feedback import PressureFeedback
from pneuopt.control.sensor import Encoder, SensorLag
from pneuopt.dynamics.compiled.rollout import Rollout
from pneuopt.dynamics.system import names
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Viscous
from pneuopt.models.linear import FirstOrder
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.tuning.space import search_space

H = 2e-3
FORCE, AIR = ForceDrive(friction=Viscous()).system(), PneumaticDrive(friction=Viscous()).system()
BAD = pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e31, -1e300])
GAINS = {"pid.Kp": 3.0, "pid.Ki": 20.0, "pid.Kd": 0.05, "pid.Tf": 0.004, "pid.lower": -5.0, "pid.upper": 5.0}


class Bench:
    """A loop's controller, its plant moved by hand."""

    def __init__(self, loop: ClosedLoop, values: Mapping[str, float]) -> None:
        self.loop, self.order, self.k = loop, names(loop.states), 0
        known = {n: v for n, v in values.items() if n in loop.parameters}
        self.parameters = loop.parameters.with_values(known)
        self.x = loop.initial(self.parameters)

    def sample(self, reference: float, **plant: float) -> dict[str, float]:
        """The states after a sample at which the plant's states have these values."""
        for name, value in plant.items():
            self.x[self.order.index(name)] = value
        u = [reference] + [0.0] * (len(self.loop.inputs) - 1)
        p, t = self.loop.parameter_vector(self.parameters), self.k * (self.loop.pid.sample_time or 0.0)
        self.x, self.k = self.loop.update(t, self.x, u, p).full().ravel(), self.k + 1
        return self.states

    @property
    def states(self) -> dict[str, float]:
        """Those of the controller."""
        own = zip(self.order, self.x.tolist(), strict=True)
        return {n: v for n, v in own if n not in names(self.loop.plant.states)}


@BAD
@pytest.mark.parametrize("where", ["reference", "speed"])
@pytest.mark.parametrize("delay", [0, 1])
def test_the_output_is_held_and_the_states_stay(bad: float, where: str, delay: int) -> None:
    bench = Bench(ClosedLoop(AIR, PID(H, delay=delay), Dither(60.0)), {**GAINS, "dither.amplitude": 0.3})
    for k in range(4):
        before = bench.sample(0.2, speed=0.05 * k)
    after = bench.sample(bad if where == "reference" else 0.2, speed=bad if where == "speed" else 0.2)
    sent = before["pid.pending" if delay else "pid.command"]
    assert after == before | {"pid.command": sent, "pid.bad_samples": 1.0}  # the delayed one acts, and stays
    assert bench.sample(0.2, speed=0.2)["pid.bad_samples"] == 0.0


def test_every_signal_that_is_read_counts_and_no_other() -> None:
    loop = ClosedLoop(AIR, PID(H), measured="position", outer=PositionLoop(), compensators=(PressureFeedback(),))
    for name in ("position", "speed", "pressure_a", "pressure_b"):
        bench = Bench(loop, GAINS)
        assert bench.sample(0.1, **{name: np.nan})["pid.bad_samples"] == 1.0
    bench = Bench(loop, GAINS)
    assert bench.sample(0.1, **{"valve.spool": np.nan})["pid.bad_samples"] == 0.0
    lagging = Bench(ClosedLoop(AIR, PID(H), sensor=SensorLag(5e-3)), GAINS)
    assert lagging.sample(0.1, speed=np.nan)["pid.bad_samples"] == 0.0  # the controller sees the sensor
    after = lagging.sample(0.1, **{"sensor.reading": np.nan})
    assert after["pid.bad_samples"] == 1.0
    assert np.isnan(after["sensor.reading"])  # which is not the controller's to mend


@pytest.mark.parametrize("delay", [0, 1])
@pytest.mark.parametrize(("wanted", "safe"), [(-1.0, -1.0), (9.0, 5.0)])
def test_after_so_many_it_is_safe_and_begins_anew_as_at_a_start(delay: int, wanted: float, safe: float) -> None:
    values = {**GAINS, "pid.fault_samples": 3.0, "pid.fault_output": wanted}
    loop = ClosedLoop(AIR, PID(H, delay=delay), feedforward=Feedforward(), compensators=(AccelerationFeedback(),))
    bench = Bench(loop, {**values, "feedforward.gain": 2.0, "acceleration_feedback.gain": 0.1})
    for k in range(5):
        bench.sample(0.2, speed=0.02 * k)
    held = "pid.pending" if delay else "pid.command"
    sent = [bench.sample(0.2, speed=np.nan)[held] for _ in range(7)]
    assert sent[0] == sent[1] != safe
    assert sent[2:] == [safe] * 5
    assert bench.states["pid.bad_samples"] == 7.0
    after = bench.sample(-0.1, speed=0.3)
    begun = Bench(loop, values)
    begun.parameters = bench.parameters
    x = loop.initial(bench.parameters, [0.0, 0.3, 5e5, 5e5, 0.0, 0.0], reference=-0.1, command=safe)
    begun.x = x
    expected = begun.sample(-0.1, speed=0.3)
    assert after == pytest.approx(expected, abs=1e-12)
    assert after[held] == pytest.approx(np.clip(safe + H * 20.0 * -0.4, -5, 5))  # but for the integral's first step


@pytest.mark.parametrize("gap", [1, 2, 4])
def test_differences_are_taken_over_the_whole_gap(gap: int) -> None:
    """A signal that rises evenly has the same slope behind a gap as before it."""
    rate = 0.7
    values = {"pid.Kp": 0.0, "pid.Ki": 0.0, "pid.Kd": 0.5, "pid.Tf": 0.0, "pid.c": 0.0}
    bench = Bench(ClosedLoop(FORCE, PID(H, limits=False), measured="position"), values)
    counter = Bench(ClosedLoop(FORCE, PID(H, limits=False), sensor=Encoder(filter=0.0)), GAINS)
    for k in range(3):
        for b in (bench, counter):
            b.sample(0.0, position=rate * H * (k + 1))
    for _ in range(gap):
        for b in (bench, counter):
            b.sample(0.0, position=np.nan)
    after = bench.sample(0.0, position=rate * H * (4 + gap))
    assert after["pid.command"] == pytest.approx(-0.5 * rate, rel=1e-9)
    assert counter.sample(0.0, position=rate * H * (4 + gap))["sensor.reading"] == pytest.approx(rate, rel=1e-9)


def test_filters_count_the_gap_and_the_integral_one_sample() -> None:
    parts = (PressureFeedback(), AccelerationFeedback())
    values = {**GAINS, "pid.Kd": 0.0, "feedforward.time": 0.05, "pressure_feedback.time": 0.1}
    bench = Bench(ClosedLoop(AIR, PID(H), feedforward=Feedforward(), compensators=parts), values)
    bench.sample(0.1, speed=0.0, pressure_a=5e5, pressure_b=5e5)
    before = bench.states
    for _ in range(3):
        bench.sample(np.nan)
    after = bench.sample(0.3, speed=0.2, pressure_a=6e5, pressure_b=5e5)
    passed = 4 * H
    slow = {"feedforward.filter": (0.05, 0.3), "pressure_feedback.slow": (0.1, 1e5)}
    slow |= {"acceleration_feedback.speed": (5e-3, 0.2)}
    for name, (time, signal) in slow.items():
        assert after[name] == pytest.approx((time * before[name] + passed * signal) / (time + passed))
    assert after["pid.integral"] == pytest.approx(before["pid.integral"] + 20.0 * H * 0.1)


def test_a_dither_keeps_its_phase() -> None:
    loop, values = ClosedLoop(FORCE, PID(H, limits=False), Dither(60.0)), {"pid.Kp": 0.0, "dither.amplitude": 1.0}
    whole, broken = Bench(loop, values), Bench(loop, values)
    for k in range(20):
        one = whole.sample(0.0)["pid.command"]
        other = broken.sample(np.nan if 5 <= k < 15 else 0.0)["pid.command"]
    assert one == other != 0.0


@pytest.mark.parametrize("lanes", [0, 1, None])
@pytest.mark.parametrize("segments", [1, 40])
@pytest.mark.parametrize("sensor", [None, Encoder(filter=4e-3)])
def test_machine_code_and_array_programs_do_the_same(lanes: int | None, segments: int, sensor: Encoder | None) -> None:
    loop = ClosedLoop(FORCE, PID(H, form=Form.STANDARD), Dither(60.0), sensor=sensor, feedforward=Feedforward())
    values = {"pid.Kp": 40.0, "pid.Ti": 0.3, "pid.Td": 0.01, "dither.amplitude": 2.0, "feedforward.gain": 5.0}
    p = loop.parameters.with_values({**values, "pid.lower": -9.0, "pid.upper": 9.0, "pid.fault_output": 1.0})
    reference = np.where(np.arange(60) > 4, 0.2, 0.0)
    reference[[10, 11, 25]] = np.nan, np.inf, -np.inf
    reference[30:41] = 1e31
    u, t = np.zeros((segments, 60, len(loop.inputs))), np.tile(H * np.arange(60), (segments, 1))
    u[:, :, 0] = reference
    rollout = Rollout(loop.discrete().pieces, lanes=lanes)
    run = rollout.run(np.tile(loop.initial(p), (segments, 1)), u, loop.parameter_vector(p), t, np.full_like(t, H))
    expected = by_hand(loop, p, reference)
    assert np.isfinite(run.y).all()
    for y in run.y[..., names(loop.outputs).index("control")]:
        np.testing.assert_allclose(y, expected, rtol=0, atol=1e-11)
    assert expected[11] == expected[10] == expected[9]
    assert expected[40] == 1.0


def by_hand(loop: ClosedLoop, p: ParameterSet, reference: Array) -> Array:
    """The outputs of the loop, sample by sample."""
    x, v, step = loop.initial(p), loop.parameter_vector(p), loop.discrete()
    found = []
    for k, r in enumerate(reference):
        x = loop.update(k * H, x, [r], v).full().ravel()
        found.append(x[names(loop.states).index("pid.command")])
        x = step.step(k * H, H, x, [r], v)[0].full().ravel()
    return np.array(found)


@pytest.mark.parametrize("samples", [1, 3, 12])
def test_a_loop_arrives_all_the_same(samples: int) -> None:
    """A step with a fault in its rise: no worse than the step itself, for which the plant was on its own."""
    loop = ClosedLoop(FirstOrder().system(), PID(1e-2))
    p = loop.parameters.with_values({"pid.Kp": 2.0, "pid.Ki": 20.0, "pid.lower": -2.0, "pid.upper": 2.0})
    x, v, step, y = loop.initial(p), loop.parameter_vector(p), loop.discrete(), []
    for k in range(400):
        x = loop.update(k * 1e-2, x, [np.nan if 5 <= k < 5 + samples else 1.0], v).full().ravel()
        x = step.step(k * 1e-2, 1e-2, x, [1.0], v)[0].full().ravel()
        y.append(x[0])
    assert y[-1] == pytest.approx(1.0, abs=1e-3)
    assert max(y) < 1.3


@pytest.mark.parametrize("name", ["pid.fault_samples", "pid.fault_output"])
def test_what_a_fault_does_is_never_free(name: str) -> None:
    loop = ClosedLoop(FORCE, PID(H))
    bounded = loop.parameters.freed("pid.Kp", name).with_bounds(
        {"pid.Kp": (0.1, 9.0), name: (0.0, 9.0) if "output" in name else (1.0, 9.0)}
    )
    with pytest.raises(InputError, match=f"{name} is free, but"):
        search_space(loop, bounded)


@pytest.mark.parametrize(
    ("values", "told"), [({"fault_samples": 0.0}, "positive"), ({"fault_output": np.inf}, "finite")]
)
def test_what_cannot_run_is_refused(values: dict[str, float], told: str) -> None:
    loop = ClosedLoop(FORCE, PID(H))
    with pytest.raises(InputError, match=told):
        loop.check(loop.parameters.with_values({f"pid.{n}": v for n, v in values.items()}))
    assert not PID().fixed_parameters
    assert not [n for n in PID().parameters("m", "N") if n.startswith("fault")]
