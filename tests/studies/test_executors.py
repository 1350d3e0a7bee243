"""The same study in one thread, in two processes and on a cluster of dask: identical tables, bit for bit."""

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
from pneuopt.studies.executors import Processes, _Crew, open_executor, run_in_processes
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
