"""study.toml: the drive, the tuning, and the axes, samples, corners or table of its cases, or a front; what to show."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pneuopt.evaluation.plants import monte_carlo
from pneuopt.evaluation.scenarios import SampleSpreads, corners
from pneuopt.files.drive import StoredFit, ambient_pressure
from pneuopt.files.loop import (
    CORNERS_KEY,
    SAMPLE_KEYS,
    SAMPLED_KEY,
    SAMPLES_KEY,
    read_bound,
    read_corner_spreads,
    read_sample_spreads,
)
from pneuopt.files.tolerances import MAX_CASES
from pneuopt.files.toml import read_toml
from pneuopt.quantities.errors import InputError, check_names, require
from pneuopt.quantities.keys import Key, Takes, check_sections, flag, read_table, table
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.units import count_gauge_from, read_unit, read_value, si_conversion, write_value
from pneuopt.studies.sweep import read_cases

Cases = dict[str, dict[str, float]]
CASE_KEYS: Mapping[str, Key] = {
    "samples": replace(
        SAMPLES_KEY,
        keys={**SAMPLES_KEY.keys, "fit": flag("whether what the drive's fit.toml has estimated is drawn, too")},
    ),
    "corners": CORNERS_KEY,
    "table": table(
        "cases that a file lists",
        {
            "file": Key(
                "a CSV file, a column a parameter: load.mass [kg]", Takes.TEXT, required=True, example='"plants.csv"'
            )
        },
    ),
}
"""The sections that say which cases there are, in place of axes; a newcomer adds a row here and in `_READERS`."""
SENSITIVITY_KEY = table(
    "which tolerances matter: the shares of a metric's variance that parameters bring, in place of cases",
    {
        "count": Key(
            "points, a power of two; so often each parameter and two more are evaluated",
            Takes.COUNT,
            usual=128,
            least=16,
        ),
        "seed": SAMPLE_KEYS["seed"],
        "local": flag("whether the slopes at the design are computed, too"),
    },
    others=SAMPLED_KEY,
    named="parameter",
)


@dataclass(frozen=True)
class CaseSource:
    """What the reader of a section needs beside it."""

    where: str  # what messages begin with
    folder: Path  # to which files are relative
    fit: StoredFit
    parameters: ParameterSet  # the nominal values


def read_study_cases(study: "Study", fit: StoredFit, parameters: ParameterSet) -> Cases:
    """Read the cases that a study's file asks for in place of a grid, of the drive in `fit`."""
    ((kind, given),) = study.cases.items()
    source = CaseSource(f"{study.path}: [{kind}]", study.path.parent, fit, parameters)
    try:
        cases = _READERS[kind](given, source)
    except InputError as error:
        raise error if str(study.path.parent) in str(error) else InputError(f"{source.where} {error}") from None
    require(len(cases) <= MAX_CASES, f"{source.where} makes {len(cases)} cases, {MAX_CASES} are allowed; take fewer")
    return cases


@dataclass(frozen=True)
class SensitivityTask:
    """What a [sensitivity] asks for."""

    spreads: SampleSpreads  # as for `samples`
    count: int
    seed: int
    local: bool  # whether derivatives at the design are asked for, too


def read_sensitivity(study: "Study", parameters: ParameterSet) -> SensitivityTask:
    """Read the [sensitivity] of a study."""
    entries, where = dict(study.sensitivity or {}), f"{study.path}: [sensitivity]"
    read = read_table(SENSITIVITY_KEY.keys, entries, where, partial=True)
    count, entries = read["count"], {n: entry for n, entry in entries.items() if n not in read}
    require(count & (count - 1) == 0, f"{where} count must be a power of two, got {count}")
    example = '"load.mass" = "30 %"'
    require(len(entries) > 0, f"{where} has no parameter; add {example}")
    spreads = read_sample_spreads(entries, where, parameters)
    cases = count * (len(spreads) + 2)
    require(cases <= MAX_CASES, f"{where} makes {cases} cases, {MAX_CASES} are allowed; take a smaller count")
    return SensitivityTask(spreads, **read)


def _read_samples(given: Mapping[str, Any], source: CaseSource) -> Cases:
    where, draw = source.where, read_table(CASE_KEYS["samples"].keys, given, source.where, partial=True)
    entries, from_fit = {n: entry for n, entry in given.items() if n not in draw}, draw["fit"]
    covariance = source.fit.covariance if from_fit else None
    needed = f"{where} fit = true needs a fit.toml, which identify writes; {source.fit.path} has no estimates"
    require(not from_fit or covariance is not None, needed)
    return monte_carlo(
        source.parameters,
        draw["count"],
        covariance=covariance,
        estimates=source.fit.estimates if from_fit else None,
        spreads=read_sample_spreads(entries, where, source.parameters),
        seed=draw["seed"],
        sampling=draw["sampling"],
    )


_READERS: Mapping[str, Callable[[Mapping[str, Any], CaseSource], Cases]] = {
    "samples": _read_samples,
    "corners": lambda given, source: corners(
        source.parameters, read_corner_spreads(given, source.where, source.parameters)
    ),
    "table": lambda given, source: read_cases(
        source.parameters, source.folder / read_table(CASE_KEYS["table"].keys, given, source.where)["file"]
    ),
}


