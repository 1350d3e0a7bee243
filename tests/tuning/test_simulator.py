"""A search reads what the certificate reads, on samples that follow the response."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from pneuopt.control.dither import Dither, Waveform
from pneuopt.control.loop import ClosedLoop, add_disturbances
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.dynamics.system import define
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.requirements import (
    IAE,
    ITAE,
    GainMargin,
    MaxSensitivity,
    NoiseGain,
    Overshoot,
    PhaseMargin,
    Requirement,
    SettlingTime,
)
from pneuopt.evaluation.specification import specify
from pneuopt.models.catalog import t32
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import LuGre, Stribeck
from pneuopt.models.linear import SecondOrder
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity
from pneuopt.quantities.status import Code, Status
from pneuopt.tuning.method import SearchResult
from pneuopt.tuning.racing import Racing
from pneuopt.tuning.search import Search
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import search_space
from pneuopt.tuning.tolerances import MAX_LOOP_SUBSTEPS
from pneuopt.tuning.tune import prepare_task, tune

ROWS = ("MaxSensitivity", "GainMargin", "PhaseMargin", "NoiseGain")
SPEC = specify(SettlingTime(), [MaxSensitivity(2.0), GainMargin(2.0), PhaseMargin(30.0), NoiseGain(1e9)])


def cylinder() -> tuple[ClosedLoop, ParameterSet, Step, dict[str, tuple[float, float]]]:
    drive, p = t32()
    loop = ClosedLoop(drive.system(), PID(), Dither(1000 / (2 * np.pi)))
    ranges = {"pid.Kp": (4.0, 12.0), "pid.Ki": (20.0, 150.0), "pid.Kd": (0.0, 0.1), "dither.amplitude": (0.3, 2.0)}
    values = {"pid.Tf": 0.003, "pid.lower": -5.0, "pid.upper": 5.0, "dither.offset": -0.3}
    step = Step(0.2, horizon=0.5, start={"position": 0.05, "pressure_b": 3.5e5})
    return loop, loop.complete(p).with_values(values), step, ranges


def positioner() -> tuple[ClosedLoop, ParameterSet, Step, dict[str, tuple[float, float]]]:
    """A position loop that a load disturbs; its friction's slope is a hundred times smaller sliding than at rest."""
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(2e-3), measured="position")
    p = loop.parameters.with_values({"friction.smoothing": 2e-3, "pid.Tf": 4e-3, "friction.viscous": 80.0})
    ranges = {"pid.Kp": (500.0, 4000.0), "pid.Ki": (0.0, 500.0), "pid.Kd": (20.0, 150.0)}
    return loop, p, Step(0.05, horizon=0.6, disturbance={"load.force": 10.0}), ranges


def sampled_axis() -> tuple[ClosedLoop, ParameterSet, Step, dict[str, tuple[float, float]]]:
    """A speed loop with a sampled triangle of 100 Hz, between two speeds."""
    loop = ClosedLoop(ForceDrive(LuGre()).system(), PID(1e-3), Dither(100.0, waveform=Waveform.TRIANGLE))
    p = loop.parameters.with_values({"dither.amplitude": 20.0, "pid.Tf": 5e-3})
    ranges = {"pid.Kp": (50.0, 400.0), "pid.Ki": (500.0, 5000.0), "dither.amplitude": (0.0, 30.0)}
    return loop, p, Step(0.1, at=0.05, initial=0.05, horizon=0.5), ranges


def gained_lag() -> tuple[ClosedLoop, ParameterSet, Step, dict[str, tuple[float, float]]]:
    """A lag whose gain rises fourfold with the step."""
    x, u = Quantity("x", "1"), Quantity("u", "1")
    plant = define(
        [x],
        [u],
        [x],
        ParameterSet({"gain": Parameter(1.0, "1")}),
        lambda _t, x, u, p: ({"x": p["gain"] * u["u"] - x["x"]}, dict(x)),
    )
    loop = ClosedLoop(plant, PID(0.05))
    p = loop.parameters.with_values({"pid.Tf": 0.05, "pid.Kd": 0.0})
    return loop, p, Step(1.0, horizon=5.0, disturbance={"gain": 3.0}), {"pid.Kp": (0.1, 2.0), "pid.Ki": (0.5, 4.0)}


