"""What a search samples and searches: the dither's frequency as a gain like any other, and what bounds it.

A search reads responses under dither as the certificate does: the same signal, with the same history.
"""

from math import pi

import numpy as np
import pytest

from pneuopt.control.dither import Dither, Waveform
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.metrics import BandCentre, step_metrics
from pneuopt.evaluation.requirements import Ripple, SettlingTime
from pneuopt.evaluation.specification import specify
from pneuopt.evaluation.tolerances import SAMPLES_A_DITHER_PERIOD
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.quantities.errors import PhysicsWarning
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.tuning.gradients import Lanes
from pneuopt.tuning.racing import Racing
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import ReferenceGrid, Space, dither_resolution_rate, read_metrics, search_space
from pneuopt.tuning.tune import tune

STEP = Step(0.1, horizon=0.4)
WIDE = {"dither.amplitude": (0.0, 60.0), "dither.frequency": (20.0, 200.0)}


def axis(
    sample_time: float | None, *, analogue: bool = False, waveform: Waveform = Waveform.SINE
) -> tuple[ClosedLoop, ParameterSet]:
    dither = Dither(80.0, analogue=analogue, waveform=waveform)
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(sample_time=sample_time), dither)
    values = {"pid.Kp": 300.0, "pid.Ki": 3000.0, "pid.lower": -300.0, "pid.upper": 300.0, "dither.amplitude": 40.0}
    return loop, loop.parameters.with_values(values)


def test_steps_resolve_an_analogue_dither_between_two_samples() -> None:
    free = axis(None)[1].with_bounds(WIDE).freed(*WIDE)
    assert dither_resolution_rate(axis(None)[0], free) == 0.0
    assert dither_resolution_rate(axis(1e-3, analogue=True)[0], free) >= SAMPLES_A_DITHER_PERIOD * 200.0


@pytest.mark.parametrize(
    ("sample_time", "analogue", "waveform"),
    [
        (None, False, Waveform.SINE),
        (None, False, Waveform.TRIANGLE),
        (1e-3, False, Waveform.TRIANGLE),
        (1e-3, True, Waveform.SINE),
    ],
)
def test_a_search_over_frequency_sees_what_the_certificate_sees(
    sample_time: float | None, analogue: bool, waveform: Waveform
) -> None:
    loop, p = axis(sample_time, analogue=analogue, waveform=waveform)
    free = p.with_bounds(WIDE).freed(*WIDE)
    spec = specify(SettlingTime(0.05), [Ripple(0.1)])
    space = search_space(loop, free)
    simulator = Simulator(loop, [STEP], space, spec=spec)
    for frequency in (40.0, 200.0):
        point = np.array([frequency if n.endswith("frequency") else 40.0 for n in space.names])
        claimed = simulator.table(point, spec)[0]
        certified = evaluate(loop, STEP, space.parameters_at(point), band=0.05)[STEP.label]
        assert claimed["SettlingTime"] == pytest.approx(certified["SettlingTime"], abs=1e-3), frequency
        assert claimed["Overshoot"] == pytest.approx(certified["Overshoot"], abs=0.2), frequency
        assert claimed["Ripple"] == pytest.approx(certified["Ripple"], rel=0.1), frequency


def test_frequency_is_tuned_with_the_rest() -> None:
    """Ripple falls with the frequency: its limit is met by a faster dither, whose amplitude has a floor here."""
    loop, p = axis(1e-3)
    bounds = {"pid.Kp": (100.0, 600.0), "dither.amplitude": (30.0, 60.0), "dither.frequency": (20.0, 200.0)}
    free = p.with_bounds(bounds).with_values({"dither.frequency": 25.0}).freed(*bounds)
    method = Racing(members=8, trials=40)
    with pytest.warns(PhysicsWarning, match=r"40 N at 25 Hz swings the speed .* beyond the settling band"):
        best = tune(loop, STEP, free, minimise=SettlingTime(0.05), subject_to=[Ripple(0.03)], method=method, plants={})
    assert best.parameters.value("dither.frequency") > 40.0
    assert best.certified.loc["Ripple"].max() <= 0.03


def test_a_gain_at_its_bound_is_printed_as_the_bound() -> None:
    """A solver leaves an unused derivative gain at 3e-9: a derivative time of 1e-9 s was printed."""
    gains = {"pid.Kp": Parameter(0.5, "1", 0.0, 2.0, free=True), "pid.Kd": Parameter(0.1, "s", 0.0, 2.0, free=True)}
    space = Space(ParameterSet(gains), ("pid.Kp", "pid.Kd"))
    assert space.round_point(np.array([1.99999999, 3.1234567e-9]), 4).tolist() == [2.0, 0.0]
    assert space.round_point(np.array([0.51234567, 3.1234567e-4]), 4).tolist() == [0.5123, 3.123e-4]


PERIOD, SPACING = 0.05, 2.5e-3
METRICS = ("SettlingTime", "SettlingTimeRaw", "Undershoot", "RiseTime", "IAE", "Overshoot", "SteadyStateError")


def response(reference: Step) -> tuple[ReferenceGrid, np.ndarray]:
    """A lag of .1 s under a ripple of 10 % of the step: signal, command, and the signal's integral."""
    t = np.linspace(0.0, reference.horizon, round(reference.horizon / SPACING) + 1, dtype=np.float64)
    lag, rate = 0.1, 2 * pi / PERIOD
    y = reference.final - reference.size * np.exp(-t / lag) + 0.1 * np.sin(rate * t)
    whole = reference.final * t - reference.size * lag * (1 - np.exp(-t / lag)) + 0.1 * (1 - np.cos(rate * t)) / rate
    grid = ReferenceGrid(reference, t, np.full((len(t), 1), reference.final), SPACING)
    return grid, np.stack([y, np.zeros_like(t), whole], axis=-1)[None]


@pytest.mark.parametrize("reference", [Step(1.0, horizon=1.0), Step(1.0, initial=3.0, horizon=1.0)])
def test_search_and_certificate_read_a_dithered_step_alike(reference: Step) -> None:
    """From motion too: a history of zeros before the step would move the mean in the first half period."""
    grid, y = response(reference)
    given = (grid.t, y[0, :, 0], reference.final, reference.initial)
    proof = step_metrics(*given, band_centre=BandCentre.REFERENCE, dither_period=PERIOD)
    found = read_metrics(grid, y, (0.02,), PERIOD, METRICS, ())
    for name in METRICS:
        assert found[name][0] == pytest.approx(proof[name], rel=5e-3, abs=5e-3, nan_ok=True), name
    still = np.zeros((*y.shape, 1))
    lanes = Lanes(grid, y, still, np.zeros((1, 1, 1)), [PERIOD], 2)
    error, slopes = lanes.record.error
    assert 100 * error.max() == pytest.approx(proof["Overshoot"], abs=5e-3)
    assert proof["Undershoot"] == 0
    assert error.min() >= -1
    assert not slopes.any()
