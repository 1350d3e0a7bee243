"""Every registered method through the same mill: a new one is a class and a row in `METHODS`."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.dynamics.runge_kutta import RK4_MAX_H_LAMBDA
from pneuopt.evaluation.requirements import Overshoot, Ripple, SettlingTime
from pneuopt.evaluation.specification import specify
from pneuopt.files.tuning import read_tuning
from pneuopt.models.linear import FirstOrder
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code
from pneuopt.shooting.full_space import FullSpace
from pneuopt.tuning.method import Method, TuningTask
from pneuopt.tuning.methods import METHODS, choose_method
from pneuopt.tuning.racing import Racing
from pneuopt.tuning.space import search_space
from pneuopt.tuning.tune import prepare_search, tune
from pneuopt.tuning.two_phase import TwoPhase

STEP, LIMITS = Step(1.0, horizon=1.0), (Overshoot(0.05),)
SMALL: dict[str, dict[str, object]] = {  # options with which each one takes a second
    "two_phase": {"starts": 1, "nodes": [20, 20]},
    "racing": {"members": 8, "trials": 40, "bands": [4.0], "polish": 2},
}
FILE = """
[method]
kind = "{kind}"
{options}
[pid]
Kp = {{ value = "2 V*s/m", lower = "0.1 V*s/m", upper = "20 V*s/m", free = true }}
Ki = {{ value = "10 V/m", lower = "0 V/m", upper = "200 V/m", free = true }}
[[reference]]
step = "1 m/s"
horizon = "1 s"
[minimise]
settling_time = {{ band = "2 %" }}
"""


def problem(dither: Dither | None = None) -> tuple[ClosedLoop, ParameterSet]:
    loop = ClosedLoop(FirstOrder().system(), PID(limits=False), dither)
    free = {"pid.Kp": (0.1, 20.0), "pid.Ki": (0.0, 200.0)}
    return loop, loop.parameters.with_values({"pid.Kp": 2.0, "pid.Ki": 10.0}).with_bounds(free).freed(*free)


def read(kind: str, folder: Path, options: dict[str, object]) -> Method:
    lines = "\n".join(f"{n} = {value}" for n, value in options.items())
    path = folder / "tuning.toml"
    path.write_text(FILE.format(kind=kind, options=lines), encoding="utf-8")
    method = read_tuning(path, FirstOrder().system()).method
    assert method is not None
    return method


def unstable_task() -> TuningTask:
    """A fast loop within the band over the horizon; an integral of the wrong sign drives it away later."""
    loop = problem()[0]
    wrong = {"pid.Kp": (40.0, 60.0), "pid.Ki": (-2.0, -0.5)}
    given = loop.parameters.with_values({"pid.Kp": 50.0, "pid.Ki": -1.0}).with_bounds(wrong).freed(*wrong)
    spec = specify(SettlingTime(band=0.05))
    return TuningTask(loop, (STEP,), {}, search_space(loop, given), spec)


@pytest.mark.parametrize(("steps", "chosen"), [(3.4, "TwoPhase"), (3.6, "Racing")])
def test_a_linear_loop_whose_filter_takes_many_steps_between_two_nodes_is_raced(steps: float, chosen: str) -> None:
    """A horizon of 1 s has 40 nodes; the pole 1/Tf of the derivative's filter is the fastest of the loop."""
    loop, given = problem()
    tf = 1 / (40 * steps * RK4_MAX_H_LAMBDA)
    given = given.with_values({"pid.Kp": 0.5, "pid.Tf": tf}).fixed("pid.Kp").with_bounds({"pid.Ki": (0.0, 20.0)})
    task = TuningTask(loop, (STEP,), {}, search_space(loop, given), specify(SettlingTime()))
    assert type(choose_method(task)).__name__ == chosen


@pytest.fixture(params=list(METHODS))
def kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def test_its_key_and_options_are_read_from_a_tunings_file(kind: str, tmp_path: Path) -> None:
    method = read(kind, tmp_path, SMALL[kind])
    assert isinstance(method, METHODS[kind])
    for n, value in SMALL[kind].items():
        assert getattr(method, n) == (tuple(value) if isinstance(value, list) else value), n


@pytest.mark.parametrize(
    ("options", "message"),
    [({"margin": 1.5}, "margin is a fraction"), ({"digits": 1}, "digits"), ({"nonsense": 1}, "nonsense")],
)
def test_bad_options_are_named_with_file_and_section(
    kind: str, options: dict[str, object], message: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=rf"tuning.toml: \[method\].*{message}"):
        read(kind, tmp_path, options)


