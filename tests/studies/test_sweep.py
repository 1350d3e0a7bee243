"""Studies: named cases, their table, and what becomes of them when something fails or is interrupted."""

import importlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing import active_children, get_context
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.dynamics.system import System, discretise
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.requirements import PeakControl, SettlingTime
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Asymmetric, Coulomb, LuGre
from pneuopt.models.linear import FirstOrder, Integrator, SecondOrder
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.quantities.status import Progress
from pneuopt.studies.executors import INTERRUPTED_CASE
from pneuopt.studies.sweep import grid, read_cases, sweep
from pneuopt.tuning.tune import tune

RIG = ParameterSet(
    {
        "load.mass": Parameter(5.0, "kg", 0.1, 100.0),
        "load.force": Parameter(10.0, "N"),
        "supply.pressure": Parameter(7e5, "Pa(a)"),
    }
)
MODULE = """
import os, time

def acceleration(p):
    return p.value("load.force") / p.value("load.mass")

def troubled(p):
    mass = p.value("load.mass")
    if mass == 2.0:
        raise ValueError("two\\nlines")
    if mass == 3.0:
        os._exit(7)
    if mass == 8.0:
        os._exit(0)
    if mass == 4.0:
        return [1, 2]
    if mass == 5.0:
        raise SystemExit("enough")
    return {"mass": mass, "process": os.getpid()}

def interrupting(p):
    if p.value("load.mass") == 2.0:
        raise KeyboardInterrupt
    return 0.0

def sleeping(p):
    time.sleep(p.value("load.mass"))
    return 1.0

def hung(p):
    time.sleep(60 * (p.value("load.mass") > 1.0))
    return 1.0
"""


