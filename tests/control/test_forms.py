"""Forms of a PID: their conversions, and that a loop runs the same law whichever form its gains are given in."""

from collections.abc import Callable
from math import inf

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneuopt.control.forms import (
    Form,
    ParallelForm,
    SeriesForm,
    StandardForm,
    proportional_band,
    proportional_gain,
    to_parallel,
    to_series,
    to_standard,
)
from pneuopt.control.linear_loop import open_loop
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.dynamics.system import System
from pneuopt.evaluation.batch_margins import batch_margin_function
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.margins import frequency_response, sensitivity_terms
from pneuopt.evaluation.requirements import MaxSensitivity, Overshoot, SettlingTime
from pneuopt.evaluation.specification import specify
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.tuning.linearised import LinearisedProblem, sensitivity_rollout
from pneuopt.tuning.racing import Racing
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import search_space
from pneuopt.tuning.tune import tune

Run = Callable[[ClosedLoop, ParameterSet, float, float, float], tuple[np.ndarray, np.ndarray, np.ndarray]]
SAME = {
    Form.STANDARD: {"Kp": 0.24, "Ti": 0.2, "Td": 0.04, "N": 4.0},
    Form.SERIES: {"K": 0.2, "Ti": 0.15, "Td": 0.05, "Tf": 0.01},
}


@given(
    Kp=st.floats(0.01, 100),
    Ki=st.floats(0.01, 1000),
    Kd=st.floats(1e-4, 10),
    Tf=st.floats(1e-5, 1.0),
)
def test_parallel_to_standard_and_back(Kp: float, Ki: float, Kd: float, Tf: float) -> None:
    back = to_parallel(to_standard(ParallelForm(Kp, Ki, Kd, Tf)))
    np.testing.assert_allclose([back.Kp, back.Ki, back.Kd, back.Tf], [Kp, Ki, Kd, Tf], rtol=1e-12)


@given(K=st.floats(0.01, 100), Ti=st.floats(1e-2, 10), Td=st.floats(0.0, 0.45), Tf=st.floats(0.0, 1.0))
def test_series_to_parallel_and_back(K: float, Ti: float, Td: float, Tf: float) -> None:
    """Two series forms have the same sum where Td + Tf < Ti; the one with the smaller Td is given."""
    own, filtering = Ti * Td, Ti * Td * Tf
    back = to_series(to_parallel(SeriesForm(K, Ti, own, filtering)))
    np.testing.assert_allclose([back.K, back.Ti, back.Td, back.Tf], [K, Ti, own, filtering], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("parallel", "standard", "series"),
    [
        (ParallelForm(2.0), StandardForm(2.0, inf, 0.0, inf), SeriesForm(2.0)),
        (ParallelForm(2.0, 4.0), StandardForm(2.0, 0.5, 0.0, inf), SeriesForm(2.0, 0.5)),
        (ParallelForm(2.0, 0.0, 0.5), StandardForm(2.0, inf, 0.25, inf), SeriesForm(2.0, inf, 0.25)),
        (ParallelForm(-2.0, -4.0), StandardForm(-2.0, 0.5, 0.0, inf), SeriesForm(-2.0, 0.5)),
    ],
)
def test_missing_actions_convert_both_ways(parallel: ParallelForm, standard: StandardForm, series: SeriesForm) -> None:
    assert to_standard(parallel) == standard
    assert to_series(parallel) == series
    assert to_parallel(standard) == to_parallel(series) == parallel


def test_the_series_form_is_its_two_factors() -> None:
    """Against python-control's product, the derivative's filter included."""
    own, s = SeriesForm(2.0, 0.4, 0.1, 0.02), control.tf("s")
    same = to_parallel(own)
    product = own.K * (1 + 1 / (own.Ti * s)) * (1 + own.Td * s / (own.Tf * s + 1))
    summed = same.Kp + same.Ki / s + same.Kd * s / (same.Tf * s + 1)
    w = 1j * np.geomspace(0.01, 1e4, 50)
    np.testing.assert_allclose(summed(w), product(w), rtol=1e-12)


