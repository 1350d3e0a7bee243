"""What the scripts here share: a claim a row, the table on screen, --json and --out, and the exit status.

A claim is a figure that anyone can compute again: name, value, unit, the reference beside it (the published figure, if
any), the bound it is held to (if any), and whether it holds. What a script's text claims of rows, "Rows quiet.*: ...",
is held to a bound: if no row of that pattern has one, the script says so and fails.
"""

import argparse
import fnmatch
import json
import math
import operator
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    import pneuopt as po


COLUMNS = ("name", "value", "unit", "reference", "bound", "holds")
KNOBS = {n: f"pid.{n}" for n in ("Kp", "Ki", "Kd", "Tf")}
KNOBS |= {f"dither_{n}": f"dither.{n}" for n in ("amplitude", "offset")}
METRICS = {
    "settling_time": ("SettlingTime", "s"),
    "overshoot": ("Overshoot", "%"),
    "steady_state_error": ("SteadyStateError", "%"),
    "peak_control": ("PeakControl", ""),
    "max_sensitivity": ("MaxSensitivity", "1"),
    "ripple": ("Ripple", ""),
}
# A dither's verdict as a figure, by the name of its `Usefulness`.
VERDICT_SCORES = {"USEFUL": 1.0, "HELPS_THESE_GAINS": 0.5, "USELESS": 0.0, "HARMFUL": -1.0}
COMPARISONS: dict[str, Callable[[float, float], bool]] = {"<=": operator.le, ">=": operator.ge}


@dataclass(frozen=True)
class Claim:
    """One row.

    Parameters
    ----------
    name : str
        "table1.1.overshoot": the table or design, the case, the figure.
    value : float
    unit : str
        "1" if it has none.
    reference : float or None
        The published or rival figure.
    bound : str
        "<= 0.21", ">= 16" or "6.3 +- 0.1"; empty: nothing is claimed, the figure is only shown.
    """

    name: str
    value: float
    unit: str = "1"
    reference: float | None = None
    bound: str = ""

    @property
    def holds(self) -> bool:
        """Whether the value keeps its bound; NaN never does."""
        return within(self.value, self.bound)


def within(value: float, bound: str) -> bool:
    """Whether a value keeps a bound.

    Examples
    --------
    >>> within(0.2, "<= 0.21"), within(0.5003, "0.500 +- 0.005"), within(float("nan"), ">= 1"), within(7.0, "")
    (True, True, False, True)
    """
    if not bound:
        return True
    if match := re.fullmatch(r"(<=|>=) *(\S+)", bound):
        return COMPARISONS[match[1]](value, float(match[2]))
    centre, width = (float(part) for part in bound.split("+-"))
    return abs(value - centre) <= width


def frame(claims: Iterable[Claim]) -> "pd.DataFrame":
    """The claims as a DataFrame, a row each."""
    import pandas as pd

    rows = [asdict(claim) | {"holds": claim.holds} for claim in claims]
    return pd.DataFrame(rows, columns=list(COLUMNS)).astype({"value": float, "reference": float})


def design(
    name: str, parameters: "po.ParameterSet", certified: "pd.DataFrame", bounds: Mapping[str, str] | None = None
) -> list[Claim]:
    """A tuned loop's rows: its gains and dither, and its certified metrics, the worst over the references.

    Parameters
    ----------
    name : str
    parameters : ParameterSet
    certified : DataFrame
        Of `tune` or `evaluate`: a row a metric, a column a reference.
    bounds : mapping of str to str, optional
        By row, as in "settling_time".
    """
    bounds, rows = bounds or {}, []
    for row, parameter in KNOBS.items():
        if parameter in parameters:
            rows.append(Claim(f"{name}.{row}", parameters.value(parameter), parameters[parameter].unit))
    for row, (metric, unit) in METRICS.items():
        if metric in certified.index:
            worst = float(np.max(certified.loc[metric].to_numpy(dtype=float)))
            rows.append(Claim(f"{name}.{row}", worst, unit, None, bounds.get(row, "")))
    return rows


