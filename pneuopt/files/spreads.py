"""How parameters spread from plant to plant, as a tuning's scenarios and a study's cases are written."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from pneuopt.evaluation.distributions import DISTRIBUTIONS, Distribution
from pneuopt.evaluation.sampling import Sampling
from pneuopt.evaluation.scenarios import TOGETHER, Spread
from pneuopt.files.budget import MAX_CASES
from pneuopt.files.drive import ambient_pressure
from pneuopt.files.toml import construct_at
from pneuopt.quantities.errors import check_names, require
from pneuopt.quantities.keys import Key, Takes, choice, table
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.unit_algebra import difference_unit
from pneuopt.quantities.units import count_gauge_from, read_value

SPREAD_KEY = Key("a fraction, or least and largest value", Takes.SPREAD, unit="{own}", example='"30 %"')
_SECOND_IS_FRACTION = ("log_normal",)  # distributions whose second number has no unit
_SECOND_IS_DIFFERENCE = ("normal",)  # and those whose second number is a difference: no pressure level
SPREAD_KEYS: Mapping[str, Key] = {
    "distribution": choice("how it is drawn", DISTRIBUTIONS, "uniform"),
    "spread": Key(
        "a fraction; or two values: least and largest, of normal mean and deviation, of log_normal median and fraction",
        Takes.SPREAD,
        unit="{own}",
        required=True,
        example='"5 %"',
    ),
}
SAMPLE_KEYS: Mapping[str, Key] = {
    "count": Key("how many", Takes.COUNT, usual=20),
    "seed": Key("of the random numbers", Takes.COUNT, usual=0),
    "sampling": choice("how they fill the box", {s.value: s for s in Sampling}, Sampling.RANDOM.value),
}
SAMPLED_KEY = Key(
    "a fraction, least and largest value, or a distribution",
    Takes.SPREAD,
    unit="{own}",
    keys=SPREAD_KEYS,
    example='"30 %"',
)
SAMPLES_KEY = table(
    "plants drawn from a box, or from distributions", SAMPLE_KEYS, others=SAMPLED_KEY, named="parameter"
)
CORNERS_KEY = table('plants at the corners of a box; "a + b" vary together', {}, others=SPREAD_KEY, named="parameter")


@dataclass(frozen=True)
class Draw:
    """How many plants are drawn, and how."""

    count: int
    seed: int
    sampling: Sampling


def read_draw(given: Mapping[str, Any], where: str) -> Draw:
    """Read how plants are drawn; what is left out is as usual."""
    count, seed, word = (given.get(key, known.usual) for key, known in SAMPLE_KEYS.items())
    whole = all(isinstance(n, int) and not isinstance(n, bool) for n in (count, seed))
    require(whole, f"{where} count and seed are whole numbers")
    require(count <= MAX_CASES and seed >= 0, f"{where} count may be {MAX_CASES} at most, seed not below 0")
    known = SAMPLE_KEYS["sampling"].choices or {}
    check_names("sampling", [word], known, where)
    return Draw(count, seed, known[word])


def read_spreads(entries: Mapping[str, Any], where: str, parameters: ParameterSet) -> dict[str, Spread]:
    """Read by which fraction, or between which values, each pattern of parameters spreads.

    Parameters
    ----------
    entries : mapping
        Names or patterns to "30 %", or to ["3 kg", "7 kg"].
    where : str
        What the message of an error begins with.
    parameters : ParameterSet
        Gives the units.

    Raises
    ------
    InputError
        If a name is unknown, or a value cannot be read.
    """
    return {
        pattern: _read_spread(given, pattern, where, parameters)
        for pattern, given in _flatten(entries, parameters).items()
    }


def read_sample_spreads(
    entries: Mapping[str, Any], where: str, parameters: ParameterSet
) -> dict[str, Spread | Distribution]:
    """Read spreads as `read_spreads` does, and distributions: { distribution = "normal", spread = "5 %" }."""
    found: dict[str, Spread | Distribution] = {}
    for pattern, given in _flatten(entries, parameters).items():
        if not isinstance(given, dict):
            found[pattern] = _read_spread(given, pattern, where, parameters)
            continue
        spot = f"{where} {pattern}"
        check_names("key", given, SPREAD_KEYS, spot)
        require("spread" in given, f'{spot} has no spread; write {{ distribution = "normal", spread = "5 %" }}')
        word = given.get("distribution", SPREAD_KEYS["distribution"].usual)
        check_names("distribution", [word], DISTRIBUTIONS, spot)
        spread = _read_spread(given["spread"], pattern, where, parameters, word)
        found[pattern] = construct_at(partial(DISTRIBUTIONS[word], spread), spot)
    return found


def _read_spread(given: Any, pattern: str, where: str, parameters: ParameterSet, word: str = "") -> Spread:
    spot = f"{where} {pattern}"
    if not isinstance(given, list):
        return read_value(given, "1", where=spot)
    unit = parameters[parameters.match_names(pattern.split(TOGETHER, maxsplit=1)[0])[0]].unit
    require(len(given) == 2, f'{spot}: write a fraction, "30 %", or two values, the least first')
    second = difference_unit(unit) if word in _SECOND_IS_DIFFERENCE else "1" if word in _SECOND_IS_FRACTION else unit
    with count_gauge_from(ambient_pressure(parameters)):
        return read_value(given[0], unit, where=spot), read_value(given[1], second, where=spot)


def _flatten(entries: Mapping[str, Any], parameters: ParameterSet, prefix: str = "") -> dict[str, Any]:
    """By full name; without quotes, TOML reads `load.mass` as a table within a table."""
    found: dict[str, Any] = {}
    for key, entry in entries.items():
        name = f"{prefix}{key}"
        is_spread = (
            name in parameters
            or "*" in name
            or TOGETHER in name
            or not isinstance(entry, dict)
            or SPREAD_KEYS.keys() & entry.keys()
        )
        found |= {name: entry} if is_spread else _flatten(entry, parameters, f"{name}.")
    return found