@pytest.fixture
def functions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """A module that other processes can import, too."""
    (tmp_path / "study_functions.py").write_text(MODULE, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    yield importlib.import_module("study_functions")
    del sys.modules["study_functions"]
    assert active_children() == []


@pytest.fixture
def threads() -> Iterator[Executor]:
    with ThreadPoolExecutor(2) as executor:
        yield executor


def masses(*values: float) -> dict[str, dict[str, float]]:
    return {f"{v:g} kg": {"load.mass": v} for v in values}


def test_a_grid_names_every_combination_the_last_axis_first() -> None:
    cases = grid(RIG, {"supply.pressure": [5e5, 7e5], "load.mass": np.array([2, 8])})
    assert list(cases) == [
        "supply.pressure = 5 bar(a), load.mass = 2 kg",
        "supply.pressure = 5 bar(a), load.mass = 8 kg",
        "supply.pressure = 7 bar(a), load.mass = 2 kg",
        "supply.pressure = 7 bar(a), load.mass = 8 kg",
    ]
    assert list(cases.values())[1] == {"supply.pressure": 5e5, "load.mass": 8.0}


def test_neighbours_in_a_grid_keep_names_of_their_own() -> None:
    assert len(grid(RIG, {"load.mass": [2.0, np.nextafter(2.0, 3.0), 2.00000001]})) == 3


def test_processes_give_what_a_loop_gives_in_the_order_of_the_cases(functions: ModuleType) -> None:
    cases = grid(RIG, {"load.mass": [8.0, 2.0, 4.0], "load.force": [0.0, 20.0]})
    news: list[Progress] = []
    table = sweep(functions.acceleration, RIG, cases, progress=news.append)
    assert [(n.job, n.done, n.total) for n in news] == [("sweep", k, 6) for k in range(1, 7)]
    assert list(table.columns) == ["case", "load.mass", "load.force", "value", "seconds", "error"]
    assert table["case"].tolist() == list(cases)
    expected = [functions.acceleration(RIG.with_values(case)) for case in cases.values()]
    assert table["value"].tolist() == expected
    assert table[["load.mass", "load.force"]].to_numpy().tolist() == [list(c.values()) for c in cases.values()]
    assert (table["seconds"] >= 0).all()
    assert (table["error"] == "").all()
    assert [n.partition(",")[0] for n in news] == [f"{k} of 6 cases" for k in range(1, 7)]


@pytest.mark.parametrize("processes", [1, 2])  # one alone: another has to take the place of one that died
def test_whatever_happens_to_a_case_stays_in_its_row(
    functions: ModuleType, processes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: processes)
    table = sweep(functions.troubled, RIG, masses(1, 2, 3, 4, 5, 6, 7, 8)).set_index("case")
    assert table["mass"].dropna().to_dict() == {"1 kg": 1, "6 kg": 6, "7 kg": 7}
    assert (table["process"].dropna() != os.getpid()).all()
    error = table["error"].to_dict()
    assert [error[f"{k} kg"] for k in (1, 6, 7)] == ["", "", ""]
    assert error["2 kg"].startswith("ValueError: two lines (study_functions.py, line ")
    assert error["3 kg"] == "its process died twice (exit code 7)"
    assert error["8 kg"] == "its process died twice (exit code 0)"
    assert error["4 kg"] == "InputError: value is list; return numbers or text, by name"
    assert error["5 kg"].startswith("SystemExit: enough")


def test_a_study_of_nothing_but_failures_is_a_table(threads: Executor) -> None:
    table = sweep(lambda p: p.value("load.mas"), RIG, masses(1, 2), executor=threads)
    assert list(table.columns) == ["case", "load.mass", "seconds", "error"]
    assert table["error"].tolist() == ["UnknownNameError: unknown parameter 'load.mas'; did you mean 'load.mass'?"] * 2


@pytest.mark.parametrize(
    ("result", "columns"),
    [
        (np.float64(2.0), {"value": 2.0}),
        (True, {"value": True}),
        ({"a": 1, "b": "good"}, {"a": 1, "b": "good"}),
        (pd.Series({"a": 1.0, "b": 2.0}), {"a": 1.0, "b": 2.0}),
        (pd.DataFrame({"a": [1.0], "b": [2.0]}), {"a": 1.0, "b": 2.0}),
        (pd.DataFrame({"0 to 1": {"a": 1.0, "b": 2.0}}), {"a": 1.0, "b": 2.0}),
        (
            pd.DataFrame({"up": {"a": 1.0, "b": 2.0}, "down": {"a": 3.0, "b": 4.0}}),
            {"a[up]": 1.0, "b[up]": 2.0, "a[down]": 3.0, "b[down]": 4.0},
        ),
    ],
)
def test_results_become_columns(threads: Executor, result: object, columns: dict[str, object]) -> None:
    (row,) = sweep(lambda _: result, RIG, {"as given": {}}, executor=threads).to_dict("records")
    seconds = row.pop("seconds")
    assert row == {"case": "as given", **columns, "error": ""}
    assert seconds >= 0


def test_cases_may_be_whole_sets_and_differ_in_what_they_change(threads: Executor) -> None:
    other = RIG.with_values({"load.mass": 6.0}) | ParameterSet({"rod": Parameter(0.012, "m")})
    table = sweep(len, RIG, {"as given": {}, "force": {"load.force": 3.0}, "other": other}, executor=threads)
    assert table["value"].tolist() == [3, 3, 4]
    assert table["load.force"].tolist() == [10, 3, 10]
    assert table["load.mass"].tolist() == [5, 5, 6]
    assert table["rod"].fillna(-1).tolist() == [-1, -1, 0.012]


def test_a_function_that_cannot_travel_is_refused_with_the_remedy(functions: ModuleType) -> None:
    lock = threading.Lock()
    for fn in (lambda _: 1.0, partial(functions.acceleration, lock)):
        with pytest.raises(
            InputError, match=r"cannot go to other processes.*a function of a module.*functools\.partial"
        ):
            sweep(fn, RIG, masses(2))
    with ProcessPoolExecutor(1, get_context("spawn")) as pool, pytest.raises(InputError, match="cannot go to other"):
        sweep(lambda _: 1.0, RIG, masses(2), executor=pool)
    Path(functions.__file__ or "").unlink()
    with pytest.raises(InputError, match=r"cannot be loaded by other processes: ModuleNotFoundError.*in a module that"):
        sweep(functions.acceleration, RIG, masses(2))


def test_a_script_without_a_main_guard_is_refused_with_the_remedy(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "from pneuopt import Parameter, ParameterSet, sweep\n"
        "sweep(len, ParameterSet({'a': Parameter(1.0, 'm')}), {'one': {'a': 2.0}})\n",
        encoding="utf-8",
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    said = (
        'InputError: the processes of a study cannot start; a script must call the study under `if __name__ == "__main'
    )
    assert said in done.stderr


def test_any_executor_will_do(functions: ModuleType, threads: Executor) -> None:
    cases = masses(0.2, 0.1)
    expected = sweep(functions.sleeping, RIG, cases, executor=threads)
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        found = sweep(functions.sleeping, RIG, cases, executor=pool)
        broken = sweep(functions.troubled, RIG, masses(3), executor=pool)
    assert found.drop(columns="seconds").equals(expected.drop(columns="seconds"))
    assert broken["error"].iloc[0].startswith("BrokenProcessPool: ")
    assert sweep(lambda _: 1.0, RIG, cases, executor=AtOnce())["value"].tolist() == [1.0, 1.0]


class AtOnce(Executor):
    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(fn(*args, **kwargs))
        return future


def test_an_interruption_keeps_what_is_done_and_ends_what_runs(functions: ModuleType) -> None:
    def interrupt(_: str) -> None:
        raise KeyboardInterrupt

    table = sweep(functions.hung, RIG, masses(1, 2, 3, 4), progress=interrupt)
    assert table["error"].tolist() == ["", *[INTERRUPTED_CASE] * 3]
    assert table["value"].fillna(-1).tolist() == [1.0, -1, -1, -1]
    assert table["load.mass"].tolist() == [1, 2, 3, 4]
    assert table["seconds"].isna().tolist() == [False, True, True, True]


def test_a_function_may_interrupt_the_study(functions: ModuleType) -> None:
    with ThreadPoolExecutor(1) as one:
        table = sweep(functions.interrupting, RIG, masses(1, 2, 3), executor=one)
    assert table["error"].tolist() == ["", INTERRUPTED_CASE, INTERRUPTED_CASE]


@contextmanager
def running_study(folder: Path, *, before: str = "", after: str = "") -> "Iterator[subprocess.Popen[str]]":
    """A script with a study whose second case hangs, once the first is done."""
    script = folder / "script.py"
    script.write_text(
        "import signal\n"
        "from pneuopt import Parameter, ParameterSet, sweep\n"
        "from study_functions import hung\n"
        f"{before}\n"
        "if __name__ == '__main__':\n"
        "    rig = ParameterSet({'load.mass': Parameter(1.0, 'kg')})\n"
        "    cases = {'quick': {}, 'hung': {'load.mass': 2.0}, 'never': {'load.mass': 3.0}}\n"
        "    table = sweep(hung, rig, cases, progress=lambda line: print(line, flush=True))\n"
        f"    {after}\n",
        encoding="utf-8",
    )
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, script], stdout=pipe, stderr=pipe, text=True, start_new_session=True) as run:
        assert run.stdout is not None
        assert run.stdout.readline() == "1 of 3 cases\n"
        yield run


