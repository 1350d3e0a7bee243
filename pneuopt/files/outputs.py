"""What the commands write with --json, by the types of the results: for the schema and `pneuopt keys --outputs`.

Numbers are in SI units unless a name or a "unit" beside them says otherwise; what is not finite is null; a table is a
list of records, one a row. Members may be added from version to version; none is renamed without the changelog.

`load_result`: a result as its `save` has written it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path
from types import NoneType
from typing import Any, get_args

from pneuopt.evaluation.certificate import Certificate
from pneuopt.evaluation.dither import CompensatorVerdict, DitherVerdict
from pneuopt.evaluation.limit_cycle import RestCheck
from pneuopt.experiments.design import ExperimentDesign
from pneuopt.files.tuned import CertificateCheck
from pneuopt.identification.checkup import Assumption, LogRow
from pneuopt.identification.result import (
    AgreementRow,
    ChosenWindow,
    EstimateRow,
    IdentifiableRow,
    IdentificationResult,
    TrailRow,
    Verdict,
)
from pneuopt.identification.select_model import ModelSelection
from pneuopt.identification.tracking import LogComparison
from pneuopt.logs.doctor import LogFinding
from pneuopt.quantities.keys import argument_meanings, first_sentence
from pneuopt.quantities.parameters import Parameter
from pneuopt.quantities.results import read_result
from pneuopt.quantities.status import Status
from pneuopt.studies.sensitivity import ShareRow, SlopeRow, SpreadRow
from pneuopt.tuning.result import RequirementRow, TuningResult
from pneuopt.tuning.validation import DesignValidation

DIALECT = "https://json-schema.org/draft/2020-12/schema"
_NUMBER: dict[str, Any] = {"type": ["number", "null"]}
_ANY: dict[str, Any] = {"type": ["number", "string", "boolean", "null"]}


class Holds(Enum):
    """What a member holds, in words; the schema of each stands in `_SCHEMAS`."""

    TEXT = "text"
    TEXTS = "list of texts"
    NUMBER = "number or null"
    COUNT = "whole number"
    FLAG = "true or false"
    VALUE = "text, number or truth"
    NUMBERS = "numbers by name"
    WORDS = "texts by name"
    LISTS = "lists of texts by name"
    GROUPS = "list of lists of texts"
    COUNTS = "list of whole numbers"
    RECORDS = "records of texts by name"
    RECORD = "record"
    ROWS = "table"


@dataclass(frozen=True)
class Member:
    """A member of an output."""

    meaning: str
    holds: Holds = Holds.NUMBER
    members: Mapping[str, "Member"] = field(default_factory=dict)  # of a record, or of each row of a table
    is_open: bool = False  # whether a row has further columns, which are named after metrics, parameters or references
    is_optional: bool = False  # whether it is there only where there is something to say


def output_schema() -> dict[str, Any]:
    """The JSON Schema of what `--json` writes: any of the commands' outputs, each by its name under "$defs"."""
    return {
        "$schema": DIALECT,
        "title": "what pneuopt writes with --json",
        "anyOf": [{"$ref": f"#/$defs/{name}"} for name in OUTPUTS],
        "$defs": {name: {"title": member.meaning, **_record(member)} for name, member in OUTPUTS.items()},
    }


def describe_outputs() -> str:
    """The outputs as tables in Markdown, one a command."""
    parts = []
    for name, output in OUTPUTS.items():
        rows = [f"| `{n}` | {m.holds.value} | {describe_member(m)} |" for n, m in output.members.items()]
        parts.append("\n".join([f"**{name}**: {output.meaning}", "", "| member | holds | |", "|---|---|---|", *rows]))
    return "\n\n".join(parts)


def describe_member(member: Member) -> str:
    """What a member means, and what it has in it."""
    own = ", ".join(f"`{n}`" for n in member.members)
    further = " and more" if member.is_open and own else ""
    optional = "; not always there" if member.is_optional else ""
    return f"{member.meaning}{': ' if own else ''}{own}{further}{optional}"


