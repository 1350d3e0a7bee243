"""`evaluate`: the metrics of a loop's gains, by a simulation that no search takes part in; or those of a rig."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import inf, nan
from typing import TYPE_CHECKING, Any

import numpy as np

from pneuopt.control.loop import ClosedLoop, add_disturbances
from pneuopt.control.reference import Reference, as_references
from pneuopt.dynamics.simulate import MAX_STEPS, simulate
from pneuopt.evaluation.band import Band
from pneuopt.evaluation.budget import POINTS_PER_READING, check_steps
from pneuopt.evaluation.cases import TuningCase, cases
from pneuopt.evaluation.limit_cycle import MIN_RELATIVE_AMPLITUDE, TRANSIENT_SHARE, find_limit_cycle
from pneuopt.evaluation.meter import meter_metrics
from pneuopt.evaluation.metrics import Envelope
from pneuopt.evaluation.operating_points import margin_rows, worst_margins
from pneuopt.evaluation.record import record
from pneuopt.evaluation.resolution import MAX_REFINEMENTS, refine_instants
from pneuopt.evaluation.response import loop_inputs, measure, readings_a_sample, sample_spacing
from pneuopt.evaluation.rig import Rig
from pneuopt.evaluation.scenarios import NO_SCENARIOS, Scenarios
from pneuopt.evaluation.travel import check_travel
from pneuopt.quantities.arguments import check_argument, check_parameters
from pneuopt.quantities.errors import ModelError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory

if TYPE_CHECKING:
    import pandas as pd

LIMIT_CYCLE_METRICS = ("LimitCycleAmplitude", "LimitCycleFrequency", "StickShare")


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
        operating points (`operating_point_margins`: at rest, sliding, at the end) of the linearised loop's
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
    >>> from pneuopt.models.drive import ForceDrive
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
    """One reference on one plant as `evaluate` finds it.

    Attributes
    ----------
    loop : ClosedLoop
        With inputs for the references' disturbances.
    case : TuningCase
    parameters : ParameterSet
        Every parameter of the loop, with this case's values.
    metrics : dict of str to float
    response : Trajectory
        States and outputs up to the horizon; a rig's truth.
    margins : tuple of dict
        The rows of `operating_point_margins`; none for a rig.
    """

    loop: ClosedLoop
    case: TuningCase
    parameters: ParameterSet
    metrics: dict[str, float]
    response: Trajectory
    margins: tuple[dict[str, Any], ...] = ()


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
        yield _evaluate_case(inner, rig, case, full, band, envelope)


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


def _evaluate_case(
    loop: ClosedLoop, rig: Rig | None, case: TuningCase, parameters: ParameterSet, band: Band, envelope: Envelope
) -> CaseEvaluation:
    parameters = case.case_parameters(parameters)
    response = _respond(loop, rig, case.reference, parameters)
    metrics = measure(loop, parameters, case.reference, response, band, envelope)
    metrics |= limit_cycle_metrics(loop, parameters, case.reference, response)
    metrics |= meter_metrics(loop, parameters, response, case.reference.at)
    rows = margin_rows(loop, parameters, case.reference, response) if rig is None else ()
    return CaseEvaluation(loop, case, parameters, metrics | worst_margins(rows), response, rows)


def limit_cycle_metrics(
    loop: ClosedLoop, parameters: ParameterSet, reference: Reference, response: Trajectory
) -> dict[str, float]:
    """Metrics of the limit cycle after the transient, which takes the first 40 % after the step; amplitude 0: none.

    Returns
    -------
    dict of str to float
        LimitCycleAmplitude [measured unit], LimitCycleFrequency [Hz] and StickShare, the share of time at a standstill.
    """
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
    loop = add_disturbances(model.loop, references)
    return loop, replace(rig, model=loop) if rig is not None else None
