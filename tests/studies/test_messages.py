"""What is said of studies that cannot be: what triggers each message, and its words."""

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pneuopt as po
from pneuopt.quantities.errors import InputError, ModelError, PneuoptError, UnknownNameError
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.quantities.status import Code, Status
from pneuopt.studies.bootstrap import bootstrap
from pneuopt.studies.executors import Processes, open_executor
from pneuopt.studies.journal import Journal
from pneuopt.studies.sensitivity import search_again, sweep_from_neighbours
from pneuopt.studies.sweep import grid, read_cases, sweep
from tests.plotting.fits import DRIVE, TRUTH, fit_of, fitted

RIG = ParameterSet(
    {
        "load.mass": Parameter(5.0, "kg", 0.1, 100.0),
        "load.force": Parameter(10.0, "N"),
        "supply.pressure": Parameter(7e5, "Pa(a)"),
    }
)
LOOP, STEP = po.ClosedLoop(po.SecondOrder().system(), po.PID(), po.Dither(frequency=160.0)), po.Step(1.0)
CASES, SPREADS = {"a": {"plant.gain": 1.0}}, {"plant.gain": 0.1}
batch = partial(po.evaluate_batch, LOOP, STEP, LOOP.parameters)
derivatives = partial(po.local_sensitivity, LOOP, STEP, LOOP.parameters)
LOG, RUN = fitted()
FIT = fit_of(TRUTH, {LOG.name: RUN})
LOST = replace(FIT, status=Status(Code.NOT_CONVERGED, ("lost",)))


def indices(fn: Callable[[ParameterSet], float] = len, spread: str = "load.mass", **options: Any) -> object:
    return po.sensitivity(fn, RIG, {spread: 0.1}, executor=ThreadPoolExecutor(1), **{"count": 16, **options})


def enter(word: str) -> None:
    with open_executor(word):
        pass


def fails(_: ParameterSet) -> float:
    raise InputError("no plant")


REFUSALS: dict[str, tuple[type[PneuoptError], Callable[[], object], str]] = {
    "no axis": (InputError, lambda: grid(RIG, {}), "a grid needs an axis"),
    "axis without values": (InputError, lambda: grid(RIG, {"load.mass": []}), "axis load.mass: no values"),
    "value twice": (
        InputError,
        lambda: grid(RIG, {"load.mass": [2.0, 3.0, 2.0]}),
        "axis load.mass: a value is there twice",
    ),
    "value out of bounds": (
        InputError,
        lambda: grid(RIG, {"load.mass": [2.0, 200.0]}),
        r"axis: load.mass: value 200 kg lies outside its bounds \[0.1, 100\]",
    ),
    "value NaN": (InputError, lambda: grid(RIG, {"load.mass": [np.nan]}), "load.mass: a parameter's value is NaN"),
    "unknown axis": (
        InputError,
        lambda: grid(RIG, {"load.mas": [2.0]}),
        "axis: unknown parameter 'load.mas'; did you mean 'load.mass'",
    ),
    "no case": (InputError, lambda: sweep(len, RIG, {}), "a study needs a case"),
    "case out of bounds": (
        InputError,
        lambda: sweep(len, RIG, {"light": {"load.mass": 1.0}, "heavy": {"load.mass": 1e3}}),
        r"heavy: load\.mass: value 1000 kg lies outside its bounds",
    ),
    "case of an unknown parameter": (
        UnknownNameError,
        lambda: sweep(len, RIG, {"heavy": {"load.mas": 1.0}}),
        r"heavy: unknown parameter 'load\.mas'",
    ),
    "axis that the search finds": (
        InputError,
        lambda: sweep_from_neighbours(len, RIG, {"load.mass": [1.0]}, value="x", starts={"found": "load.mass"}),
        "load.mass: an axis of the study and found by its search",
    ),
    "column that is not there": (
        InputError,
        lambda: search_again(
            len,
            RIG,
            sweep(len, RIG, {"a": {"load.mass": 1.0}}, executor=ThreadPoolExecutor(1)),
            axes=["load.mass"],
            value="Ts",
            starts={},
        ),
        "no column Ts",
    ),
    "journal without a folder": (InputError, lambda: Journal("none/journal", "study"), "cannot be written"),
    "journal that is not there": (
        InputError,
        lambda: Journal("none.journal", "study", resume=True),
        "there is nothing to resume; leave out --resume",
    ),
    "word of no executor": (InputError, lambda: enter("dsk"), "give a number of processes, dask, or a scheduler"),
    "no process": (InputError, lambda: enter("0"), "a process at least, got 0"),
    "no time": (InputError, lambda: Processes(None, 0.0), "time limit of a case must be positive"),
    "time NaN": (InputError, lambda: Processes(None, math.nan), "time"),
    "no memory": (InputError, lambda: Processes(None, 1.0, -1.0), "memory limit"),
    "points of no power of two": (InputError, lambda: indices(count=100), "count = 100: give a power of two, 16 or"),
    "unknown figure": (InputError, lambda: indices(figures=["speed"]), "speed"),
    "no figure": (
        InputError,
        lambda: indices(fails),
        "no case of the study gave a figure: InputError: no plant",
    ),
    "unknown spread": (InputError, lambda: indices(spread="d"), "'d'"),
    "axis that moves the samples": (
        InputError,
        lambda: derivatives({"dither.frequency": 0.1}),
        r"dither\.frequency: the samples of a response hang on it",
    ),
    "derivative of a margin": (
        InputError,
        lambda: derivatives(SPREADS, metrics=["MaxSensitivity"]),
        "MaxSensitivity: not read off",
    ),
    "lanes' margin": (InputError, lambda: batch(CASES, metrics=["MaxSensitivity"]), "MaxSensitivity: not read off"),
    "share above one": (InputError, lambda: batch(CASES, recertify=2.0), "recertify is a share"),
    "unknown parameter of a batch": (InputError, lambda: batch({"a": {"nonsense": 1.0}}), "nonsense"),
    "one draw": (
        InputError,
        lambda: bootstrap(DRIVE, LOG, FIT, count=1),
        "count = 1: a spread takes two sets of logs at least",
    ),
    "fit that is lost": (
        InputError,
        lambda: bootstrap(DRIVE, LOG, LOST),
        "the fit has not converged: lost; mend it first",
    ),
    "fit of another log": (
        InputError,
        lambda: bootstrap(DRIVE, replace(LOG, name="other"), FIT),
        "the fit is of run_0, not of other",
    ),
    "loop": (ModelError, lambda: bootstrap(LOOP, LOG, FIT), "give the drive"),
}