def _record(member: Member) -> dict[str, Any]:
    return {
        "type": "object",
        "properties": {
            name: {"description": own.meaning, **_SCHEMAS[own.holds](own)} for name, own in member.members.items()
        },
        "required": [name for name, own in member.members.items() if not own.is_optional],
        "additionalProperties": _ANY if member.is_open else False,
    }


def _by_name(values: dict[str, Any]) -> dict[str, Any]:
    return {"type": "object", "additionalProperties": values}


_SCHEMAS: Mapping[Holds, Any] = {
    Holds.TEXT: lambda _: {"type": "string"},
    Holds.TEXTS: lambda _: {"type": "array", "items": {"type": "string"}},
    Holds.NUMBER: lambda _: _NUMBER,
    Holds.COUNT: lambda _: {"type": "integer"},
    Holds.FLAG: lambda _: {"type": "boolean"},
    Holds.VALUE: lambda _: _ANY,
    Holds.NUMBERS: lambda _: _by_name(_NUMBER),
    Holds.WORDS: lambda _: _by_name({"type": "string"}),
    Holds.LISTS: lambda _: _by_name({"type": "array", "items": {"type": "string"}}),
    Holds.GROUPS: lambda _: {"type": "array", "items": {"type": "array", "items": {"type": "string"}}},
    Holds.COUNTS: lambda _: {"type": "array", "items": {"type": "integer"}},
    Holds.RECORDS: lambda _: _by_name(_by_name({"type": "string"})),
    Holds.RECORD: _record,
    Holds.ROWS: lambda member: {"type": "array", "items": _record(member)},
}


def _text(meaning: str) -> Member:
    return Member(meaning, Holds.TEXT)


def _rows(meaning: str, members: Mapping[str, Member], *, is_open: bool = False) -> Member:
    return Member(meaning, Holds.ROWS, members, is_open)


def _optional(member: Member) -> Member:
    return replace(member, is_optional=True)


_HOLDS: Mapping[Any, Holds] = {
    str: Holds.TEXT,
    float: Holds.NUMBER,
    int: Holds.COUNT,
    bool: Holds.FLAG,
    float | str | bool: Holds.VALUE,
    tuple[str, ...]: Holds.TEXTS,
    list[str]: Holds.TEXTS,
    tuple[int, int]: Holds.COUNTS,
    tuple[tuple[str, ...], ...]: Holds.GROUPS,
    Mapping[str, str]: Holds.WORDS,
    Mapping[str, Mapping[str, str]]: Holds.RECORDS,
}


def members_of(kind: type, only: Sequence[str] = (), *, are_optional: bool = False) -> dict[str, Member]:
    """The members that a dataclass or TypedDict declares: `only` these fields and properties, in this order."""
    meanings = argument_meanings(kind)
    found = {}
    for name in only or tuple(kind.__annotations__):
        own, is_optional, meaning = getattr(kind, name, None), are_optional, meanings.get(name, "")
        if isinstance(own, property):
            annotation, meaning = own.fget.__annotations__["return"], first_sentence(own.fget)
        else:
            annotation = kind.__annotations__[name]
        parts = [part for part in get_args(annotation) if part is not NoneType]
        if NoneType in get_args(annotation):
            annotation, is_optional = parts[0], True
        is_word = isinstance(annotation, type) and issubclass(annotation, Enum)
        if not is_word and annotation not in _HOLDS:
            raise TypeError(f"{kind.__name__}.{name}: no output holds {annotation}")
        words = f"one of {', '.join(str(word.value) for word in annotation)}" if is_word else ""
        text = "; ".join(filter(None, [meaning or name.replace("_", " "), words]))
        found[name] = Member(text, Holds.TEXT if is_word else _HOLDS[annotation], is_optional=is_optional)
    return found