def test_what_a_form_cannot_say_is_refused() -> None:
    with pytest.raises(InputError, match="needs Kp != 0"):
        to_standard(ParallelForm(0.0, 1.0))
    with pytest.raises(InputError, match="Ti = inf"):
        to_parallel(StandardForm(1.0, 0.0))
    with pytest.raises(InputError, match="N = 0"):
        to_parallel(StandardForm(1.0, 1.0, 0.1, 0.0))
    with pytest.raises(InputError, match=r"needs Ti >= 4 Td; here Ti = 0.5 s, Td = 0.25 s; use the standard form"):
        to_series(ParallelForm(2.0, 4.0, 0.5))
    with pytest.raises(InputError, match=r"\(Ti - Tf\)\^2 >= 4 Ti Td with Ti > Tf, and Tf = 0.3 s"):
        to_series(to_parallel(StandardForm(2.0, 0.5, 0.1, 0.1 / 0.3)))


@given(Kp=st.floats(1e-3, 1e3), measured=st.floats(0.1, 10.0), command=st.floats(0.1, 20.0))
def test_the_proportional_band_drives_the_full_command(Kp: float, measured: float, command: float) -> None:
    band = proportional_band(Kp, measured, command)
    assert Kp * band / 100 * measured == pytest.approx(command)
    assert proportional_gain(band, measured, command) == pytest.approx(Kp)


def test_a_band_needs_spans() -> None:
    with pytest.raises(InputError, match="both spans must be positive, got 0"):
        proportional_band(1.0, 0.0, 10.0)
    with pytest.raises(InputError, match="Kp = 0 has no proportional band"):
        proportional_band(0.0, 1.0, 10.0)
    with pytest.raises(InputError, match="a switch, not a gain"):
        proportional_gain(0.0, 1.0, 10.0)


def both(plant: System, form: Form, sample_time: float | None) -> list[tuple[ClosedLoop, ParameterSet]]:
    """The same controller by its own gains, and in the parallel form."""
    own = SAME[form]
    kind = StandardForm if form is Form.STANDARD else SeriesForm
    parallel = vars(to_parallel(kind(**own)))
    found = []
    for given_form, gains in ((form, own), (Form.PARALLEL, parallel)):
        loop = ClosedLoop(plant, PID(sample_time, form=given_form))
        values = {f"pid.{n}": v for n, v in gains.items()} | {"pid.b": 0.6, "pid.upper": 0.4, "pid.lower": -0.4}
        found.append((loop, loop.parameters.with_values(values)))
    return found


@pytest.mark.parametrize("sample_time", [None, 2e-3])
@pytest.mark.parametrize("form", SAME)
def test_whatever_its_form_the_same_law_runs(
    second_order: System, run: Run, form: Form, sample_time: float | None
) -> None:
    pairs = both(second_order, form, sample_time)
    runs = [run(loop, p, 0.5, 2e-3, 0.4) for loop, p in pairs]
    np.testing.assert_allclose(runs[0][2], runs[1][2], atol=1e-12)
    starts = [loop.initial(p, reference=0.3) for loop, p in pairs]
    np.testing.assert_allclose(starts[0], starts[1], atol=1e-12)
    w = np.geomspace(0.1, 400.0, 30)
    L = [frequency_response(open_loop(loop, p), w) for loop, p in pairs]
    np.testing.assert_allclose(L[0], L[1], rtol=1e-10)
    terms = [sensitivity_terms(loop, w, p)(loop.parameter_vector(p)).full() for loop, p in pairs]
    np.testing.assert_allclose(terms[0], terms[1], rtol=1e-10)
    only = ("MaxSensitivity", "NoiseGain")
    reads = [
        batch_margin_function(loop, w)(loop.parameter_vector(p)[None], np.zeros((1, 1, 2)), np.zeros((1, 1, 1)), only)
        for loop, p in pairs
    ]
    for name in only:
        np.testing.assert_allclose(reads[0][name], reads[1][name], rtol=1e-9)
    tables = [evaluate(loop, Step(0.5, horizon=0.4), p) for loop, p in pairs]
    np.testing.assert_allclose(tables[0].to_numpy(), tables[1].to_numpy(), rtol=1e-5, atol=1e-7)


