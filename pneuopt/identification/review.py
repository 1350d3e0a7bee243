"""A second look at a fit: which intervals lie, what the logs do not tell, and where a fit that failed falls short."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pneuopt.dynamics.hooks import Start
from pneuopt.identification.checks import measured_outputs
from pneuopt.identification.identifiability import Verdict, expected, from_covariance, listed
from pneuopt.identification.problem import Problem
from pneuopt.identification.profiles import Profile, traced
from pneuopt.shooting.convergence import NOISE_LEVEL
from pneuopt.shooting.equations import gaps_of
from pneuopt.shooting.segments import segment, start_nodes
from pneuopt.shooting.solution import Code, Status

if TYPE_CHECKING:
    import pandas as pd

    from pneuopt.identification.identify import IdentificationResult

Array = NDArray[np.float64]
DOUBTFUL = 0.15  # relative standard deviation beyond which the likelihood of a log parameter is no parabola
OUTSIDE = 3.0  # standard deviations that another parameter moves along a profile, beyond which it is profiled, too
BLOCK = 50  # samples over which residuals are compared
SUBSTEPS = 20  # of a sample, at which gaps are shown
NO_GAP = 1e-4  # of a nominal size
WIDTH, NARROW, NARROWER = "friction.smoothing", 1e-4, 0.1  # [m/s], narrower takes ever finer steps
AT_BOUND, NOT_TOLD = "at its bound", "not told"


def scrutinised(problem: Problem, result: "IdentificationResult", untold: Sequence[str] = ()) -> "IdentificationResult":
    """Mark what the fit says without knowing it.

    Parameters
    ----------
    problem : Problem
    result : IdentificationResult
        As the search left it.
    untold : sequence of str
        Free parameters that rest on a prior: those held, and those that hang on them.

    Returns
    -------
    IdentificationResult
        With its verdict; where the search did not converge, without any interval, and with the worst place in its
        status. Doubtful intervals are replaced by those of the profile likelihood; a parameter that has an open end
        there, or that the motion cannot show, has no standard deviation. Ctrl-C leaves the rest unchecked.
    """
    start = Start(result.trajectories, {str(n): float(v) for n, v in result.estimates["value"].items()}, "fit")
    if not result.status.converged:
        verdict = _at(problem, start, result)
        status = (
            result.status
            if result.status.code is Code.INTERRUPTED
            else _located(problem, start, result.status, verdict)
        )
        blank = _blank(result.estimates, result.estimates.index)
        return replace(
            result,
            estimates=_noted(blank, verdict),
            covariance=result.covariance * math.nan,
            status=status,
            verdict=verdict,
        )
    result = replace(result, estimates=_blank(result.estimates, untold))
    profiles = _profiles(problem, result)
    trusted = result.stats["chi_square_ratio"] <= NOISE_LEVEL
    verdict = from_covariance(problem, start, _without(result.covariance, untold), trusted=trusted)
    verdict = verdict.with_profiles(profiles)
    if untold:
        verdict = verdict.with_untold(untold, _at(problem, start, result), _kept(problem))
    estimates = _noted(_corrected(result.estimates, profiles, verdict), verdict)
    covariance = _without(result.covariance, estimates.index[estimates["stderr"].isna()])
    told = f"{result.status.message}; the logs do not tell {listed(verdict.untold)}" if verdict.untold else ""
    status = Status(result.status.code, told) if told else result.status
    return replace(result, estimates=estimates, covariance=covariance, status=status, verdict=verdict)


def _without(covariance: "pd.DataFrame", names: Iterable[str]) -> "pd.DataFrame":
    """NaN for these."""
    out, gone = covariance.copy(), list(names)
    out.loc[gone] = math.nan
    out[gone] = math.nan
    return out


def _blank(estimates: "pd.DataFrame", names: Iterable[str]) -> "pd.DataFrame":
    """No interval for these."""
    out = estimates.copy()
    out.loc[list(names), ["stderr", "ci_low", "ci_high"]] = math.nan
    return out


def _kept(problem: Problem) -> tuple[str, ...]:
    """Of what is held, that which stays at its given value."""
    given = problem.unknowns()
    return tuple(n for n, v in problem.held.items() if v == given.value(n))


def _at(problem: Problem, start: Start, result: "IdentificationResult") -> Verdict:
    """The verdict where a search gave up, from the sensitivities there."""
    return expected(problem, start, max(1.0, result.stats["chi_square_ratio"] * result.stats["correlation_time"]))


def _profiles(problem: Problem, result: "IdentificationResult") -> dict[str, Profile]:
    """Profiles of what is doubtful, and of what that drags along."""
    found: dict[str, Profile] = {}
    rows = result.estimates
    known = rows.index[np.isfinite(rows["stderr"])]
    unknowns = problem.unknowns()
    waiting = [n for n in known if unknowns[n].log and rows["stderr"][n] > DOUBTFUL * rows["value"][n]]
    try:
        while waiting:
            name = waiting.pop(0)
            found[name] = traced(problem, result, name)
            dragged = [n for n in _dragged(found[name], rows) if n in known and n not in found and n not in waiting]
            waiting += dragged if found[name].is_open else []
    except KeyboardInterrupt:
        return found
    return found


def _dragged(profile: Profile, estimates: "pd.DataFrame") -> Iterator[str]:
    """Other parameters that leave their linear interval while the profiled one is still believed."""
    believed = profile.curve[profile.curve["deviance"] <= profile.threshold]
    for name in estimates.index.drop(profile.name):
        moved = (believed[name] - estimates["value"][name]).abs().max()
        if moved > OUTSIDE * estimates["stderr"][name]:
            yield str(name)


def _corrected(estimates: "pd.DataFrame", profiles: Mapping[str, Profile], verdict: Verdict) -> "pd.DataFrame":
    """The profiles' intervals in place of the linear ones; no standard deviation where there is no closed interval."""
    out = _blank(estimates, verdict.untold)
    for name, found in profiles.items():
        out.loc[name, ["ci_low", "ci_high"]] = [found.low, found.high]
        if found.is_open:
            out.loc[name, "stderr"] = math.nan
    return out