_AXIS_EXAMPLE = '["4 kg", "8 kg"] or { from = "2 kg", to = "8 kg", steps = 4 }'
_RANGE_KEYS: Mapping[str, Key] = {
    "from": Key("first value", unit="{own}", required=True, example='"2 kg"'),
    "to": Key("last value", unit="{own}", required=True, example='"8 kg"'),
    "steps": Key("how many values", Takes.COUNT, required=True, example="4", least=2, most=MAX_CASES),
}
_SWEPT_AXIS = Key("a list of values, or a range", Takes.AXIS, "{own}", keys=_RANGE_KEYS, example='["4 kg", "8 kg"]')
STUDY_KEYS: Mapping[str, Key] = {
    "study": table(
        "what is studied; the files are relative to this one",
        {
            "drive": Key("a drive.toml or a fit.toml", Takes.TEXT, required=True, example='"fit.toml"'),
            "tuning": Key("a tuning.toml or a tuned.toml", Takes.TEXT, required=True, example='"tuned.toml"'),
            "tune": flag("whether each cell of a grid is tuned, from its neighbours' gains"),
            "batch": flag("whether cases run many at once in SIMD lanes, and only the worst and a share are certified"),
        },
        required=True,
    ),
    "axes": table("the axes of a grid, pid.sample_time among them", {}, others=_SWEPT_AXIS, named="parameter"),
    **CASE_KEYS,
    "sensitivity": SENSITIVITY_KEY,
    "metrics": table(
        "what is shown of the cases",
        {
            "band": Key(
                "half width of the settling band, of the step; by default the tuning's",
                example='"2 %"',
                least=0.0,
                most=1.0,
                is_open=True,
            ),
            "show": Key(
                "metrics on screen and in the figure",
                Takes.LIST,
                usual=["SettlingTime", "Overshoot"],
                named="metric",
                of=Key("a metric", Takes.TEXT),
                counts=(1, math.inf),
                example='["SettlingTime", "Overshoot"]',
            ),
        },
    ),
    "pareto": table(
        "a front between two requirements, in place of a grid",
        {
            "between": Key(
                "the two, by their keys in a tuning",
                Takes.LIST,
                required=True,
                example='["settling_time", "peak_control"]',
                of=Key("a requirement", Takes.TEXT),
                counts=(2, 2),
            ),
            "points": Key("designs of the front", Takes.COUNT, usual=9, least=2, most=MAX_CASES),
            "lower": Key("where the second ends; by default the least that can be", unit="{own}", example='"100 N"'),
            "upper": Key("where it begins; by default the tuning's limit", unit="{own}", example='"250 N"'),
        },
    ),
}
"""The sections of a study.toml and their keys."""


@dataclass(frozen=True)
class Study:
    """What a study.toml says."""

    path: Path
    drive: Path  # relative to the file's folder, as is the tuning
    tuning: Path
    axes: Mapping[str, Any]  # as written; `read_axes` reads them
    band: float | None  # half width of the settling band, a fraction of the step; None: as the tuning says
    show: tuple[str, ...]  # the metrics on screen and in the figure
    # a front is asked for in place of a grid: as written; `read_pareto` reads it
    pareto: Mapping[str, Any] | None = None
    # whether each cell of the grid is tuned, from the gains of its neighbours, and not only certified
    tune: bool = False
    # in place of axes, the section that says which cases there are, as written; `read_study_cases` reads it
    cases: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    # whether the cases run many at once in SIMD lanes (`evaluate_batch`), and only the worst and a share are certified
    batch: bool = False
    # it is asked which tolerances matter: as written; `read_sensitivity` reads it
    sensitivity: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class SweptAxis:
    """A parameter and its values."""

    name: str
    points: tuple[float, ...]  # its values [SI]
    unit: str  # in which the first one is written
    factor: float  # ``SI = factor * number + offset``
    offset: float

    def in_axis_unit(self, values: ArrayLike) -> NDArray[np.float64]:
        """SI values as numbers in the unit in which the axis is written."""
        return (np.asarray(values, dtype=float) - self.offset) / self.factor


@dataclass(frozen=True)
class Pareto:
    """A front between two requirements."""

    between: tuple[str, str]  # their keys, as in a tuning.toml; the second is limited step by step
    points: int
    # from where to where the second one goes, in the SI unit of its bound; None: as the tuning and the drive allow
    lower: float | None
    upper: float | None


