"""A case that hangs, needs too much memory, dies or gives NaN costs no other, and says so."""

import importlib
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.studies.executors import Processes
from pneuopt.studies.outcome import evaluate_case
from pneuopt.studies.sweep import sweep

RIG = ParameterSet({"load.mass": Parameter(5.0, "kg", 0.1, 100.0)})
MODULE = """
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
def functions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """A module that other processes can import, too."""
    (tmp_path / "limited_functions.py").write_text(MODULE, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    yield importlib.import_module("limited_functions")
    del sys.modules["limited_functions"]


def masses(*values: float) -> dict[str, dict[str, float]]:
    return {f"{v:g} kg": {"load.mass": v} for v in values}


@pytest.mark.skipif(sys.platform != "linux", reason="limits memory")
def test_a_case_that_hangs_or_fills_the_memory_is_said_and_costs_no_other(functions: ModuleType) -> None:
    one = Processes(1, seconds=3.0, megabytes=1000.0)
    table = sweep(functions.greedy, RIG, masses(*range(1, 10)), executor=one).set_index("case")
    bad = table["error"][table["error"] != ""].to_dict()
    assert bad == {
        "3 kg": "killed: took longer than the 3 s that a case may take",
        "5 kg": "needs more memory than the 1000 MB that a case may take",
        "7 kg": "all its numbers are NaN",
    }
    assert table["a"].dropna().tolist() == [1, 2, 4, 6, 8, 9]
    assert table.loc["7 kg", "word"] == "poor"


def test_a_dead_process_costs_its_chunk_alone_which_is_tried_again(functions: ModuleType, tmp_path: Path) -> None:
    from functools import partial

    table = sweep(partial(functions.unlucky, str(tmp_path)), RIG, masses(*range(1, 31)), executor=Processes(1))
    assert table["error"][table["error"] != ""].to_dict() == {8: "its process died twice (exit code 9)"}
    assert table["value"].dropna().tolist() == [k for k in range(1, 31) if k != 9]


def test_nan_is_a_reason_where_no_number_came_out() -> None:
    def outcome(result: object) -> str:
        return evaluate_case(lambda _: result, RIG, {}).error

    assert outcome(math.nan) == "value is NaN"
    assert outcome({"a": math.nan, "b": math.nan}) == "all its numbers are NaN"
    assert outcome({"a": math.nan, "b": 1.0}) == ""
    assert outcome({"word": "none"}) == ""


def test_a_process_that_grows_is_replaced_and_its_successor_goes_on(
    functions: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The new process has the function, too: its first case was an assertion that failed, and ended the study."""
    monkeypatch.setenv("LOKY_MAX_MEMORY_LEAK_SIZE", "1e6")
    table = sweep(functions.hoarding, RIG, masses(1, 2, 3), executor=Processes(1))
    assert table["error"].tolist() == [""] * 3
    assert max(table["hoarded"]) < 3  # not all in one process