@pytest.mark.skipif(os.name == "nt", reason="sends SIGINT to a group of processes")
def test_ctrl_c_in_a_terminal_reaches_everybody_and_loses_nothing(functions: ModuleType, tmp_path: Path) -> None:
    listen = "signal.signal(signal.SIGINT, signal.default_int_handler)"  # a background job ignores it
    with running_study(tmp_path, before=listen, after="print(table['error'].tolist())") as run:
        os.killpg(run.pid, signal.SIGINT)
        out, err = run.communicate(timeout=30)
    assert (run.returncode, out, err) == (0, "['', 'interrupted', 'interrupted']\n", "")


@pytest.mark.skipif(os.name == "nt", reason="sends SIGINT to a group of processes")
@pytest.mark.parametrize("slow", [1, 2])
def test_ctrl_c_is_quiet_in_a_process_that_still_starts(functions: ModuleType, tmp_path: Path, slow: int) -> None:
    """One that imported the user's script printed a traceback of its own."""
    late = (
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "import multiprocessing, time\n"
        f"if multiprocessing.current_process().name.endswith('-{slow}'):\n"
        "    time.sleep(2)"
    )
    with running_study(tmp_path, before=late, after="print(table['error'].tolist())") as run:
        os.killpg(run.pid, signal.SIGINT)
        out, err = run.communicate(timeout=30)
    assert (run.returncode, out, err) == (0, "['', 'interrupted', 'interrupted']\n", "")


@pytest.mark.skipif(os.name == "nt", reason="no process ends without a word there")
def test_the_processes_of_a_study_that_is_killed_end_with_it(functions: ModuleType, tmp_path: Path) -> None:
    """They hold its pipes: a shell that reads them waited for ever."""
    with running_study(tmp_path) as run:
        run.kill()
        try:
            run.communicate(timeout=30)
        finally:
            with suppress(ProcessLookupError):
                os.killpg(run.pid, signal.SIGKILL)