def read_study(path: str | Path) -> Study:
    """Read a study; the files that it names are not opened."""
    path, sections = Path(path), read_toml(path).unwrap()
    check_sections(STUDY_KEYS, sections, path)
    metrics, given = (
        read_table(STUDY_KEYS[name].keys, sections.get(name, {}), f"{path}: [{name}]") for name in ("metrics", "study")
    )
    axes, band = _flatten_axes(sections.get("axes", {})), metrics["band"]
    for name in ("pareto", "table"):  # read later, in the units of the drive
        check_names("key", sections.get(name, {}), STUDY_KEYS[name].keys, f"{path}: [{name}]")
    drive, tuning = (path.parent / given[key] for key in ("drive", "tuning"))
    tune, batch = given["tune"], given["batch"]
    for name in ("axes", "metrics"):
        alone = name not in sections or "pareto" not in sections
        require(alone, f"{path}: [{name}] belongs to a grid, [pareto] to a front; leave one of them out")
    cases = {name: sections[name] for name in CASE_KEYS if name in sections}
    chosen = [*(["axes"] if axes else []), *cases, *(n for n in ("sensitivity", "pareto") if n in sections)]
    require(bool(chosen), f'{path}: no axis; add [axes] with "load.mass" = {_AXIS_EXAMPLE}')
    require(len(chosen) == 1, f"{path}: [{'], ['.join(chosen)}]: a study has cases of one kind; leave one of them out")
    require(not (tune and batch), f"{path}: [study] a batch is of one design: leave out tune or batch")
    require(not (batch and "pareto" in sections), f"{path}: [study] batch is of cases; a front is tuned: leave it out")
    require(not (tune and "pareto" in sections), f"{path}: [study] tune belongs to a grid; a front is tuned anyway")
    alone = not ("sensitivity" in sections and (tune or batch))
    require(alone, f"{path}: [sensitivity] evaluates one design: leave out tune and batch")
    require(not (tune and cases), f"{path}: [study] tune needs a grid, whose cells have neighbours: write [axes]")
    require(not (tune and band), f"{path}: [metrics] band would not be the one tuned for; state it in {tuning.name}")
    return Study(
        path,
        drive,
        tuning,
        axes,
        band,
        tuple(dict.fromkeys(metrics["show"])),
        sections.get("pareto"),
        tune,
        cases,
        batch,
        sections.get("sensitivity"),
    )


def read_axes(study: Study, parameters: ParameterSet) -> tuple[SweptAxis, ...]:
    """Read a study's axes in the units of the parameters."""
    check_names("parameter", study.axes, parameters, f"{study.path}: [axes]")
    axes = list[SweptAxis]()
    for name, entry in study.axes.items():
        where, unit = f"{study.path}: [axes] {name}", parameters[name].unit
        good = isinstance(entry, list | dict) and len(entry) > 0
        require(good, f"{where}: write a list or a range, {_AXIS_EXAMPLE}")
        with count_gauge_from(ambient_pressure(parameters)):
            if isinstance(entry, list):
                first, values = entry[0], [read_value(e, unit, where=where) for e in entry]
            else:
                ends = read_table(_RANGE_KEYS, entry, where, units={"own": unit})
                first, values = entry.get("from"), np.linspace(ends["from"], ends["to"], ends["steps"]).tolist()
            written = read_unit(first, unit)
            axes.append(SweptAxis(name, tuple(values), written, *si_conversion(written, unit, where=where)))
    cells = math.prod(len(axis.points) for axis in axes)
    require(cells <= MAX_CASES, f"{study.path}: [axes] make {cells} cells, {MAX_CASES} are allowed; take fewer values")
    return tuple(axes)


def swept_axes(parameters: ParameterSet, cases: Mapping[str, Mapping[str, float]]) -> tuple[SweptAxis, ...]:
    """The parameters in which cases differ, each with the values that it takes, in a unit that reads well."""
    names = dict.fromkeys(n for values in cases.values() for n in values)
    axes = []
    for name in names:
        points, unit = tuple(values[name] for values in cases.values() if name in values), parameters[name].unit
        written = read_unit(write_value(points[0], unit), unit)
        axes.append(SweptAxis(name, points, written, *si_conversion(written, unit)))
    return tuple(axes)


def read_pareto(study: Study, units: Mapping[str, str]) -> Pareto:
    """Read the front that a study asks for."""
    given, where = study.pareto or {}, f"{study.path}: [pareto]"
    plain = {n: key for n, key in STUDY_KEYS["pareto"].keys.items() if n not in ("lower", "upper")}
    read = read_table(plain, given, where, partial=True)
    first, second = read["between"]
    check_names("requirement", (first, second), units, f"{where} between")
    require(first != second, f"{where} between names {first} twice; a front needs two requirements")
    stated = [key for key in ("lower", "upper") if key in given]
    ends = {key: read_bound(second, given[key], units[second], f"{where} {key}") for key in stated}
    for key, value in ends.items():
        require(value > 0, f"{where} {key}: {second} must be positive, got {given[key]!r}")
    ordered = len(ends) < 2 or ends["lower"] < ends["upper"]
    require(ordered, f"{where} lower, {given.get('lower')}, is not below upper, {given.get('upper')}")
    return Pareto((first, second), read["points"], ends.get("lower"), ends.get("upper"))


def _flatten_axes(entries: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """By full name; without quotes, TOML reads `load.mass` as a table within a table."""
    found: dict[str, Any] = {}
    for key, entry in entries.items():
        nested = isinstance(entry, dict) and not _RANGE_KEYS.keys() & entry.keys()
        found |= _flatten_axes(entry, f"{prefix}{key}.") if nested else {f"{prefix}{key}": entry}
    return found
