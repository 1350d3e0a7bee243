"""The [scenarios] of a tuning.toml: corners and samples of the plant, tolerances of the gains."""

from collections.abc import Iterator, Mapping
from typing import Any

from pneuopt.evaluation.scenarios import Scenarios, Spread, corners, samples, tolerances
from pneuopt.quantities.errors import InputError, check_names, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.units import read_value

SCENARIO_KINDS = ("corners", "samples", "tolerances")
VALIDATION_PLANTS = 100  # plants of each kind that a design is validated on
_SAMPLE_DEFAULTS = (("count", 20), ("seed", 0))


def read_scenarios(table: Mapping[str, Any], where: str, parameters: ParameterSet) -> Scenarios:
    """The plants and tolerances of a section, joined.

    Parameters
    ----------
    said : mapping
        By kind: names or patterns to "30 %", or to ["3 kg", "7 kg"]; under samples also count, and seed.
    where : str
        The file.
    parameters : ParameterSet
        The nominal values.

    Returns
    -------
    mapping of str to mapping

    Raises
    ------
    InputError
        The message names file, section and key.
    """
    return {name: values for part in _read_kinds(table, where, parameters, None) for name, values in part.items()}


def read_validation_scenarios(table: Mapping[str, Any], where: str, parameters: ParameterSet) -> Scenarios:
    """Plants and tolerances that `read_scenarios` has not: "fresh 1" and so on, drawn from the same boxes."""
    drawn = (values for part in _read_kinds(table, where, parameters, VALIDATION_PLANTS) for values in part.values())
    return {f"fresh {number}": values for number, values in enumerate(drawn, 1)}


def _read_kinds(
    table: Mapping[str, Any], where: str, parameters: ParameterSet, fresh: int | None
) -> Iterator[Scenarios]:
    check_names("kind", table, SCENARIO_KINDS, f"{where}: [scenarios]")
    for kind, given in table.items():
        spot = f"{where}: [scenarios.{kind}]"
        require(isinstance(given, dict), f'{spot} must be a section, with "load.mass" = "30 %" in it')
        yield _read_kind(kind, given, spot, parameters, fresh)


def _read_kind(
    kind: str, given: Mapping[str, Any], where: str, parameters: ParameterSet, fresh: int | None
) -> Scenarios:
    entries = dict(given)
    count, seed = (entries.pop(key, default) if kind == "samples" else 0 for key, default in _SAMPLE_DEFAULTS)
    require(isinstance(count, int) and isinstance(seed, int), f"{where} count and seed are whole numbers")
    try:
        spreads = _read_spreads(entries, where, parameters)
        if kind == "corners" and fresh is None:
            return corners(parameters, spreads)
        if kind != "tolerances":
            return samples(parameters, spreads, fresh or count, seed=seed if fresh is None else seed + 1)
        pairs = [n for n, spread in spreads.items() if isinstance(spread, tuple)]
        require(not pairs, f'{", ".join(pairs)}: a tolerance is a fraction, "1 %"')
        shares = {n: spread for n, spread in spreads.items() if not isinstance(spread, tuple)}
        return tolerances(parameters, shares, fresh)
    except InputError as error:
        raise error if where in str(error) else InputError(f"{where} {error}") from None


def _read_spreads(entries: Mapping[str, Any], where: str, parameters: ParameterSet) -> dict[str, Spread]:
    found: dict[str, Spread] = {}
    for pattern, given in entries.items():
        if isinstance(given, list):
            unit = parameters[parameters.match_names(pattern)[0]].unit
            require(len(given) == 2, f'{where} {pattern}: write a fraction, "30 %", or two values, the least first')
            low, high = (read_value(end, unit, where=f"{where} {pattern}") for end in given)
            found[pattern] = (low, high)
        else:
            found[pattern] = read_value(given, "1", where=f"{where} {pattern}")
    return found