SYSTEMS = {
    "force": ForceDrive(Asymmetric(LuGre())).system(),
    "first order": FirstOrder(2).system(),
    "second order": SecondOrder(1, Coulomb()).system(),
    "integrator": Integrator().system(),
}


@pytest.mark.parametrize("name", SYSTEMS)
def test_systems_travel(name: str, threads: Executor) -> None:
    import pickle

    system = SYSTEMS[name]
    copy: System = pickle.loads(pickle.dumps(system))
    assert (repr(copy), repr(copy.start_hook)) == (repr(system), repr(system.start_hook))
    x, u, p = (np.full(system.ode.size1_in(i), 0.3) for i in (1, 2, 3))
    for ours, theirs in zip(copy.ode(0, x, u, p), system.ode(0, x, u, p), strict=True):
        assert np.array_equal(np.array(ours), np.array(theirs))
    assert repr(pickle.loads(pickle.dumps(discretise(system)))) == repr(discretise(system))


def test_a_closed_loop_is_certified_elsewhere_with_the_same_figures(functions: ModuleType) -> None:
    loop = ClosedLoop(ForceDrive(Coulomb()).system(), PID(sample_time=2e-3), Dither(frequency=50.0))
    given = loop.parameters.with_values({"pid.Kp": 200.0, "pid.Ki": 2e4, "pid.lower": -300.0, "pid.upper": 300.0})
    study, cases = partial(evaluate, loop, [Step(0.2, horizon=0.5)]), masses(4.0, 6.0)
    here = evaluate(loop, [Step(0.2, horizon=0.5)], given.with_values(cases["6 kg"]))  # its caches are filled now
    table = sweep(study, given, cases)
    assert table["error"].tolist() == ["", ""]
    there = table[list(here.index)].to_numpy(dtype=float)[1]
    assert there == pytest.approx(here["0 to 0.2"].to_numpy(), rel=1e-9, nan_ok=True)
    assert 0 < table["SettlingTime"].iloc[0] != table["SettlingTime"].iloc[1] > 0


def test_what_a_table_takes_is_imported_before_the_cases_are_computed() -> None:
    """After Ctrl-C two seconds are left, in which pandas is not imported on a loaded machine."""
    program = """
import sys
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.studies import sweep
def stop(*_):
    print("pandas" in sys.modules)
    sys.exit()
sweep.run_in_processes = stop
sweep.sweep(str, ParameterSet({"mass": Parameter(5.0, "kg")}), {"one": {}})
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "True\n"


def test_rows_of_a_file_become_cases_in_si(tmp_path: Path) -> None:
    path = tmp_path / "plants.csv"
    path.write_text("load.mass [g],case,supply.pressure [bar(a)]\n4000,left,5\n6500,right,7\n", encoding="utf-8")
    assert read_cases(RIG, path) == {
        "left": {"load.mass": 4.0, "supply.pressure": 5e5},
        "right": {"load.mass": 6.5, "supply.pressure": 7e5},
    }


def test_rows_without_a_name_are_counted_and_plain_columns_are_si() -> None:
    assert read_cases(RIG, pd.DataFrame({"load.mass": [4, 5]})) == {
        "row 1": {"load.mass": 4.0},
        "row 2": {"load.mass": 5.0},
    }


def test_a_study_of_tunings_has_a_row_a_case() -> None:
    loop = ClosedLoop(FirstOrder().system(), PID(limits=False))
    given = loop.parameters.with_bounds({"pid.Kp": (0.1, 20.0), "pid.Ki": (0.0, 200.0)}).freed("pid.Kp", "pid.Ki")
    tuned = partial(tune, loop, Step(1.0), minimise=SettlingTime(), subject_to=[PeakControl(4.0)], plants={})
    times = {"quick": {"plant.time_constant": 0.1}, "slow": {"plant.time_constant": 0.5}}
    with ThreadPoolExecutor(1) as threads:
        table = sweep(tuned, given, times, executor=threads)
    assert table["error"].tolist() == ["", ""]
    assert table["status"].tolist() == ["converged", "converged"]
    assert (table["PeakControl"] <= 4.0).all()
    assert table["SettlingTime"].tolist() == sorted(table["SettlingTime"])
    for row in table.to_dict(orient="records"):
        gains = {n: float(row[n]) for n in ("plant.time_constant", "pid.Kp", "pid.Ki")}
        own = evaluate(loop, Step(1.0), given.with_values(gains))["0 to 1"]
        assert row["SettlingTime"] == pytest.approx(own["SettlingTime"], rel=1e-6)