@pytest.mark.parametrize("problem", [cylinder, positioner, sampled_axis, gained_lag])
def test_search_and_certificate_agree_on_random_gains(
    problem: Callable[[], tuple[ClosedLoop, ParameterSet, Step, dict[str, tuple[float, float]]]],
) -> None:
    loop, given, step, ranges = problem()
    given = given.with_values({n: sum(r) / 2 for n, r in ranges.items()}).with_bounds(ranges).freed(*ranges)
    loop = add_disturbances(loop, [step])
    space = search_space(loop, given)
    simulator = Simulator(loop, [step], space, spec=SPEC)
    points, compared = space.from_unit(np.random.default_rng(1).random((4, len(ranges)))), 0
    for point in points:
        (claimed,) = simulator.table(point, SPEC)
        certified = evaluate(loop, step, space.parameters_at(point)).iloc[:, 0]
        peaks = claimed["MaxSensitivity"], certified["MaxSensitivity"]
        assert 1 / peaks[0] == pytest.approx(1 / peaks[1], abs=0.01)  # infinite where unstable
        if max(peaks) < 10:
            compared += 1
            for name in ROWS:
                assert claimed[name] == pytest.approx(certified[name], rel=0.01), name
    assert compared >= 2


def test_a_searchs_margins_do_not_jump_where_a_dither_begins(
    light_cylinder: tuple[ClosedLoop, ParameterSet, Step],
) -> None:
    """The command crosses the dead zone within a dither period, so that its mean says nothing of it."""
    loop, p, step = light_cylinder
    space = search_space(loop, p.with_bounds({"dither.amplitude": (0.0, 1.0)}).freed("dither.amplitude"))
    simulator = Simulator(loop, [step], space, spec=SPEC)
    tables = [simulator.table(np.array([a]), SPEC)[0] for a in (0.0, 1e-12, 1e-3)]
    certified = evaluate(loop, step, space.parameters_at(np.array([1e-12]))).iloc[:, 0]
    for name in ROWS:
        assert [table[name] for table in tables[1:]] == pytest.approx([tables[0][name]] * 2, rel=2e-3), name
        assert tables[1][name] == pytest.approx(certified[name], rel=0.01), name


def test_margins_do_not_depend_on_what_runs_beside() -> None:
    """Lanes that wait for the latest one at a sample of the controller would act again there."""
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(1e-3), Dither(80.0))
    values = {"friction.coulomb": 40.0, "friction.static": 70.0, "friction.viscous": 80.0, "pid.Kp": 200.0}
    bounds = {"pid.Kp": (10.0, 1000.0), "pid.Ki": (1.0, 10000.0), "dither.amplitude": (0.0, 50.0)}
    given = loop.parameters.with_values({**values, "pid.Ki": 500.0, "pid.lower": -300.0, "pid.upper": 300.0})
    space = search_space(loop, given.with_bounds(bounds).freed(*bounds))
    simulator = Simulator(loop, [Step(0.1, horizon=0.3)], space, spec=SPEC)
    points = space.from_unit(np.random.default_rng(0).random((24, len(bounds))))
    together = simulator.values(points, SPEC)["MaxSensitivity"]
    alone = [simulator.values(point[None], SPEC)["MaxSensitivity"][0] for point in points]
    np.testing.assert_allclose(together, alone, rtol=1e-12)


STEP = Step(1.0, horizon=20.0)
FREE = {"pid.Kp": (0.01, 20.0), "pid.Ki": (0.1, 400.0), "pid.Kd": (0.0, 1.0), "pid.Tf": (1e-3, 0.05)}
GAINS = {"pid.Kp": 7.502, "pid.Ki": 394.9, "pid.Kd": 0.4313, "pid.Tf": 0.001003}