_STATUS = Member("how it ended", Holds.RECORD, members_of(Status, ("code", "message")))
_PROVENANCE = Member("versions, options, SHA-256 of what was read", Holds.WORDS)
_STATS = Member("figures of the search, as the result's docstring says", Holds.NUMBERS)
_NAMED = {"name": _text("what the row is of")}
_FIT = _rows(
    "agreement, a row a log and channel",
    {"log": _text("name"), "channel": _text("name"), **members_of(AgreementRow)},
    is_open=True,
)
_IDENTIFIABLE = {"name": _text("parameter"), **members_of(IdentifiableRow)}
_VERDICT = Member(
    "what the logs identify; empty where nothing was tried",
    Holds.RECORD,
    {
        **members_of(
            Verdict,
            ("sentences", "unidentifiable", "unchanged", "indistinguishable", "reasons"),
            are_optional=True,
        ),
        "table": _optional(_rows("a row a free parameter", _IDENTIFIABLE)),
    },
)
_ESTIMATES = {"name": _text('parameter, "name[log]" for one of a log'), **members_of(EstimateRow)}
_METRICS = "a row a reference or case, a column a metric, in the metric's unit"
_GAINS = {
    "name": _text("parameter"),
    **members_of(Parameter, ("value", "unit", "lower", "upper", "log", "free", "per_log", "source")),
}
_REQUIREMENTS = {"name": _text("metric"), **members_of(RequirementRow)}
_DITHER = {
    **members_of(DitherVerdict, ("usefulness", "reasons")),
    "rival": Member("gains tuned without it", Holds.NUMBERS, is_optional=True),
}
_OF_AN_AXIS = {"figure": _text("metric"), "axis": _text("parameter or pattern")}


def _output(meaning: str, **members: Member) -> Member:
    return Member(meaning, Holds.RECORD, members)


