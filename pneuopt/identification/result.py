"""`IdentificationResult`: estimates with their intervals, and its `Verdict`: what the logs cannot identify."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from pneuopt.dynamics.excitation import Excitation
from pneuopt.identification.excitation import remedy
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Status
from pneuopt.quantities.trajectories import Trajectory

if TYPE_CHECKING:
    import pandas as pd

AT_BOUND_NOTE, UNIDENTIFIABLE_NOTE = "at its bound", "not told"
INFINITE_INFLATION = (
    1e5  # times that a standard deviation shrinks if the others were known, that are as good as infinite
)


@dataclass(frozen=True, eq=False)
class Verdict:
    """What logs can tell.

    Attributes
    ----------
    table : DataFrame
        A row a free parameter: value, expected standard deviation (`stderr`) and that over the value (`relative`), the
        one if all others were known (`alone`), their ratio (`inflation`), and whether the logs tell it (`told`).
    indistinguishable : tuple of tuple of str
        Parameters that only count together.
    reasons : mapping of str to str
        By parameter: why the logs do not tell it, or only roughly, and what run would.
    unchanged : tuple of str
        Parameters that a fit left at their given values.
    excitation : Excitation
        The model's: which runs would show or separate its parameters.
    """

    table: "pd.DataFrame"
    indistinguishable: tuple[tuple[str, ...], ...]
    reasons: Mapping[str, str]
    unchanged: tuple[str, ...] = ()
    excitation: Excitation = field(default_factory=Excitation)

    @property
    def unidentifiable(self) -> tuple[str, ...]:
        """The parameters of which the logs say nothing."""
        return tuple(str(n) for n, told in self.table["told"].items() if not told)

    @property
    def sentences(self) -> tuple[str, ...]:
        """What is amiss, in words; empty if nothing is."""
        by_reason: dict[tuple[bool, str], list[str]] = {}
        for name, reason in self.reasons.items():
            by_reason.setdefault((name in self.unidentifiable, reason), []).append(name)
        single = [
            f"the logs {'do not tell' if untold else 'tell only roughly'} {join_names(names)}: {reason}"
            for (untold, reason), names in by_reason.items()
        ]
        groups = [_describe_group(group, self.table["inflation"], self.excitation) for group in self.indistinguishable]
        return (*single, *groups, *([self._describe_left_alone()] if self.unchanged else []))

    def _describe_left_alone(self) -> str:
        """What became of the parameters that a fit has left alone."""
        values = join_names([f"{n} ({self.table['value'][n]:.4g})" for n in self.unchanged])
        verb = "keep their given values" if len(self.unchanged) > 1 else "keeps its given value"
        return f"{values} {verb}, on which the other intervals do not rest"

    def to_dict(self) -> dict[str, Any]:
        """All but the table, for a file."""
        reasons = {str(n): reason for n, reason in self.reasons.items()}
        words = {"sentences": list(self.sentences), "untold": list(self.unidentifiable), "kept": list(self.unchanged)}
        return {**words, "together": [list(group) for group in self.indistinguishable], "reasons": reasons}

    def __str__(self) -> str:
        return "\n".join(self.sentences) or "the logs tell every free parameter"


@dataclass(frozen=True, eq=False)
class IdentificationResult:
    """What `identify` found.

    Attributes
    ----------
    parameters : ParameterSet
        The system's, with the given values and the estimates; a `per_log` parameter keeps its given value here, and so
        does one that the logs do not tell, unless they refuse that value or tell it only together with another: then
        it is where the other estimates stand.
    estimates : DataFrame
        A row a free parameter ("name[log]" for one of a log): value, stderr, ci_low, ci_high (95 %), lower, upper,
        at_bound, unit, source, note. The value is NaN where the note is "not told". No interval there, at a bound, or
        without convergence. Where a linear interval would lie it is the profile likelihood's, infinite at an open end.
        What is not told may lie a factor of ten from where it stays: the other intervals allow for that.
    covariance : DataFrame
        Of the estimates, scaled by the residuals' own level and correlation; NaN for what has no interval.
    fit : DataFrame
        A row a log and channel: rmse, nrmse, fit_percent, samples, noise, unit.
    trajectories : mapping of str to Trajectory
        Fitted states and outputs of each log.
    status : Status
    stats : mapping of str to float
    provenance : mapping of str to str
    verdict : Verdict
        What the logs do not tell, why, and what run would: ``print(result.verdict)``.
    """

    parameters: ParameterSet
    estimates: "pd.DataFrame"
    covariance: "pd.DataFrame"
    fit: "pd.DataFrame"
    trajectories: Mapping[str, Trajectory]
    status: Status
    stats: Mapping[str, float]
    provenance: Mapping[str, str]
    verdict: Verdict | None = None


def _describe_group(group: Sequence[str], inflation: "pd.Series[float]", excitation: Excitation) -> str:
    times = float(inflation[list(group)].max())
    message = (
        f"known {times:.0f} times better if the others were"
        if times < INFINITE_INFLATION
        else "nothing tells them apart"
    )
    return f"{join_names(group)} only count together ({message}): {remedy(excitation, group)}"


def join_names(names: Sequence[str]) -> str:
    """Names in a sentence: "a, b and c"."""
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
