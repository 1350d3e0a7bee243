"""The same study in one thread, in two processes and on a cluster of dask: identical tables, bit for bit.

A case that hangs, needs too much memory, dies or gives NaN costs no other, and says so.
"""

import importlib
import math
import sys
import warnings
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.scenarios import Distribution, Normal, Sampling, Spread, samples
from pneuopt.models.linear import FirstOrder
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.studies.executors import Processes, _Crew, evaluate_case, open_executor, run_in_processes
from pneuopt.studies.sweep import sweep

RIG = ParameterSet({"mass": Parameter(5.0, "kg", 0.1, 100.0), "gain": Parameter(2.0, "1")})
MODULE = """
import os
import numpy as np

def spectrum(p):
    mass, gain = p.value("mass"), p.value("gain")
    matrix = np.sin(np.outer(np.arange(40), np.arange(40)) * mass + gain)
    values = np.linalg.eigvalsh(matrix @ matrix.T)
    if mass > 5.4:
        raise ValueError("heavy")
    return {"norm": float(np.linalg.norm(matrix @ matrix)), "trace": float(values.sum()), "word": f"{mass:.3f}"}

def deadly(p):
    if p.value("mass") == 3.0:
        os._exit(3)
    return p.value("mass")
"""


@pytest.fixture
def functions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    (tmp_path / "cluster_functions.py").write_text(MODULE, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}")
    yield importlib.import_module("cluster_functions")
    del sys.modules["cluster_functions"]


@pytest.fixture
def dask(functions: ModuleType) -> Iterator[Executor]:
    pytest.importorskip("distributed", reason="dask is not installed: pip install 'pneuopt[cluster]'")
    with open_executor("dask") as executor:
        assert isinstance(executor, Executor)
        yield executor


def assert_identical(found: pd.DataFrame, expected: pd.DataFrame) -> None:
    found, expected = found.drop(columns="seconds"), expected.drop(columns="seconds")
    pd.testing.assert_frame_equal(found, expected, check_exact=True)
    for n in expected.select_dtypes("number"):
        assert found[n].to_numpy(dtype=float).tobytes() == expected[n].to_numpy(dtype=float).tobytes()


@pytest.mark.filterwarnings("default")  # dask's own
def test_the_table_is_the_same_wherever_it_is_computed(functions: ModuleType, dask: Executor) -> None:
    spreads: dict[str, Spread | Distribution] = {"mass": Normal(0.05), "gain": 0.3}
    cases = samples(RIG, spreads, 64, seed=4, sampling=Sampling.SOBOL)
    with ThreadPoolExecutor(1) as one:
        serial = sweep(functions.spectrum, RIG, cases, executor=one)
    assert 0 < (serial["error"] != "").sum() < 32
    assert np.isfinite(serial["norm"]).sum() > 32
    workers: Any = dask
    assert workers._max_workers == sum(
        workers._client.nthreads().values()
    )  # which makes chunks as large as they may be
    for executor in (Processes(1), Processes(2), dask):
        assert_identical(sweep(functions.spectrum, RIG, cases, executor=executor), serial)


@pytest.mark.filterwarnings("default")  # dask's own
def test_a_dead_worker_of_a_cluster_costs_one_case(functions: ModuleType, dask: Executor) -> None:
    cases = {f"{m:g} kg": {"mass": m} for m in np.arange(1.0, 9.0).tolist()}
    table = sweep(functions.deadly, RIG, cases, executor=dask).set_index("case")
    assert list(table.index[table["error"] != ""]) == ["3 kg"]
    assert table["error"].to_dict()["3 kg"].startswith("KilledWorker: ")


@pytest.mark.filterwarnings("default")  # dask's own
def test_a_certified_loop_is_the_same_on_a_cluster(dask: Executor) -> None:
    loop = ClosedLoop(FirstOrder().system(), PID(sample_time=1e-2))
    given = loop.complete(loop.parameters.with_values({"pid.Kp": 2.0, "pid.Ki": 5.0}))
    cases = samples(given, {"plant.gain": 0.2}, 3, seed=1)
    certify = partial(evaluate, loop, Step(0.1, horizon=1.0))
    with ThreadPoolExecutor(1) as one:
        serial = sweep(certify, given, cases, executor=one)
    assert (serial["error"] == "").all()
    assert_identical(sweep(certify, given, cases, executor=dask), serial)


def test_without_dask_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with (
        pytest.raises(InputError, match=r"dask is not installed; pip install 'pneuopt\[cluster\]'"),
        open_executor("dask"),
    ):
        pass


@pytest.mark.filterwarnings("default")  # dask's own
def test_a_scheduler_that_is_not_there_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed", reason="dask is not installed: pip install 'pneuopt[cluster]'")
    monkeypatch.setattr("pneuopt.studies.executors.CONNECT_SECONDS", 0.2)
    with pytest.raises(InputError, match="there is no dask scheduler"), open_executor("tcp://127.0.0.1:1"):
        pass


