"""The cases of a study.toml that are no grid: [samples], [corners] or the rows of a [table]."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pneuopt.evaluation.monte_carlo import monte_carlo
from pneuopt.evaluation.scenarios import SampleSpreads, corners
from pneuopt.files.budget import MAX_CASES
from pneuopt.files.drive import read_covariance, read_estimates
from pneuopt.files.spreads import CORNERS_KEY, SAMPLED_KEY, SAMPLES_KEY, read_draw, read_sample_spreads, read_spreads
from pneuopt.quantities.errors import InputError, check_names, require
from pneuopt.quantities.keys import Key, Takes, flag, table
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.studies.cases import read_cases

if TYPE_CHECKING:
    from pneuopt.files.study import Study

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
            "points, a power of two; so often each parameter and two more are evaluated", Takes.COUNT, usual=128
        ),
        "seed": Key("of the random numbers", Takes.COUNT, usual=0),
        "local": flag("whether the slopes at the design are computed, too"),
    },
    others=SAMPLED_KEY,
    named="parameter",
)


@dataclass(frozen=True)
class CaseSource:
    """What the reader of a section needs beside it.

    Attributes
    ----------
    where : str
        What messages begin with.
    folder : Path
        To which files are relative.
    drive : Path
    parameters : ParameterSet
        The nominal values.
    """

    where: str
    folder: Path
    drive: Path
    parameters: ParameterSet


def read_study_cases(study: "Study", parameters: ParameterSet) -> Cases:
    """Read the cases that a study's file asks for in place of a grid.

    Parameters
    ----------
    study : Study
        With `cases`.
    parameters : ParameterSet
        The nominal values.

    Returns
    -------
    dict of str to dict of str to float

    Raises
    ------
    InputError
        The message names file, section and key.
    """
    ((kind, given),) = study.cases.items()
    source = CaseSource(f"{study.path}: [{kind}]", study.path.parent, study.drive, parameters)
    try:
        cases = _READERS[kind](given, source)
    except InputError as error:
        raise error if str(study.path.parent) in str(error) else InputError(f"{source.where} {error}") from None
    require(len(cases) <= MAX_CASES, f"{source.where} makes {len(cases)} cases, {MAX_CASES} are allowed; take fewer")
    return cases


@dataclass(frozen=True)
class SensitivityTask:
    """What a [sensitivity] asks for.

    Attributes
    ----------
    spreads : mapping
        As for `samples`.
    count, seed : int
    local : bool
        Whether derivatives at the design are asked for, too.
    """

    spreads: SampleSpreads
    count: int
    seed: int
    local: bool


def read_sensitivity(study: "Study", parameters: ParameterSet) -> SensitivityTask:
    """Read the [sensitivity] of a study.

    Parameters
    ----------
    study : Study
        With `sensitivity`.
    parameters : ParameterSet
        The nominal values.

    Returns
    -------
    SensitivityTask

    Raises
    ------
    InputError
        The message names file, section and key.
    """
    entries, where = dict(study.sensitivity or {}), f"{study.path}: [sensitivity]"
    known = SENSITIVITY_KEY.keys
    count, seed, local = (entries.pop(key, known[key].usual) for key in ("count", "seed", "local"))
    whole = all(isinstance(n, int) and not isinstance(n, bool) for n in (count, seed))
    require(whole and seed >= 0, f"{where} count and seed are whole numbers, seed not below 0")
    require(isinstance(local, bool), f"{where} local must be true or false, got {local!r}")
    require(count >= 16 and count & (count - 1) == 0, f"{where} count: a power of two, 16 or more, not {count}")
    example = '"load.mass" = "30 %"'
    require(len(entries) > 0, f"{where} has no parameter; add {example}")
    spreads = read_sample_spreads(entries, where, parameters)
    cases = count * (len(spreads) + 2)
    require(cases <= MAX_CASES, f"{where} makes {cases} cases, {MAX_CASES} are allowed; take a smaller count")
    return SensitivityTask(spreads, count, seed, local)


def _read_samples(given: Mapping[str, Any], source: CaseSource) -> Cases:
    entries, where = dict(given), source.where
    stated = {key: entries.pop(key) for key in CASE_KEYS["samples"].keys if key in entries}
    from_fit = stated.pop("fit", False)
    require(isinstance(from_fit, bool), f"{where} fit must be true or false, got {from_fit!r}")
    draw, covariance = read_draw(stated, where), read_covariance(source.drive) if from_fit else None
    needed = f"{where} fit = true needs a fit.toml, which identify writes; {source.drive} has no estimates"
    require(not from_fit or covariance is not None, needed)
    return monte_carlo(
        source.parameters,
        draw.count,
        covariance=covariance,
        estimates=read_estimates(source.drive) if from_fit else None,
        spreads=read_sample_spreads(entries, where, source.parameters),
        seed=draw.seed,
        sampling=draw.sampling,
    )


def _read_corners(given: Mapping[str, Any], source: CaseSource) -> Cases:
    many = len(given) >= MAX_CASES.bit_length()
    require(not many, f"{source.where}: {len(given)} parameters have too many corners; take [samples]")
    return corners(source.parameters, read_spreads(given, source.where, source.parameters))


def _read_table(given: Mapping[str, Any], source: CaseSource) -> Cases:
    check_names("key", given, CASE_KEYS["table"].keys, source.where)
    require(isinstance(given.get("file"), str), f'{source.where} names no file; write file = "plants.csv"')
    return read_cases(source.parameters, source.folder / given["file"])


_READERS: Mapping[str, Callable[[Mapping[str, Any], CaseSource], Cases]] = {
    "samples": _read_samples,
    "corners": _read_corners,
    "table": _read_table,
}