_STOPPED = _optional(replace(_STATUS, meaning="only where it was interrupted"))
OUTPUTS: Mapping[str, Member] = {
    "check": _output(
        "`pneuopt check`",
        verdict=_text("whether a fit takes the logs"),
        read=_rows("a row a log", members_of(LogRow)),
        assumed=_rows("values that stand in no file", members_of(Assumption, ("name", "value", "unit", "key"))),
        found=_rows("what is wrong", members_of(LogFinding, ("severity", "log", "rows", "check", "message"))),
        identifiable=_rows("a row a free parameter", _IDENTIFIABLE),
        reasons=Member("why one is not, by parameter", Holds.WORDS),
        runs=Member("by run that would help: the parameters", Holds.LISTS),
    ),
    "identify": _output(
        "`pneuopt identify`",
        status=_STATUS,
        estimates=_rows("a row a free parameter", _ESTIMATES),
        fit=_FIT,
        verdict=_VERDICT,
        window=Member("windows in which logs were fitted", Holds.RECORD, members_of(ChosenWindow), is_optional=True),
        trail=_rows("a row a try of the search", members_of(TrailRow)),
        bootstrap=_optional(_rows("with --bootstrap, a row an estimate", _NAMED, is_open=True)),
        stats=_STATS,
        provenance=_PROVENANCE,
    ),
    "select": _output(
        "`pneuopt identify --select`",
        status=_STATUS,
        recommended=_text("a model"),
        reason=_text("in a sentence"),
        candidates=_rows("a row a model, the best first", _NAMED, is_open=True),
    ),
    "tune": _output(
        "`pneuopt tune`, `pneuopt certify`",
        status=_STATUS,
        gains=_rows("a row a tuned parameter", _GAINS),
        claimed=_rows(f"by the search; {_METRICS}", _NAMED, is_open=True),
        certified=_rows(f"by the independent simulation; {_METRICS}", _NAMED, is_open=True),
        requirements=_rows("a row an objective or limit", _REQUIREMENTS),
        relaxations=_rows("where no design found keeps all limits, a row a limit", _NAMED, is_open=True),
        active=Member("what keeps the objective from being smaller", Holds.TEXTS),
        best=Member("the best candidate's gains where none is certified [SI]", Holds.NUMBERS, is_optional=True),
        notes=Member("what the certificate notes", Holds.TEXTS, is_optional=True),
        validation=_optional(_rows("on new plants, a row a requirement", _NAMED, is_open=True)),
        trail=_optional(_rows("how a design for other plants was sought", {"way": _text("its name")}, is_open=True)),
        structures=_optional(
            _rows("other structures of the controller", {"structure": _text("its name")}, is_open=True)
        ),
        dither=Member("the verdict on the dither", Holds.RECORD, _DITHER, is_optional=True),
        stats=_STATS,
        provenance=_PROVENANCE,
    ),
    "simulate": _output(
        "`pneuopt simulate FIT TUNING`",
        certified=_rows(_METRICS, _NAMED, is_open=True),
        certificate=Member(
            "whether a tuned.toml's holds", Holds.RECORD, members_of(CertificateCheck), is_optional=True
        ),
        provenance=_PROVENANCE,
    ),
    "predict": _output("`pneuopt simulate FIT --log LOG`", fit=_FIT, provenance=_PROVENANCE),
    "study": _output(
        "`pneuopt study` of cases",
        status=_STOPPED,
        verdict=_text("how many hold"),
        cases=_rows("a row a case: parameters, metrics, seconds, error", {"case": _text("name")}, is_open=True),
        checks=_optional(_rows("of a batch, a row a certified metric", {"case": _text("name")}, is_open=True)),
        provenance=_PROVENANCE,
    ),
    "sensitivity": _output(
        "`pneuopt study` of a [sensitivity]",
        status=_STOPPED,
        verdict=_text("how many points hold"),
        shares=_rows("a row a metric and axis, with 95 % intervals", _OF_AN_AXIS | members_of(ShareRow)),
        figures=_rows("a row a metric over the box", _NAMED | members_of(SpreadRow)),
        slopes=_optional(
            _rows("with local, a row a metric and axis at the design", _OF_AN_AXIS | members_of(SlopeRow))
        ),
        cases=_rows("a row a point: parameters, metrics, seconds, error", {"case": _text("name")}, is_open=True),
        provenance=_PROVENANCE,
    ),
    "front": _output(
        "`pneuopt study` of a [pareto]",
        status=_STOPPED,
        verdict=_text("how many are certified"),
        designs=_rows("a row a design: both requirements, gains, error", {"error": _text("or empty")}, is_open=True),
        units=Member("of requirements and gains", Holds.WORDS),
        provenance=_PROVENANCE,
    ),
    "next-experiment": _output(
        "`pneuopt next-experiment`",
        design=_rows("a row a free parameter, before and after the runs", _NAMED, is_open=True),
        stats=_STATS,
        provenance=_PROVENANCE,
    ),
    "track": _output(
        "`pneuopt track`",
        drift=_rows("a row a parameter", _NAMED, is_open=True),
        history=_rows("a row a parameter and date", {}, is_open=True),
        design=_optional(_rows("with --tuned, a row a date", {}, is_open=True)),
        provenance=_PROVENANCE,
    ),
}
"""The outputs by name, and their members."""


RESULT_KINDS: dict[str, type] = {
    kind.__name__: kind
    for kind in (
        *(IdentificationResult, ModelSelection, LogComparison, ExperimentDesign),
        *(TuningResult, DesignValidation, Certificate, RestCheck, DitherVerdict, CompensatorVerdict),
    )
}


def load_result(path: str | Path) -> Any:
    """Read a result that was saved: ``fit.save("fit.json")``, then ``load_result("fit.json")``.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    IdentificationResult, TuningResult or another
        Of the class that was saved, with the same numbers to the last digit. What a model needs of a log's motion
        (`Verdict.identification_hints.needs`) is not in it.

    Raises
    ------
    InputError
        If the file cannot be read, is no result, or was damaged or changed; nothing in it is ever run as code.
    """
    return read_result(path, RESULT_KINDS)
