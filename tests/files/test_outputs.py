"""The declaration of what --json writes: a right schema. tests/cli holds each output to it.

A result is read as it was saved, to the last digit; a damaged file is one error; nothing else is left behind.
"""

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from jsonschema import Draft202012Validator, ValidationError
from pandas.testing import assert_frame_equal

from pneuopt.dynamics.hooks import IdentificationHints, SeparatingRun
from pneuopt.evaluation.certificate import Certificate, Defect, Finding
from pneuopt.files.first_files import first_files
from pneuopt.files.outputs import OUTPUTS, RESULT_KINDS, Holds, Member, load_result, members_of, output_schema
from pneuopt.identification.result import ChosenWindow, IdentificationResult, Mark, Verdict
from pneuopt.identification.select_model import ModelSelection
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.quantities.results import Result
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.tuning.result import TuningResult
from pneuopt.tuning.validation import DesignValidation


def test_the_schema_is_one() -> None:
    Draft202012Validator.check_schema(output_schema())
    assert set(output_schema()["$defs"]) == set(OUTPUTS)


@pytest.mark.parametrize(
    ("document", "right"),
    [
        ({"fit": [], "provenance": {"sha256[fit.toml]": "0f"}}, True),
        ({"fit": []}, False),
        ({"fit": [], "provenance": {}, "more": 1}, False),
        ({"fit": [{"log": "a"}], "provenance": {}}, False),
        ({"certified": [{"name": "0 to 0.2", "Overshoot": None}], "provenance": {}}, True),
        ({"certified": [{"name": "0 to 0.2", "Overshoot": [1]}], "provenance": {}}, False),
    ],
)
def test_a_wrong_output_is_refused(document: object, right: bool) -> None:
    validator = Draft202012Validator(output_schema())
    if right:
        validator.validate(document)
    else:
        with pytest.raises(ValidationError):
            validator.validate(document)


def test_init_writes_it() -> None:
    assert "schemas/output.json" in first_files("force", ParameterSet({}), {})


class Ending(Enum):
    GOOD = "good"
    BAD = "bad"


@dataclass(frozen=True)
class Found:
    """What a search has found.

    Attributes
    ----------
    value : float
        Of the cost [1]. The least one.
    ending : Ending
        How it ended.
    steps, tries : int
        How many.
    why : mapping of str to str, optional
    places : dict
        What no output holds.
    """

    value: float
    ending: Ending
    steps: int
    tries: int
    why: Mapping[str, str] | None
    places: dict[str, object]

    @property
    def is_good(self) -> bool:
        """Whether it ended well."""
        return self.ending is Ending.GOOD


def test_the_members_of_an_output_are_those_that_a_results_type_declares() -> None:
    assert members_of(Found, ("is_good", "value", "ending", "tries", "why")) == {
        "is_good": Member("whether it ended well", Holds.FLAG),
        "value": Member("of the cost", Holds.NUMBER),
        "ending": Member("how it ended; one of good, bad", Holds.TEXT),
        "tries": Member("how many", Holds.COUNT),
        "why": Member("why", Holds.WORDS, is_optional=True),
    }
    with pytest.raises(TypeError, match=r"Found\.places: no output holds"):
        members_of(Found)


NUMBER = st.floats(width=64)
NAME = st.text('abcäμ.[]_"\\\n', min_size=1, max_size=8)
TEXT = st.text(max_size=12)


def column(values: st.SearchStrategy[Any]) -> st.SearchStrategy[list[Any]]:
    return st.lists(values, min_size=3, max_size=3)


@st.composite
def parameter_sets(draw: st.DrawFn) -> ParameterSet:
    found = {}
    for name in draw(st.lists(NAME, max_size=4, unique=True)):
        low, value, high = sorted(draw(st.lists(st.floats(allow_nan=False), min_size=3, max_size=3)))
        found[name] = Parameter(value, draw(TEXT), low, high, free=draw(st.booleans()), source=draw(TEXT))
    return ParameterSet(found)