def table(rows: "pd.DataFrame") -> str:
    """The claims as text, 80 columns wide.

    A row that fails is marked; one without a bound is neither held nor failed.
    """
    lines = [f"{'':<31}{'ours':>10}  {'unit':<6}{'reference':>10}  {'bound':<14}"]
    for row in rows.to_dict("records"):
        mark = "" if not row["bound"] else "ok" if row["holds"] else "FAIL"
        figures = f"{_number(row['value']):>10}  {row['unit']:<6}{_number(row['reference']):>10}"
        lines.append(f"{row['name']:<31}{figures}  {row['bound']:<14} {mark}")
    bounded = rows[rows["bound"] != ""]
    lines.append(
        f"{int(bounded['holds'].sum())} of {len(bounded)} claims hold; {len(rows) - len(bounded)} figures shown only"
    )
    return "\n".join(line.rstrip() for line in lines)


def unbounded_patterns(text: str, rows: "pd.DataFrame") -> list[str]:
    """The patterns by which a text names rows, of which there are some, but none with a bound.

    Examples
    --------
    >>> rows = frame([Claim("with.air", 2.0, "l"), Claim("quiet.air", 1.0, "l", None, "<= 1.2")])
    >>> unbounded_patterns("Rows with.*: the air. Rows quiet.*: with a limit on it; see *.py.", rows)
    ['with.*']
    """
    patterns = [p.strip(".") for p in re.findall(r"[\w.]*\*[\w.*]*", text)]
    names = dict(zip(rows["name"], rows["bound"], strict=True))
    bounds = {p: [names[n] for n in fnmatch.filter(names, p if p.endswith("*") else f"{p}*")] for p in patterns}
    return [p for p, found in bounds.items() if found and not any(found)]


def arguments(description: str | None) -> argparse.ArgumentParser:
    """A parser with the options that every script has; a script adds its own."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.set_defaults(text=description or "")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the claims as records")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write the figures as PNG")
    return parser


def finish(
    rows: "pd.DataFrame", options: argparse.Namespace, figures: Callable[[], Mapping[str, "Figure"]] | None = None
) -> int:
    """Print the claims, write what the options ask for.

    Parameters
    ----------
    rows : DataFrame
    options : argparse.Namespace
        Of `arguments`, with the script's text.
    figures : callable, optional
        Makes the figures, name to Figure; called only with --out.

    Returns
    -------
    int
        The exit status: 0 if every claim holds and every pattern of rows in the text is held to a bound, else 1.
    """
    print(table(rows))
    unbounded = unbounded_patterns(options.text, rows)
    if unbounded:
        print(f"claimed in the text without a bound: {', '.join(unbounded)}")
    if options.json is not None:
        _write(options.json, json.dumps(records(rows), indent=1) + "\n")
    if options.out is not None and figures is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        for name, figure in figures().items():
            figure.savefig(options.out / f"{name}.png", dpi=150, metadata={"Description": drawn_by(sys.argv)})
            print(f"{options.out / name}.png")
    return 0 if bool(rows["holds"].all()) and not unbounded else 1


def drawn_by(words: Sequence[str]) -> str:
    """The command that draws a figure, as the gallery shows it: the script and its counts, without files and processes.

    Examples
    --------
    >>> drawn_by(["/a/problems/tune/p32.py", "--plants", "8", "--json", "rows.json", "--jobs=2", "--out", "here"])
    'python problems/tune/p32.py --plants 8 --out out'
    """
    script = "/".join(Path(words[0]).resolve().parts[-3:])
    own = re.sub(r" --(json|out|jobs)[ =]\S+| --resume", "", " ".join(["", *words[1:]]))
    return f"python {script}{own} --out out"


def records(rows: "pd.DataFrame") -> list[dict[str, object]]:
    """The claims as JSON records; what is not a number is null."""
    return [
        {str(k): None if isinstance(v, float) and not math.isfinite(v) else v for k, v in row.items()}
        for row in rows.to_dict("records")
    ]


def _number(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.4g}" if abs(value) < 1e5 else f"{value:.6g}"


def _write(path: Path, text: str) -> None:
    """Whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    part.write_text(text, encoding="utf-8")
    part.replace(path)