@pytest.mark.parametrize("name", REFUSALS)
def test_a_refusal_says_what_is_wrong_and_what_to_do(name: str) -> None:
    kind, cause, words = REFUSALS[name]
    with pytest.raises(kind, match=words):
        cause()


@pytest.mark.parametrize("word", ["", "-1", "two", "http://host:8786"])
def test_a_word_that_names_no_executor_is_refused(word: str) -> None:
    with pytest.raises(InputError):
        enter(word)


@pytest.mark.parametrize(
    ("result", "words"),
    [
        (None, "InputError: value is NoneType; return numbers or text, by name"),
        ({"a": np.zeros(2)}, "InputError: a is ndarray; return"),
        ({"seconds": 1.0}, "seconds: a result has the name of a column of the study; rename it"),
        ({"load.mass": 1.0}, "load.mass: a result has the name"),
    ],
)
def test_results_that_are_none_say_so(result: object, words: str) -> None:
    table = sweep(lambda _: result, RIG, {"a": {"load.mass": 2.0}}, executor=ThreadPoolExecutor(1))
    assert table["error"].iloc[0].startswith(words)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("load.mas\n1\n", "unknown parameter 'load.mas'; did you mean 'load.mass'"),
        ("load.mass [m]\n1\n", r"load\.mass \[m\].*m"),
        ("supply.pressure [bar]\n7\n", "bar"),
        ("load.mass\n1\n\nlight\n", "load.mass: row 2 is no number"),
        ("load.mass,supply.pressure\n1,\n", "supply.pressure: row 1 is no number"),
        ("load.mass\n1\n200\n", r"row 2: load\.mass: value 200 kg lies outside its bounds"),
        ("load.mass,load.mass [g]\n1,2\n", "a parameter has two columns"),
        ("case,load.mass\na,1\na,2\n", "two cases have the same name"),
        ("case\na\n", "no case; it needs a row, and a column of a parameter"),
        ("load.mass\n", "no case"),
        ("", "is no table of cases in CSV"),
        ('load.mass\n1\n"2\n3,4\n', "is no table of cases in CSV"),
        ("load.mass\n\xff\x00\n", "plants.csv: "),
        (None, "cannot be read"),
    ],
)
def test_a_bad_table_is_refused_in_one_line(tmp_path: Path, text: str | None, words: str) -> None:
    path = tmp_path / "plants.csv"
    if text is not None:
        path.write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=words) as raised:
        read_cases(RIG, path)
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)
