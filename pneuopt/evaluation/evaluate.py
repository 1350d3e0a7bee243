"""`evaluate`: the metrics of a loop's gains, by a simulation that no search takes part in; or those of a rig.

Then the evaluation of single cases, and metrics as tables show them.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf, isnan, nan
from typing import TYPE_CHECKING, Any

import numpy as np

from pneuopt.control.loop import ClosedLoop, add_disturbances
from pneuopt.control.reference import Reference, as_references
from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import with_pade_order
from pneuopt.dynamics.tolerances import MAX_STEPS, SIMULATED_PADE_ORDER
from pneuopt.evaluation.limit_cycle import find_limit_cycle
from pneuopt.evaluation.margins import margin_rows, worst_margins
from pneuopt.evaluation.metric import Band, Requirement
from pneuopt.evaluation.metrics import Envelope, meter_metrics, refine_instants
from pneuopt.evaluation.requirements import METRICS, larger_is_better, metric_name, percent_factor, user_limit
from pneuopt.evaluation.response import (
    TuningCase,
    cases,
    check_steps,
    check_travel,
    loop_inputs,
    measure,
    readings_a_sample,
    sample_spacing,
)
from pneuopt.evaluation.rig import Rig, record
from pneuopt.evaluation.scenarios import NO_SCENARIOS, Scenarios
from pneuopt.evaluation.tolerances import (
    MAX_REFINEMENTS,
    MIN_RELATIVE_AMPLITUDE,
    POINTS_PER_READING,
    TRANSIENT_SHARE,
)
from pneuopt.quantities.errors import ModelError
from pneuopt.quantities.parameters import ParameterSet, check_argument, check_parameters
from pneuopt.quantities.report import TIED, Report, Table, format_number, number_columns, text_columns
from pneuopt.quantities.trajectories import Trajectory

if TYPE_CHECKING:
    import pandas as pd

LIMIT_CYCLE_METRICS = ("LimitCycleAmplitude", "LimitCycleFrequency", "StickShare")
DITHER_METRICS = ("Ripple", "SettlingTimeRaw")  # they say something of a loop with dither only
TIMES_OR_NEVER = ("SettlingTime", "SettlingTimeRaw")


def evaluate(
    loop: ClosedLoop | Rig,
    references: Reference | Sequence[Reference],
    parameters: ParameterSet,
    *,
    scenarios: Scenarios = NO_SCENARIOS,
    band: Band = 0.02,
    envelope: Envelope = (),
    max_steps: float = MAX_STEPS,
) -> "pd.DataFrame":
    """Metrics of a loop at the given parameters over the references' horizons, by a tight simulation.

    `certificate` judges them, and continues each response beyond its horizon.

    Parameters
    ----------
    loop : ClosedLoop or Rig
        The plant's true signal is measured, not a sensor's reading of it. A rig's loop runs with the rig's actuator
        and sensors (`record`, seed 0) and is measured at the controller's samples; PeakControl is then that of the
        command after the actuator. A rig has no margins, which are those of a smooth loop.
    references : Reference or sequence of Reference
        Each step begins from rest or from steady motion.
    parameters : ParameterSet
    scenarios : mapping of str to mapping, optional
        Further plants or tolerances, from `corners`, `samples`, `draws` or `tolerances`.
    band : float or Tolerance
        Half width of the settling band around the reference, a fraction of the step or in the measured unit.
    envelope : sequence of (float, float, float)
        The bounds of a `StepEnvelope`.
    max_steps : float
        Steps of the simulations together that are refused as too many.

    Returns
    -------
    DataFrame
        A row for each metric, a column for each reference ("0 to 0.25"), then one for each reference and scenario
        ("0 to 0.25 [load.mass high]"). The rows: those of `step_metrics`; LimitCycleAmplitude [measured unit], 0
        without hunting, LimitCycleFrequency [Hz] and StickShare; the metrics that the plant's meter shows, AirUse
        [l(ANR)], ValveTravel [half travels] and EnergyUse [J]; and, not for a rig, the worst over the response's
        operating points (at rest, sliding, at the end) of the linearised loop's
        MaxSensitivity, MaxComplementarySensitivity, GainMargin, PhaseMargin [deg], NoiseGain [command's unit/measured
        unit], and FrictionSlope [N s/m] for drives with a load. Where the loop is unstable at one of them, its margins
        are NaN, its sensitivities and noise gain infinite.

    Raises
    ------
    InputError
        If two references have one label, a scenario names an unknown parameter, the responses take more steps than
        `max_steps`, or the stroke is too short for a reference.
    ConvergenceError
        If the simulation stops.

    Warns
    -----
    PhysicsWarning
        If the piston overshoots into an end stop, or a chamber is emptied.

    Examples
    --------
    >>> from pneuopt.control.pid import PID
    >>> from pneuopt.control.reference import Step
    >>> from pneuopt.evaluation.rig import Sensor
    >>> from pneuopt.models.drives import ForceDrive
    >>> from pneuopt.models.friction import Viscous
    >>> loop = ClosedLoop(ForceDrive(Viscous()).system(), PID(sample_time=1e-3))
    >>> values = loop.parameters.with_values({"pid.Kp": 300.0, "pid.Ki": 4000.0})
    >>> smooth = evaluate(loop, Step(0.1), values)
    >>> real = evaluate(Rig(loop, {"position": Sensor(resolution=1e-5)}), Step(0.1), values)
    >>> [(found["0 to 0.1"]["Overshoot"] < 1).item() for found in (smooth, real)]
    [True, True]
    >>> ["MaxSensitivity" in found.index for found in (smooth, real)]
    [True, False]
    """
    steps = as_references(references)
    check_parameters(parameters)
    inner, _ = _loop_and_rig(loop, steps)
    full = inner.complete(parameters)
    check_steps(inner, steps, full, plants=1 + len(scenarios), max_steps=max_steps)
    for case in cases(steps, scenarios, full):
        check_travel(inner, case, full)
    return tabulate_metrics(
        evaluate_cases(loop, references, parameters, scenarios=scenarios, band=band, envelope=envelope)
    )


@dataclass(frozen=True, eq=False)
class CaseEvaluation:
    """One reference on one plant as `evaluate` finds it."""

    loop: ClosedLoop  # with inputs for the references' disturbances
    case: TuningCase
    parameters: ParameterSet  # every parameter of the loop, with this case's values
    metrics: dict[str, float]
    response: Trajectory  # states and outputs up to the horizon; a rig's truth
    margins: tuple[dict[str, Any], ...] = ()  # of `margin_rows`; none for a rig


def tabulate_metrics(evaluations: Iterable[CaseEvaluation]) -> "pd.DataFrame":
    """A row a metric, a column a case."""
    import pandas as pd

    return pd.DataFrame({found.case.label: found.metrics for found in evaluations})


def evaluate_cases(
    loop: ClosedLoop | Rig,
    references: Reference | Sequence[Reference],
    parameters: ParameterSet,
    *,
    scenarios: Scenarios = NO_SCENARIOS,
    band: Band = 0.02,
    envelope: Envelope = (),
) -> Iterator[CaseEvaluation]:
    """Evaluate one case after the other; parameters and errors as for `evaluate`."""
    steps = as_references(references)
    check_parameters(parameters)
    inner, rig = _loop_and_rig(loop, steps)
    full = inner.complete(parameters)
    for case in cases(steps, scenarios, full):
        own, reference = case.case_parameters(full), case.reference
        response = _respond(inner, rig, reference, own)
        metrics = measure(inner, own, reference, response, band, envelope)
        metrics |= limit_cycle_metrics(inner, own, reference, response)
        metrics |= meter_metrics(inner, own, response, reference.at)
        rows = margin_rows(inner, own, reference, response) if rig is None else ()
        yield CaseEvaluation(inner, case, own, metrics | worst_margins(rows), response, rows)


def respond(loop: ClosedLoop | Rig, reference: Reference, parameters: ParameterSet) -> Trajectory:
    """Response that `evaluate` measures, from rest or from steady motion.

    Parameters
    ----------
    loop : ClosedLoop or Rig
    reference : Reference
    parameters : ParameterSet

    Returns
    -------
    Trajectory
        States and outputs of a loop, simulated tightly on a grid finer than a search's; for a rig, its truth.
    """
    inner, rig = _loop_and_rig(loop, [reference])
    full = inner.complete(parameters)
    check_travel(inner, TuningCase(reference), full)
    return _respond(inner, rig, reference, full)


def _respond(loop: ClosedLoop, rig: Rig | None, reference: Reference, parameters: ParameterSet) -> Trajectory:
    run = loop_inputs(loop, reference, sample_spacing(loop, reference, parameters))
    start = loop.initial(parameters, reference=reference.origin, start=reference.start)
    if rig is not None:
        return record(rig, run, parameters, initial=start).truth
    count = POINTS_PER_READING * readings_a_sample(loop, reference) * (len(run) - 1) + 1
    response = simulate(
        loop, run, parameters, initial=start, t_out=np.linspace(run.t[0], run.t[-1], count), max_steps=inf
    )
    for _ in range(MAX_REFINEMENTS if loop.dither_period(parameters) is None else 0):
        signal, size = response[loop.feedback.name], reference.nominal_size
        finer = refine_instants(response.t, signal, reference.final, size, reference.at)
        if finer is None:
            break
        response = simulate(loop, run, parameters, initial=start, t_out=finer, max_steps=inf)
    return response


def limit_cycle_metrics(
    loop: ClosedLoop, parameters: ParameterSet, reference: Reference, response: Trajectory
) -> dict[str, float]:
    """LimitCycleAmplitude after the transient [measured unit], LimitCycleFrequency [Hz] and StickShare [1]; 0: none."""
    signal, period = response[loop.feedback.name], loop.dither_period(parameters)
    start = reference.at + TRANSIENT_SHARE * (response.t[-1] - reference.at)
    least = MIN_RELATIVE_AMPLITUDE * abs(reference.nominal_size)
    found = find_limit_cycle(response.t, signal, start=start, dither_period=period, min_amplitude=least)
    values = (found.amplitude, found.frequency, found.stick_share) if found else (0.0, nan, 0.0)
    return dict(zip(LIMIT_CYCLE_METRICS, values, strict=True))


def _loop_and_rig(model: ClosedLoop | Rig, references: Sequence[Reference]) -> tuple[ClosedLoop, Rig | None]:
    """Loop with inputs for the references' disturbances, and the rig around it, if any."""
    meant = "a ClosedLoop, such as ClosedLoop(drive, PID()), or a Rig with one"
    check_argument("loop", model, (ClosedLoop, Rig), meant)
    rig = model if isinstance(model, Rig) else None
    if model.loop is None:
        raise ModelError("this rig has no controller, so it follows no reference; make it of a ClosedLoop")
    late = replace(model.loop, plant=with_pade_order(model.loop.plant, SIMULATED_PADE_ORDER))
    loop = add_disturbances(late, references)
    return loop, replace(rig, model=loop) if rig is not None else None