def problem(step: Step = STEP) -> tuple[ClosedLoop, Simulator]:
    loop = ClosedLoop(SecondOrder().system(), PID(limits=False))
    plant = {"plant.gain": 1.0, "plant.natural_frequency": 30.0, "plant.damping": 0.3}
    given = loop.parameters.with_values(plant | GAINS).with_bounds(FREE).freed(*FREE)
    return loop, Simulator(loop, [step], search_space(loop, given), spec=specify(ITAE(), [IAE(1.0)]))


def test_samples_are_added_where_the_response_is() -> None:
    _, simulator = problem()
    start, spec = simulator.space.start, specify(ITAE(), [IAE(1.0)])
    finer = simulator.refine(start)
    assert len(finer.grids[0].t) < 4 * len(simulator.grids[0].t)
    assert np.diff(finer.grids[0].t)[0] < 1e-3
    assert np.all(np.diff(finer.grids[0].t) > 0)
    assert simulator.values(start[None], spec)["ITAE"][0] < 0.1 * 5.088e-6
    assert finer.values(start[None], spec)["ITAE"][0] == pytest.approx(5.088e-6, rel=5e-3)  # tests/evaluation
    assert finer.values(start[None], spec)["SettlingTime"][0] == pytest.approx(0.00592, rel=5e-3)
    assert len(finer.coarse(spec).grids[0].t) == len(finer.grids[0].t)


def test_slow_responses_need_no_more_samples() -> None:
    _, simulator = problem(Step(1.0, horizon=2.0))
    assert simulator.refine(np.array([0.05, 1.0, 0.0, 0.01])) is simulator
    assert simulator.refine(simulator.space.start) is not simulator


def test_steps_that_change_a_claim_are_halved_and_a_short_search_goes_on_from_its_point() -> None:
    step = Step(1.0, horizon=2.0)
    loop, simulator = problem(step)
    method, point = Racing(), np.array([0.05, 1.0, 0.0, 0.01])
    spec, calls, agree = specify(ITAE(), [IAE(1.0)]), list[tuple[Simulator, int]](), iter([False, True])

    def find(*given: Any) -> SearchResult:
        calls.append((given[2], given[5]))
        return SearchResult(given[4], Status(Code.CONVERGED), (), optimum=1.0, uses_simulator=True)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Racing, "find", find)
        patch.setattr(Search, "_agree", lambda *_: next(agree))
        task = prepare_task(loop, step, simulator.space.parameters, spec)
        found = Search(task, method, lambda _: None).find(method.margin, point, 0)
    (first, full), (second, short) = calls
    assert (full, short) == (0, 1)
    assert second.grids is first.grids
    assert second.substeps[0] >= 2 * first.substeps[0]
    assert found.point.tolist() == point.tolist()


def test_steps_are_halved_until_there_are_too_many() -> None:
    simulators = [problem()[1]]
    for _ in range(20):
        simulators.append(simulators[-1].shorten_steps())
    counts = list(dict.fromkeys(max(s.substeps) for s in simulators))
    assert len(counts) >= 3
    assert all(fine >= 2 * coarse for coarse, fine in pairwise(counts))
    assert counts[-1] <= MAX_LOOP_SUBSTEPS < 2 * counts[-1]
    assert simulators[-1] is simulators[-2]


@pytest.mark.parametrize("minimise", [SettlingTime(), ITAE()])
def test_a_fast_loop_in_a_long_horizon_is_claimed_as_it_is(minimise: Requirement) -> None:
    loop, simulator = problem()
    small = Racing(8, 60)
    limits = [Overshoot(0.05), MaxSensitivity(2.0)]
    given = simulator.space.parameters
    found = tune(loop, STEP, given, minimise=minimise, subject_to=limits, method=small, throw=False, plants={})
    claimed, certified = found.requirements["claimed"], found.requirements["certified"]
    assert found.status.converged
    np.testing.assert_allclose(claimed, certified, rtol=5e-3, atol=1e-3)
    assert found.certified.loc["SettlingTime"].max() < 0.1