def test_a_standard_form_without_derivative_or_integral_runs(second_order: System, run: Run) -> None:
    loop = ClosedLoop(second_order, PID(form=Form.STANDARD))
    _, _, y = run(loop, loop.parameters.with_values({"pid.Kp": 0.2}), 1.0, 1e-3, 3.0)
    assert y[-1, 0] == pytest.approx(0.2 * 1270.12 / (86.34 + 0.2 * 1270.12), rel=1e-3)


def friction_loop(form: Form, sample_time: float | None) -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(sample_time, form=form))
    bounds = {
        Form.STANDARD: {"pid.Kp": (50.0, 600.0), "pid.Ti": (0.01, 0.3), "pid.Td": (1e-3, 5e-3), "pid.N": (2.0, 20.0)},
        Form.SERIES: {"pid.K": (50.0, 600.0), "pid.Ti": (0.01, 0.3), "pid.Td": (0.0, 5e-3), "pid.Tf": (2e-3, 2e-2)},
    }[form]
    values = {n: (low + up) / 2 for n, (low, up) in bounds.items()} | {"pid.lower": -300.0, "pid.upper": 300.0}
    return loop, loop.parameters.with_values(values).with_bounds(bounds).freed(*bounds)


@pytest.mark.parametrize(("form", "sample_time"), [(Form.STANDARD, None), (Form.SERIES, 2e-3)])
def test_gradients_are_those_of_finite_differences(
    form: Form, sample_time: float | None, check_slopes: Callable[[LinearisedProblem, np.ndarray], None]
) -> None:
    loop, freed = friction_loop(form, sample_time)
    simulator = Simulator(loop, [Step(0.1, horizon=0.3)], search_space(loop, freed))
    spec = specify(SettlingTime(), [Overshoot(0.1), MaxSensitivity(1.6)])
    posed = LinearisedProblem(simulator, sensitivity_rollout(simulator), spec, 60, 1.0)
    z = np.array([0.4, 0.3, 0.5, 0.6, 0.2037])
    check_slopes(posed, z)


def test_it_is_tuned_in_its_own_gains() -> None:
    loop, freed = friction_loop(Form.STANDARD, 2e-3)
    quick = Racing(members=8, trials=40, polish=16)
    best = tune(
        loop,
        Step(0.1, horizon=0.3),
        freed,
        minimise=SettlingTime(),
        subject_to=[Overshoot(0.1)],
        method=quick,
        plants={},
    )
    assert best.status.converged
    assert set(best.parameters.free_names) == {"pid.Kp", "pid.Ti", "pid.Td", "pid.N"}
    before = evaluate(loop, Step(0.1, horizon=0.3), freed)["0 to 0.1"]["SettlingTime"]
    assert not before <= best.certified["0 to 0.1"]["SettlingTime"]


def test_bad_gains_of_a_form_are_named(second_order: System) -> None:
    loop = ClosedLoop(second_order, PID(form=Form.STANDARD))
    for values, message in (
        ({"pid.N": 0.0}, r"pid\.N = 0 would switch the derivative off; the ISA ratio N is 5 to 20"),
        ({"pid.Ti": 0.0}, r"pid\.Ti = 0 would be an infinite integral gain; no integral action is Ti = inf"),
        ({"pid.Td": 0.1, "pid.N": inf}, r"pid\.N = inf: a continuous derivative needs a filter"),
    ):
        with pytest.raises(InputError, match=message):
            loop.check(loop.parameters.with_values(values))
    for name, unit in (("pid.Ti", "s"), ("pid.Td", "s"), ("pid.N", "1")):
        freed = loop.parameters.with_values({name: 1.0}).with_bounds({name: (0.0, 20.0)}).freed(name)
        with pytest.raises(InputError, match=rf"{name}: its lower bound must be positive, got 0 {unit}"):
            search_space(loop, freed)


def test_a_form_is_no_string() -> None:
    with pytest.raises(InputError, match=r"PID: form is one of Form\.PARALLEL, Form\.STANDARD, .* got 'standard'"):
        PID(form="standard")  # type: ignore[arg-type]
