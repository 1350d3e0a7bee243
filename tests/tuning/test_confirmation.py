"""That no design keeps all limits is confirmed by a second search before it is said."""

import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.requirements import ITAE, MaxSensitivity, Overshoot, PhaseMargin, Requirement, SettlingTime
from pneuopt.evaluation.specification import specify
from pneuopt.models.linear import SecondOrder
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code
from pneuopt.tuning.confirmation import confirm_infeasible
from pneuopt.tuning.racing import Racing
from pneuopt.tuning.search import relax
from pneuopt.tuning.simulator import Simulator
from pneuopt.tuning.space import search_space
from pneuopt.tuning.tune import prepare_search, prepare_task, tune

GAIN, RATE, STEP = 0.1462, 3.073, Step(1.0, horizon=13.0)
SMALL = Racing(5, 1, (), 0)


def problem() -> tuple[ClosedLoop, ParameterSet]:
    """A lightly damped plant: its good designs are a small part of the gains' box."""
    loop = ClosedLoop(SecondOrder().system(), PID(limits=False))
    plant = {"plant.gain": GAIN, "plant.natural_frequency": RATE, "plant.damping": 0.1465}
    free = {"pid.Kp": (0.02 / GAIN, 20 / GAIN), "pid.Ki": (0.02 * RATE / GAIN, 20 * RATE / GAIN)}
    free |= {"pid.Kd": (0.0, 20 / (GAIN * RATE)), "pid.Tf": (0.02 / RATE, 0.5 / RATE)}
    given = {"pid.Kp": 0.5 / GAIN, "pid.Ki": 0.5 * RATE / GAIN, "pid.Tf": 0.1 / RATE}
    return loop, loop.parameters.with_values(plant | given).with_bounds(free).freed(*free)


def limits(itae: float) -> list[Requirement]:
    return [ITAE(itae), Overshoot(0.05), MaxSensitivity(2.0), PhaseMargin(50.0)]


def test_the_second_search_finds_what_a_sum_of_excesses_hides() -> None:
    """Kp 3.998, Ki 64.29, Kd 6.676, Tf .03315 keeps all limits; "relax all by 54 %" was the answer."""
    loop, given = problem()
    spec = specify(SettlingTime(), limits(0.0082))
    simulator = Simulator(loop, [STEP], search_space(loop, given), spec=spec)
    found = confirm_infeasible(simulator, spec, 0.0, lambda _: None)
    assert found.share <= 0
    assert not spec.violations({n: float(v[0]) for n, v in simulator.values(found.point[None], spec).items()})
    again = confirm_infeasible(simulator, spec, 0.0, lambda _: None)
    assert again.point.tolist() == found.point.tolist()


def test_a_search_that_fails_goes_on_from_there() -> None:
    loop, given = problem()
    found = tune(loop, STEP, given, minimise=ITAE(), subject_to=limits(0.0082), method=SMALL, plants={}, throw=False)
    assert found.status.converged
    assert found.certified.loc["ITAE"].max() <= 0.0082


def test_what_is_impossible_is_said_with_its_confirmation() -> None:
    loop, given = problem()
    found = tune(loop, STEP, given, minimise=ITAE(max=1e-4), method=SMALL, plants={}, throw=False)
    assert found.status.code is Code.INFEASIBLE
    assert "a second search, SciPy's differential evolution" in str(found.status)
    assert found.stats["confirmation.share"] > 0
    assert found.stats["confirmation.simulations"] > 1000


def test_an_interruption_before_the_confirmation_is_no_answer() -> None:
    loop, given = problem()
    task = prepare_task(loop, STEP, given, specify(ITAE(), limits(1e-4)))

    def stop_confirming(text: str) -> None:
        if "confirming" in text:
            raise KeyboardInterrupt

    search = prepare_search(task, SMALL, stop_confirming)
    found = relax(search, search.run())
    assert found.status.code is Code.INTERRUPTED
    assert "nothing found so far" in str(found.status)


@pytest.mark.parametrize("throws_at", [1, 4])
def test_an_interrupted_exact_search_is_not_followed_by_another(throws_at: int) -> None:
    """Ctrl-C ended `TwoPhase`, and the search by simulation began."""
    loop, given = problem()
    heard = list[str]()

    def stop(text: str) -> None:
        heard.append(text)
        if len(heard) == throws_at:
            raise KeyboardInterrupt

    found = tune(loop, STEP, given, minimise=SettlingTime(), progress=stop, throw=False, plants={})
    assert found.status.code is Code.INTERRUPTED
    assert len(heard) == throws_at
