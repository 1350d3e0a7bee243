"""Cases of a study: named parameter values, as `sweep` takes them: every combination, or the rows of a table.

Corners and draws are the scenarios of `evaluation`, which are cases as they are.
"""

import itertools
import math
import re
from collections.abc import Iterable, Mapping
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pneuopt.quantities.errors import InputError, check_names, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.source import MAX_REASON, read_source
from pneuopt.quantities.units import si_conversion, write_value
from pneuopt.studies.outcome import CaseValues

if TYPE_CHECKING:
    import pandas as pd

MAX_TABLE_BYTES = 2**28
"""Size of a table of cases [byte], 256 MiB: more fills the memory; less refuses a million cases of ten parameters."""
_NAMES = "case"  # the column of a table that names its cases, as in the table that `sweep` returns


def grid(parameters: ParameterSet, axes: Mapping[str, Iterable[float]]) -> dict[str, dict[str, float]]:
    """Every combination of values, as named cases for `sweep`; the last axis runs fastest.

    Parameters
    ----------
    parameters : ParameterSet
        Gives units and bounds.
    axes : mapping of str to iterable of float
        Parameter to its values [its SI unit].

    Returns
    -------
    dict of str to dict of str to float
        "load.mass = 2 kg, load.force = 0 N" to the values by name.

    Raises
    ------
    InputError
        If a parameter is unknown, a value is outside its bounds or there twice, or there is none.

    Examples
    --------
    >>> from pneuopt.quantities.parameters import Parameter
    >>> rig = ParameterSet({"load.mass": Parameter(5.0, "kg"), "stroke": Parameter(0.2, "m")})
    >>> grid(rig, {"load.mass": [2.0, 8.0], "stroke": [0.1]})["load.mass = 8 kg, stroke = 100 mm"]
    {'load.mass': 8.0, 'stroke': 0.1}
    """
    require(len(axes) > 0, "a grid needs an axis: a parameter and its values")
    check_names("parameter", axes, parameters, "axis")
    columns = [_label_axis(parameters, name, list(map(float, values))) for name, values in axes.items()]
    return {
        ", ".join(label for label, _ in point): dict(zip(axes, (value for _, value in point), strict=True))
        for point in itertools.product(*columns)
    }


def read_cases(parameters: ParameterSet, table: "pd.DataFrame | str | Path") -> dict[str, dict[str, float]]:
    """Read the cases of a table, a row each: plants that were measured, or that another tool has chosen.

    Parameters
    ----------
    parameters : ParameterSet
        Gives units and bounds.
    table : DataFrame, str or Path
        A column a parameter, "load.mass [kg]"; one without a unit is in the parameter's SI unit. A column "case" names
        the cases. A path is that of a CSV file.

    Returns
    -------
    dict of str to dict of str to float
        By the name of the case, or "row 1" and so on.

    Raises
    ------
    InputError
        If the file cannot be read, a parameter is unknown, a value is missing or outside its bounds, a name is there
        twice, or there is no row.

    Examples
    --------
    >>> import pandas as pd
    >>> from pneuopt.quantities.parameters import Parameter
    >>> rig = ParameterSet({"load.mass": Parameter(5.0, "kg"), "stroke": Parameter(0.2, "m")})
    >>> read_cases(rig, pd.DataFrame({"case": ["short"], "stroke [mm]": [150], "load.mass": [4]}))
    {'short': {'stroke': 0.15, 'load.mass': 4.0}}
    """
    import pandas as pd

    where = "table" if isinstance(table, pd.DataFrame) else str(table)
    frame = table if isinstance(table, pd.DataFrame) else _read_csv(Path(table))
    heads = {column: re.fullmatch(r"(.*?)(?: \[(.*)\])?", str(column)) for column in frame if column != _NAMES}
    columns = {column: (head[1].strip(), head[2]) for column, head in heads.items() if head}
    names = [name for name, _ in columns.values()]
    check_names("parameter", names, parameters, where)
    require(len(frame) > 0 and len(names) > 0, f"{where}: no case; it needs a row, and a column of a parameter")
    require(len(set(names)) == len(names), f"{where}: a parameter has two columns; leave one out")
    labels = [f"row {k}" for k in range(1, len(frame) + 1)] if _NAMES not in frame else list(map(str, frame[_NAMES]))
    require(len(set(labels)) == len(labels), f"{where}: two cases have the same name")
    values = {
        name: _read_column(frame[column], parameters[name].unit if unit is None else unit, parameters[name].unit, where)
        for column, (name, unit) in columns.items()
    }
    cases = {label: {n: values[n][k] for n in names} for k, label in enumerate(labels)}
    for label, case in cases.items():
        check_case(parameters, case, f"{where}: {label}")
    return cases


def _read_csv(path: Path) -> "pd.DataFrame":
    import pandas as pd

    raw = read_source(path, MAX_TABLE_BYTES, "take fewer cases")
    try:
        return pd.read_csv(BytesIO(raw))
    except ValueError as error:  # pandas' own errors among them
        raise InputError(f"{path}: is no table of cases in CSV ({' '.join(str(error).split())[:MAX_REASON]})") from None


def _read_column(column: "pd.Series[Any]", written: str, unit: str, where: str) -> list[float]:
    """A column's numbers in its parameter's unit."""
    import pandas as pd

    numbers = pd.to_numeric(column, errors="coerce").to_numpy(dtype=float)
    bad = [k for k, v in enumerate(numbers.tolist(), 1) if not math.isfinite(v)]
    require(not bad, f"{where}: {column.name}: row {bad[0] if bad else 0} is no number; every case needs its own")
    factor, offset = si_conversion(written, unit, where=f"{where}: {column.name}")
    return [float(v) for v in factor * numbers + offset]


def check_case(parameters: ParameterSet, case: CaseValues, name: str) -> None:
    """Raise `InputError`, which names the case, if it has an unknown parameter, or a value out of bounds."""
    if isinstance(case, ParameterSet) or all(_is_inside(parameters, n, v) for n, v in case.items()):
        return
    check_names("parameter", case, parameters, name)
    try:
        parameters.with_values(case)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None


def _is_inside(parameters: ParameterSet, name: str, value: float) -> bool:
    """Whether a value is certainly good; `ParameterSet.with_values` finds the words where it is not."""
    if name not in parameters:
        return False
    p = parameters[name]
    return p.lower <= value <= p.upper and (not p.log or value > 0)


def _label_axis(parameters: ParameterSet, name: str, values: list[float]) -> list[tuple[str, float]]:
    """The values with their labels, of six digits, or of 17 where two labels would be equal."""
    require(len(values) > 0, f"axis {name}: no values")
    require(len(set(values)) == len(values), f"axis {name}: a value is there twice; leave one out")
    for value in values:
        check_case(parameters, {name: value}, "axis")
    short, full = ([write_value(v, parameters[name].unit, digits) for v in values] for digits in (6, 17))
    labels = short if len(set(short)) == len(values) else full
    return [(f"{name} = {label}", value) for label, value in zip(labels, values, strict=True)]