@st.composite
def fits(draw: st.DrawFn) -> IdentificationResult:
    names = draw(st.lists(NAME, min_size=3, max_size=3, unique=True))
    marks, units = column(st.sampled_from([m.value for m in Mark])), column(TEXT)
    numbers = {n: draw(column(NUMBER)) for n in ("value", "stderr", "ci_low", "ci_high", "bias")}
    told = {
        "at_bound": draw(column(st.booleans())),
        "mark": draw(marks),
        "unit": draw(units),
        "note": draw(column(TEXT)),
    }
    estimates = pd.DataFrame({**numbers, **told}, index=names)
    covariance = pd.DataFrame(np.array(draw(column(column(NUMBER)))), index=names, columns=names)
    rows = {"nrmse": draw(column(NUMBER)), "samples": draw(column(st.integers(0, 10**9))), "unit": draw(units)}
    logs = pd.MultiIndex.from_arrays([names, ["position"] * 3], names=["log", "channel"])
    t = np.cumsum(draw(column(st.floats(1e-3, 1.0))))
    known = pd.DataFrame({"identifiable": draw(column(st.booleans())), "inflation": numbers["value"]}, index=names)
    run = SeparatingRun(frozenset(names), frozenset(), draw(TEXT))
    return IdentificationResult(
        draw(parameter_sets()),
        estimates,
        covariance,
        pd.DataFrame(rows, index=logs),
        {names[0]: Trajectory(t, {"speed": draw(column(NUMBER))})},
        Status(draw(st.sampled_from(Code)), tuple(draw(st.lists(TEXT, max_size=3)))),
        {n: draw(NUMBER) for n in draw(st.lists(NAME, max_size=3, unique=True))},
        draw(st.dictionaries(NAME, TEXT, max_size=3)),
        Verdict(known, (tuple(names),), {names[0]: "why"}, (names[1],), IdentificationHints(runs=(run,))),
        draw(st.none() | st.just(ChosenWindow(1.0, 0.5, math.inf, 0.1))),
    )


def same(a: Any, b: Any) -> bool:
    """Whether two values are equal in class and content, NaN equal to NaN."""
    if isinstance(a, pd.DataFrame):
        assert_frame_equal(a, b, check_exact=True, check_frame_type=False)
        return True
    if isinstance(a, IdentificationHints):
        return (a.runs, a.widths, dict(a.at_least)) == (b.runs, b.widths, dict(b.at_least))
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b, equal_nan=True)
    if isinstance(a, float):
        return a == b or (math.isnan(a) and math.isnan(b))
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[n], b[n]) for n in a)
    if isinstance(a, tuple):
        return len(a) == len(b) and all(map(same, a, b))
    if hasattr(a, "__dataclass_fields__"):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    return bool(a == b)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
@given(fit=fits())
def test_a_fit_is_read_as_it_was_saved(fit: IdentificationResult, tmp_path: Path) -> None:
    fit.save(tmp_path / "fit.json")
    assert [p.name for p in tmp_path.iterdir()] == ["fit.json"]
    assert same(load_result(tmp_path / "fit.json"), fit)


def design() -> TuningResult:
    table = pd.DataFrame({"0 to 1": {"SettlingTime": math.nan, "Overshoot": 0.1 + 0.2}})
    margins = pd.DataFrame([{"case": "0 to 1", "point": "at rest", "MaxSensitivity": math.inf, "stable": False}])
    finding = Finding(Defect.HUNTS, "0 to 1", "it hunts")
    figures = pd.DataFrame({"median": [1.0], "worst_plant": ["plant 3"], "violations": [2]}, index=["SettlingTime"])
    return TuningResult(
        ParameterSet({"pid.Kp": Parameter(2.0, "V", 0.0, 9.0, log=False, free=True)}),
        table,
        table * 2,
        pd.DataFrame({"claimed": [1.0], "room": [math.nan], "active": [True], "case": ["0 to 1"]}, index=["Overshoot"]),
        pd.DataFrame(columns=["asked", "needed", "share"]),
        ("pid.Kp",),
        Status(Code.NOT_CERTIFIED, ("it hunts", "a remedy")),
        {"seconds": 1.5, "simulations": 100},
        {"pneuopt": "0.2"},
        Certificate(table, (finding,), ("a note",), margins, {"Overshoot": "%"}),
        DesignValidation(figures, table.T, table, {"plant 3": ("hunts",)}, ("mass",), ("advice",), {"x": "s"}),
        None,
        {"pid.Kp": 1.0},
        {"": "m", "Overshoot": "%"},
        {"Overshoot": 5.0},
    )