def metric_units(loop: ClosedLoop) -> dict[str, str]:
    """The metrics that are shown, in that order, with their units."""
    units = (loop.command.unit, loop.feedback.unit)
    return {metric.name: metric.shown_unit(*units) for metric in METRICS.values() if metric.shown}


def relevant_units(loop: ClosedLoop) -> dict[str, str]:
    """Units of `metric_units`, less those of a dither or position that the loop lacks; the step's size has key ""."""
    left_out = {n for n, metric in METRICS.items() if metric.positions and loop.controller.sensed_signal.order != 0}
    left_out |= set() if loop.dither is not None else set(DITHER_METRICS)
    units = {n: unit for n, unit in metric_units(loop).items() if n not in left_out}
    return {"": loop.feedback.unit, **units}


def metric_limits(limits: Sequence[Requirement]) -> dict[str, float]:
    """Each limit by its metric, in the unit in which that is shown; those without a bound are left out."""
    bounds = {metric_name(q): (user_limit(q), q.metric.factor) for q in limits}
    return {n: factor * bound for n, (bound, factor) in bounds.items() if bound is not None}


def report_metrics(
    metrics: "pd.DataFrame",
    units: Mapping[str, str],
    *,
    title: str = "certified",
    beside: tuple[str, "pd.DataFrame | None"] = ("", None),
    limits: Mapping[str, float] | None = None,
    most_columns: int = 3,
) -> Report:
    """Metrics, a column a reference, or their worst where there are too many; with others beside them one fewer fits.

    Those `beside` are of the same references, with their heading: "was", with the gains before; `title` says what the
    figures are, `units` are of `relevant_units`, `limits` of `metric_limits`.
    """
    heading, other = beside
    sides = {n: ">=" if larger_is_better(n) else "<=" for n in limits or {}}
    allowed = {n: f"{sides[n]}{TIED}{format_number(limit, 4)}" for n, limit in (limits or {}).items()}
    several = len(metrics.columns) > most_columns - (other is not None)
    unit = units.get("", "")
    names = [f"worst of {len(metrics.columns)}"] if several else [f"{c}\n{unit}" if unit else str(c) for c in metrics]
    figures = [word for name in names for word in ((name,) if other is None else (name, heading))]
    hunts = LIMIT_CYCLE_METRICS[0] in metrics.index and bool((metrics.loc[LIMIT_CYCLE_METRICS[0]] > 0).any())
    rows = []
    for metric in (m for m in units if m in metrics.index and (hunts or m not in LIMIT_CYCLE_METRICS)):
        now: list[float] = metrics.T[metric].tolist()
        then: list[float] = other.T[metric].tolist() if other is not None and metric in other.index else []
        if several:
            worst = min if larger_is_better(metric) else max
            now, then = ([nan if any(map(isnan, v)) else worst(v)] if v else [] for v in (now, then))
        cells = [metric_cell(metric, v) for v in now]
        if other is not None:
            beside_cells = [metric_cell(metric, v, 3) for v in then] or [""] * len(cells)
            cells = [cell for pair in zip(cells, beside_cells, strict=True) for cell in pair]
        rows.append((metric, *cells, *([allowed.get(metric, "")] if allowed else []), units[metric]))
    limit = number_columns(*(["limit"] if allowed else []))
    columns = *text_columns(title), *number_columns(*figures), *limit, *text_columns("unit")
    return Report((Table(columns, tuple(rows)),) if rows else ())


def metric_cell(metric: str, value: float, digits: int = 4, least_percent: float = 1e-3) -> str:
    """A metric's figure in a table; of a smaller percentage than the least only that it is smaller."""
    if metric in TIMES_OR_NEVER and isnan(value):
        return "never"
    if percent_factor(metric) == 100 and 0 < abs(value) < least_percent:
        return f"<{TIED}{least_percent:g}"
    return format_number(value, digits)