def test_its_fields_say_margin_and_digits(kind: str) -> None:
    """By which a search is widened and gains are printed."""
    assert {"margin", "digits"} <= {f.name for f in fields(METHODS[kind])}
    method = METHODS[kind]()
    assert 0 <= method.peak_margin <= 1
    assert 0 < method.shorten(0.01).margin == 0.01


def test_a_short_search_keeps_what_was_chosen() -> None:
    """The seed decides the answer; a search that is small already does not grow."""
    chosen = Racing(members=10, trials=300, polish=0, seed=7, digits=None)
    few = replace(TwoPhase().solver, max_iterations=20)
    exact = TwoPhase(starts=1, seed=7, solver=few)
    assert chosen.shorten(0.01) == replace(chosen, members=6, bands=(), margin=0.01)
    assert Racing().shorten(0.01).members < Racing().members
    assert Racing(members=5).shorten(0.01).members == 5
    assert exact.shorten(0.01) == replace(exact, margin=0.01)


def test_it_finds_a_certified_design_and_reports_progress(kind: str, tmp_path: Path) -> None:
    (loop, given), heard = problem(), list[str]()
    found = tune(
        loop,
        STEP,
        given,
        minimise=SettlingTime(),
        subject_to=LIMITS,
        method=read(kind, tmp_path, SMALL[kind]),
        progress=heard.append,
        plants={},
    )
    assert found.status.converged
    assert found.certified.loc["Overshoot"].max() <= 5.0
    assert heard
    assert set(found.stats) >= {"optimum", "margin", "seconds"}


def test_it_hands_no_unstable_loop_to_the_certificate(kind: str, tmp_path: Path) -> None:
    task = unstable_task()
    found = prepare_search(task, read(kind, tmp_path, SMALL[kind])).run()
    assert np.isfinite(found.certified.loc["SettlingTime"].to_numpy(dtype=float)).all()  # over the horizon all is well
    assert found.status.code is Code.INFEASIBLE
    assert "stable" in str(found.status)


def test_it_can_be_interrupted(kind: str, tmp_path: Path) -> None:
    loop, given = problem()

    def stop(_: str) -> None:
        raise KeyboardInterrupt

    method = read(kind, tmp_path, SMALL[kind])
    found = tune(loop, STEP, given, minimise=SettlingTime(), method=method, progress=stop, throw=False, plants={})
    assert found.status.code is Code.INTERRUPTED
    assert found.parameters.value("pid.Kp") == given.value("pid.Kp")


def test_what_it_refuses_does_not_suit_it(kind: str) -> None:
    """Over tasks that some of them cannot do: whoever suits one passes its own check."""
    loop, given = problem(Dither(80.0))
    space, method = search_space(loop, given), METHODS[kind]()
    plain = TuningTask(loop, (STEP,), {}, space, specify(SettlingTime(), LIMITS))
    tasks = [plain, replace(plain, scenarios={"heavy": {"plant.gain": 2.0}})]
    tasks += [replace(task, spec=specify(SettlingTime(), [Ripple(0.1)])) for task in tasks]
    refused = 0
    for task in tasks:
        try:
            method.check(task)
        except InputError:
            refused += 1
            assert not method.suits(task)
        assert choose_method(task).suits(task)
    assert refused == {"two_phase": 3, "racing": 0}[kind]


@pytest.mark.parametrize("gone", ["screening", "condensed"])
def test_a_file_that_names_a_method_of_old_is_told_its_successor(gone: str, tmp_path: Path) -> None:
    message = rf"tuning.toml: \[method\]: '{gone}' is gone; write kind = 'racing', whose options are members, trials"
    with pytest.raises(InputError, match=message):
        read(gone, tmp_path, {"generations": 3})


@pytest.mark.parametrize(
    ("method", "option", "value"),
    [
        *((method, "seed", value) for method in (Racing, TwoPhase) for value in (-1, 1.5, None, "1")),
        *((method, "margin", value) for method in (Racing, TwoPhase) for value in (float("nan"), "1 %")),
        *((method, "digits", value) for method in (Racing, TwoPhase) for value in (2.5, "4")),
        *((Racing, "members", value) for value in (float("inf"), 40.5, "40", None)),
        *((Racing, "bands", value) for value in (2.5, "abc", (float("nan"),), ("2",))),
        *((TwoPhase, "nodes", value) for value in ((40,), 40, "ab", (40.5, 50), (40, 50, 60))),
        (TwoPhase, "starts", 1.5),
        (TwoPhase, "solver", FullSpace),
    ],
)
def test_a_wrong_option_is_refused_where_the_method_is_made(
    method: type[Racing | TwoPhase], option: str, value: object
) -> None:
    with pytest.raises(InputError, match=f"^{method.__name__}: {option} "):
        method(**{option: value})  # type: ignore[arg-type]