def _noted(estimates: "pd.DataFrame", verdict: Verdict) -> "pd.DataFrame":
    """A note beside each number that is none, and no number where nothing is told."""
    untold, bound = set(verdict.untold), estimates["at_bound"]
    notes = [AT_BOUND if bound[n] else NOT_TOLD if n in untold else "" for n in estimates.index]
    out = estimates.assign(note=notes)
    return out.assign(value=out["value"].where(out["note"] != NOT_TOLD))


def _located(problem: Problem, start: Start, status: Status, verdict: Verdict) -> Status:
    """A failure with the place where it is worst."""
    parts = [status.message, _worst_residual(problem, start), _worst_gap(problem, start)]
    if verdict.untold:
        parts.append(f"the logs do not tell {listed(verdict.untold)}: fix what is not told, or log a run that tells it")
    parts.append(_narrower(problem))
    return Status(status.code, "; ".join(part for part in parts if part))


def _narrower(problem: Problem) -> str:
    """A remedy for logs that stick: smoothed friction creeps meanwhile, at a speed of its width's order."""
    width = problem.parameters[WIDTH].value if WIDTH in problem.parameters else NARROW
    told = f"if the logs stick, try {WIDTH} = {max(NARROW, NARROWER * width):g} m/s in place of {width:g} m/s"
    return f"{told}: above it the model creeps where the drive stands still" if width > NARROW else ""


def _worst_residual(problem: Problem, start: Start) -> str:
    """Log, channel and time span of the largest residuals."""
    worst, told = NOISE_LEVEL, ""
    for log in problem.experiments:
        t, run = log.trajectory.t, start.states[log.name]
        for channel in measured_outputs(problem.system, log):
            off = (log.trajectory[channel] - run[channel]) / log.noise[channel]
            for first in range(0, len(t), BLOCK):
                part = off[first : first + BLOCK]
                size = math.sqrt(float(np.nanmean(part**2))) if np.isfinite(part).any() else 0.0
                if size > worst:
                    last = min(first + BLOCK, len(t)) - 1
                    worst, told = size, f"{channel} of {log.name} from {t[first]:.4g} to {t[last]:.4g} s"
    return f"the worst residuals, {worst:.3g} times the noise, are {told}" if told else ""


def _worst_gap(problem: Problem, start: Start) -> str:
    """State, log and time of the largest gap between two segments."""
    segments = segment(problem.transcription(start))
    q = np.array([p.value for p in segments.transcription.parameters.values()])
    nodes = start_nodes(segments)
    ends = segments.run(nodes, q, SUBSTEPS, sensitivities=False).x_end
    gaps = np.abs(gaps_of(segments, nodes, ends))
    if not gaps.size or not np.isfinite(gaps).all() or gaps.max() < NO_GAP:
        return ""
    row, column = np.unravel_index(int(np.argmax(gaps)), gaps.shape)
    state = problem.system.states[int(column)]
    log, at = segments.transcription.phases[int(segments.phase[row])].name, segments.t[row + 1, 0]
    return (
        f"the largest gap: {state.name} jumps by {gaps.max() * state.nominal:.2g} {state.unit} at {at:.4g} s of {log}"
    )
