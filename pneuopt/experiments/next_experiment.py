"""`next_experiment`: the excitation that shrinks asked confidence intervals most, within the limits of a drive.

The excitation is a row of equally long blocks, each a wave about a level. The information of separate blocks adds up
nearly, so a library of them, from slow ramps to presliding wiggles, is simulated at once in SIMD lanes, and blocks are
exchanged until no exchange helps (V. V. Fedorov, Theory of Optimal Experiments, 1972). The whole run is then refined
block by block with random changes, since limits, sticking and a run's memory leave no useful gradient of the whole;
only what keeps every limit at every sample, for every plant that is thought possible, is taken.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.runnable import HasSystem, as_runnable, check_smooth
from pneuopt.dynamics.system import names
from pneuopt.evaluation.scenarios import draws as draw_plants
from pneuopt.evaluation.scenarios import further, generator
from pneuopt.experiments.design import Criterion, DOptimal, ExperimentDesign
from pneuopt.experiments.search import DesignSearch, Judge, Limits, PlannedRun, value_size
from pneuopt.experiments.tolerances import MAX_SAMPLES, MAX_WRONG, MIN_BLOCK_SAMPLES
from pneuopt.identification.result import IdentificationResult
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ModelError, check_names, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Progress, ProgressReporter
from pneuopt.shooting.least_squares import CpuBudget

if TYPE_CHECKING:
    import pandas as pd


def next_experiment(
    system: HasSystem | ClosedLoop,
    parameters: ParameterSet,
    *,
    duration: float,
    limits: Mapping[str, tuple[float, float]],
    criterion: Criterion | None = None,
    fit: IdentificationResult | None = None,
    covariance: "pd.DataFrame | None" = None,
    noise: Mapping[str, float] | None = None,
    sample_time: float | None = None,
    start: Mapping[str, float] | None = None,
    runs: int = 1,
    plants: Mapping[str, Mapping[str, float]] | int = 2,
    worst_case: bool = False,
    cpu_seconds: float = 60.0,
    seed: int = 0,
    progress: Callable[[Progress], None] | None = None,
) -> ExperimentDesign:
    """Find the run whose log will shrink the confidence intervals most, together with the logs in hand.

    Parameters
    ----------
    system : drive, System or ClosedLoop
        A loop is excited by its reference, a plant by its command (open loop). The log of either holds the command,
        with which the plant is identified; a force that is a command is held, ``with_intersample``.
    parameters : ParameterSet
        As estimated so far, with the controller's of a loop; the free ones are those that the next `identify` frees.
    duration : float
        Of a run [s].
    limits : mapping of str to (float, float)
        Least and greatest value of outputs, states, the command or the reference, kept at every sample. What is excited
        needs one; a reference has that of the output that it is for. The model's own limits, such as the ends of the
        stroke, hold besides.
    criterion : DOptimal, AOptimal or Precision, optional
        What to make small; by default `DOptimal` of all free parameters.
    fit : IdentificationResult, optional
        Of the logs in hand: their information, and the noise of its channels. Without it only the new run counts.
    covariance : DataFrame, optional
        In place of the fit: the covariance of its estimates, as a fit.toml holds it.
    noise : mapping of str to float, optional
        Standard deviation of each output that will be logged [unit]; by default as in the fit.
    sample_time : float, optional
        Of excitation and log [s]; by default the loop's.
    start : mapping of str to float, optional
        Outputs at the rest where each run begins; by default in the middle of the limits on the position.
    runs : int
        Runs that are planned together, each from rest.
    plants : int, or mapping of str to mapping of str to float
        Other plants for which the run must be good and keep the limits: so many draws from the covariance, or the
        changed parameters of each (`corners`, `samples` and `draws` give such).
    worst_case : bool
        Judge by the plant with the worst criterion, not by the geometric mean over the plants.
    cpu_seconds : float
        After which the refinement ends [s].
    seed : int
        The same seed gives the same run, if the time suffices.
    progress : callable, optional
        Receives a `Progress` after each round.

    Returns
    -------
    ExperimentDesign

    Raises
    ------
    InputError
        If a limit, a noise or a name is missing or wrong, or if no excitation keeps the limits: it says what could be.
    """
    budget, seen = CpuBudget(cpu_seconds), ProgressReporter(progress, "next_experiment")
    model = as_runnable(system)
    check_smooth(model)
    run = _plan(model, parameters, duration, limits, fit, noise, sample_time, start, runs)
    whole = run.plant.parameters | (model.parameters | parameters)
    wanted = criterion or DOptimal()
    targets = tuple(n for n in whole.match_names(*(wanted.targets or run.free)) if n in run.free)
    fixed = [n for n in wanted.targets if n in whole and n not in run.free]
    require(not fixed, f"criterion: {', '.join(fixed)} is not free; free what the next identification is to find")
    require(bool(targets), f"criterion: {', '.join(wanted.targets)}: none of these is free")
    known = fit.covariance if fit is not None else covariance
    others = _draw(whole, run.free, known, plants, seed) if isinstance(plants, int) else plants
    search = DesignSearch(
        run,
        (whole, *(whole.with_values(values) for values in others.values())),
        _known_information(run.free, known),
        Judge(wanted, run.free, targets, whole, worst_case=worst_case),
        round(duration / run.sample_time),
        runs,
        generator(seed, "next_experiment"),
        budget,
        seen,
    )
    return search.design()


def _plan(
    model: object,
    parameters: ParameterSet,
    duration: float,
    limits: Limits,
    fit: IdentificationResult | None,
    noise: Mapping[str, float] | None,
    sample_time: float | None,
    start: Mapping[str, float] | None,
    runs: int,
) -> PlannedRun:
    """Check what was asked for, and complete it."""
    loop = model if isinstance(model, ClosedLoop) else None
    plant = model.plant  # type: ignore[attr-defined]
    step = (loop.pid.sample_time if loop else None) if sample_time is None else sample_time
    require(step is not None and 0 < step < math.inf, "sample_time: say at which time [s] the excitation is played")
    assert step is not None
    own = loop.pid.sample_time if loop else step
    require(
        own is not None, "a planned run needs a sampled controller: give the loop's PID its sample_time", ModelError
    )
    require(own == step, f"sample_time: the loop's controller acts every {own:g} s; leave it out")
    fits = 2 * MIN_BLOCK_SAMPLES * step <= duration <= MAX_SAMPLES * step
    room = f"{2 * MIN_BLOCK_SAMPLES * step:g} to {MAX_SAMPLES * step:g} s"
    require(fits, f"duration = {duration:g} s: with a sample every {step:g} s it may be {room}")
    require(runs >= 1, f"runs = {runs}: plan one at least")
    free = tuple(n for n in parameters.free_names if n in plant.parameters)
    shared = tuple(n for n in free if not parameters[n].per_log)
    require(bool(shared), "no parameter of the plant is free; free what the next identification is to find")
    levels = noise if noise is not None else _noise_of(fit)
    check_names("output", levels, names(plant.outputs), "noise")
    require(bool(levels), "noise: give the standard deviation of each output that will be logged, or a fit")
    wrong = [n for n, sigma in levels.items() if not 0 < sigma < math.inf]
    require(not wrong, f"noise: that of {', '.join(wrong)} must be positive")
    per_log = tuple(n for n in free if parameters[n].per_log)
    run = PlannedRun(plant, loop, shared, per_log, dict(levels), dict(limits), step, {})
    check_names("signal", limits, names(run.channels), "limits")
    empty = [n for n, (low, high) in limits.items() if not low < high]
    require(not empty, f"limits: {', '.join(empty)}: the least value must lie below the greatest")
    run.excited_limits()
    run = replace(run, start=_complete_start(run, start or {}))
    return replace(run, origin=run.rest_excitation(parameters))


def _complete_start(run: PlannedRun, start: Mapping[str, float]) -> dict[str, float]:
    """Where a run begins: the position in the middle of its limits, unless said."""
    check_names("output", start, names(run.plant.outputs), "start")
    found = dict(start)
    for name in ("position", "angle"):
        low, high = run.limits.get(name, (-math.inf, math.inf))
        if name in names(run.plant.outputs) and name not in found and math.isfinite(high - low):
            found[name] = (low + high) / 2
    return found


def _noise_of(fit: IdentificationResult | None) -> dict[str, float]:
    """Of each channel of a fit the larger of its noise and what its residuals show, the median over the logs."""
    if fit is None:
        return {}
    table = fit.fit.reset_index()
    inflation = math.sqrt(max(1.0, float(fit.stats.get("variance_inflation", 1.0))))
    levels = {str(n): own[["noise", "rmse"]].max(axis=1).median() for n, own in table.groupby("channel")}
    return {n: float(v) * inflation for n, v in levels.items()}


def _known_information(free: Sequence[str], covariance: "pd.DataFrame | None") -> Array:
    """The information that a fit has about the free parameters, the others unknown; zero where it has no interval."""
    out = np.zeros((len(free), len(free)))
    if covariance is None:
        return out
    known = _known_names(free, covariance)
    place = [free.index(n) for n in known]
    if known:
        values = covariance.loc[known, known].to_numpy(dtype=float)
        spread = np.sqrt(np.diag(values))
        out[np.ix_(place, place)] = np.linalg.pinv(values / np.outer(spread, spread), hermitian=True) / np.outer(
            spread, spread
        )
    return out


def _draw(
    parameters: ParameterSet, free: Sequence[str], covariance: "pd.DataFrame | None", count: int, seed: int
) -> Mapping[str, Mapping[str, float]]:
    """Plants as the fit leaves them possible."""
    require(count >= 0, f"plants = {count}: give how many are drawn beside the estimates, or the plants")
    if covariance is None or not count:
        return {}
    known = _known_names(free, covariance)
    spread = np.sqrt(np.diag(covariance.loc[known, known].to_numpy(dtype=float)))
    most = MAX_WRONG * np.array([value_size(parameters, n) for n in known])
    cut = np.minimum(1.0, most / np.maximum(spread, 1e-300))
    return (
        draw_plants(
            parameters, covariance.loc[known, known] * np.outer(cut, cut), count, seed=further(seed, "next_experiment")
        )
        if known
        else {}
    )


def _known_names(free: Sequence[str], covariance: "pd.DataFrame") -> list[str]:
    """The free parameters that have an interval."""
    variances = dict(zip(map(str, covariance.index), np.diag(covariance.to_numpy(dtype=float)).tolist(), strict=True))
    return [n for n in free if math.isfinite(variances.get(n, math.nan))]