def test_a_design_is_read_as_it_was_saved_and_prints_the_same(tmp_path: Path) -> None:
    (best := design()).save(tmp_path / "best.json")
    again = load_result(tmp_path / "best.json")
    assert isinstance(again, TuningResult)
    assert same(replace(again, relaxations=best.relaxations), best)
    assert list(again.relaxations) == list(best.relaxations)
    assert again.relaxations.empty
    assert repr(again) == repr(best)


def test_every_kind_of_result_can_be_read_again() -> None:
    results = {kind.__name__ for kind in Result.__subclasses__() if kind.__module__.startswith("pneuopt.")}
    assert results == set(RESULT_KINDS)


def message_or_result(path: Path) -> tuple[str, Any]:
    try:
        return "", load_result(path)
    except InputError as error:
        return str(error), None


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
@given(data=st.data())
def test_a_damaged_file_is_one_error_that_names_it(data: st.DataObject, tmp_path: Path) -> None:
    path = tmp_path / "best.json"
    design().save(path)
    whole = path.read_bytes()
    place = data.draw(st.integers(0, len(whole) - 2))
    how = data.draw(st.sampled_from(["cut", "flip", "drop"]))
    changed = {
        "cut": whole[:place],
        "flip": whole[:place] + bytes([whole[place] ^ data.draw(st.integers(1, 255))]) + whole[place + 1 :],
        "drop": whole[:place] + whole[place + 1 :],
    }
    path.write_bytes(changed[how])
    said, again = message_or_result(path)
    assert (str(path) in said and "\n" not in said) or repr(again) == repr(design()), "a blank between members"


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (lambda d: d.update(format=1), "has format 1, this pneuopt reads 2"),
        (lambda d: d.update(pneuopt="TuningResul"), "did you mean 'TuningResult'"),
        (lambda d: d["result"]["status"].update(code="fine"), "was damaged or changed"),
        (lambda d: d.pop("sha256"), "not a result that pneuopt has saved"),
    ],
)
def test_what_is_wrong_with_a_file_is_said(edit: Any, said: str, tmp_path: Path) -> None:
    path = tmp_path / "best.json"
    design().save(path)
    document = json.loads(path.read_text(encoding="utf-8"))
    edit(document)
    path.write_text(json.dumps(document), encoding="utf-8")
    with pytest.raises(InputError, match=said):
        load_result(path)


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (lambda r: r["status"].update(code="fine"), r"result.status.code is not as pneuopt saves it"),
        (lambda r: r["parameters"]["pid.Kp"].update(value=99.0), r"holds no such result \(value 99 V lies outside"),
        (lambda r: r["certified"]["columns"][0][2].pop(), r"result.certified is not as"),
        (lambda r: r.update(extra=1), r"result.extra is not as"),
        (lambda r: r.pop("claimed"), r"result.claimed is not as"),
        (lambda r: r["limits"].update(Overshoot="5 %"), r"result.limits.Overshoot is not as"),
    ],
)
def test_a_file_of_another_hand_with_a_right_hash_is_named_by_its_member(edit: Any, said: str, tmp_path: Path) -> None:
    path = tmp_path / "best.json"
    design().save(path)
    document = json.loads(path.read_text(encoding="utf-8"))
    edit(document["result"])
    text = json.dumps(document["result"], sort_keys=True)
    document["sha256"] = hashlib.sha256(text.encode()).hexdigest()
    path.write_text(json.dumps(document), encoding="utf-8")
    with pytest.raises(InputError, match=said):
        load_result(path)


def test_a_folder_that_is_not_there_is_named_and_a_selection_holds_its_fits(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="the folder does not exist"):
        design().save(tmp_path / "nowhere" / "best.json")
    with pytest.raises(InputError, match="cannot be read"):
        load_result(tmp_path / "best.json")
    table = pd.DataFrame({"free": [2], "converged": [True], "contains": [""]}, index=["stribeck"])
    chosen = ModelSelection(table, "stribeck", "as said", {})
    chosen.save(tmp_path / "chosen.json")
    assert same(load_result(tmp_path / "chosen.json"), chosen)