def test_memory_is_limited_on_linux_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "win32")
    with pytest.raises(InputError, match="needs Linux; leave it out"):
        Processes(megabytes=100.0)
    assert Processes(seconds=1.0).count is None


def test_the_users_filters_of_warnings_are_as_they_were(monkeypatch: pytest.MonkeyPatch) -> None:
    """Within, the successor of a process that had grown is no news: its chunk goes on."""
    before = list(warnings.filters)
    monkeypatch.setattr(
        _Crew, "start", lambda _: warnings.warn("A worker was restarted while some jobs were given", stacklevel=1)
    )
    outcomes = dict(run_in_processes(Processes(), len, RIG, [("a", RIG)], 1))
    assert "no process could be started" in outcomes["a"].error
    assert list(warnings.filters) == before


@pytest.mark.parametrize(
    ("option", "value"),
    [("count", 2.5), ("count", "2"), ("count", math.inf), ("seconds", "60 s"), ("seconds", None), ("megabytes", [])],
)
def test_a_limit_that_is_no_number_is_named(option: str, value: object) -> None:
    with pytest.raises(InputError, match=f"^Processes: {option} takes .*; got "):
        Processes(**{option: value})  # type: ignore[arg-type]


RIG_OUTCOME = ParameterSet({"load.mass": Parameter(5.0, "kg", 0.1, 100.0)})
MODULE_OUTCOME = """
import os, time
from pathlib import Path

def greedy(p):
    mass = p.value("load.mass")
    if mass == 3.0:
        time.sleep(60)
    if mass == 5.0:
        return len(bytearray(3 * 2**30))
    if mass == 7.0:
        return {"a": float("nan"), "word": "poor"}
    return {"a": mass, "word": "good"}

def hoarding(p):
    HOARD.append(os.urandom(20_000_000))
    time.sleep(1.1)  # loky looks once a second
    return {"hoarded": len(HOARD)}

HOARD = []

def unlucky(folder, p):
    mass = p.value("load.mass")
    seen = Path(folder) / f"{mass}"
    seen.write_text(seen.read_text() + "x" if seen.exists() else "x")
    if mass == 6.0 and len(seen.read_text()) < 3:  # its process is shot from outside, in its chunk and alone
        os._exit(9)
    if mass == 9.0:
        os._exit(9)
    return mass
"""


@pytest.fixture
def functions_of_outcome(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """A module that other processes can import, too."""
    (tmp_path / "limited_functions.py").write_text(MODULE_OUTCOME, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    yield importlib.import_module("limited_functions")
    del sys.modules["limited_functions"]


def masses(*values: float) -> dict[str, dict[str, float]]:
    return {f"{v:g} kg": {"load.mass": v} for v in values}


@pytest.mark.skipif(sys.platform != "linux", reason="limits memory")
def test_a_case_that_hangs_or_fills_the_memory_is_said_and_costs_no_other(functions_of_outcome: ModuleType) -> None:
    one = Processes(1, seconds=3.0, megabytes=1000.0)
    table = sweep(functions_of_outcome.greedy, RIG_OUTCOME, masses(*range(1, 10)), executor=one).set_index("case")
    bad = table["error"][table["error"] != ""].to_dict()
    assert bad == {
        "3 kg": "killed: took longer than the 3 s that a case may take",
        "5 kg": "needs more memory than the 1000 MB that a case may take",
        "7 kg": "all its numbers are NaN",
    }
    assert table["a"].dropna().tolist() == [1, 2, 4, 6, 8, 9]
    assert table.loc["7 kg", "word"] == "poor"


def test_a_dead_process_costs_its_chunk_alone_which_is_tried_again(
    functions_of_outcome: ModuleType, tmp_path: Path
) -> None:
    from functools import partial

    table = sweep(
        partial(functions_of_outcome.unlucky, str(tmp_path)), RIG_OUTCOME, masses(*range(1, 31)), executor=Processes(1)
    )
    assert table["error"][table["error"] != ""].to_dict() == {8: "its process died twice (exit code 9)"}
    assert table["value"].dropna().tolist() == [k for k in range(1, 31) if k != 9]


def test_nan_is_a_reason_where_no_number_came_out() -> None:
    def outcome(result: object) -> str:
        return evaluate_case(lambda _: result, RIG_OUTCOME, {}).error

    assert outcome(math.nan) == "value is NaN"
    assert outcome({"a": math.nan, "b": math.nan}) == "all its numbers are NaN"
    assert outcome({"a": math.nan, "b": 1.0}) == ""
    assert outcome({"word": "none"}) == ""


def test_a_process_that_grows_is_replaced_and_its_successor_goes_on(
    functions_of_outcome: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The new process has the function, too: its first case was an assertion that failed, and ended the study."""
    monkeypatch.setenv("LOKY_MAX_MEMORY_LEAK_SIZE", "1e6")
    table = sweep(functions_of_outcome.hoarding, RIG_OUTCOME, masses(1, 2, 3), executor=Processes(1))
    assert table["error"].tolist() == [""] * 3
    assert max(table["hoarded"]) < 3  # not all in one process
