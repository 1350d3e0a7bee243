"""`evaluate`: what a loop's gains are worth, by a simulation that shares nothing with the search; or on a rig."""

from collections.abc import Sequence
from dataclasses import replace
from math import inf, nan
from typing import TYPE_CHECKING

import numpy as np

from pneuopt.control.disturbance import add_disturbances
from pneuopt.control.linear_loop import linear_gains
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Step
from pneuopt.dynamics.simulate import simulate
from pneuopt.evaluation.cases import TuningCase, cases
from pneuopt.evaluation.dither_mean import period_mean
from pneuopt.evaluation.limit_cycle import MIN_RELATIVE_AMPLITUDE, TRANSIENT_SHARE, find_limit_cycle
from pneuopt.evaluation.margins import margins, noise_gain
from pneuopt.evaluation.meter import meter_metrics
from pneuopt.evaluation.metrics import Envelope
from pneuopt.evaluation.record import record
from pneuopt.evaluation.response import linearise_open_loop, loop_inputs, measure, readings_a_sample, sample_spacing
from pneuopt.evaluation.rig import Rig
from pneuopt.evaluation.scenarios import NO_SCENARIOS, Scenarios
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ModelError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory

if TYPE_CHECKING:
    import pandas as pd

LIMIT_CYCLE_METRICS = ("LimitCycleAmplitude", "LimitCycleFrequency", "StickShare")
POINTS_PER_READING = 4  # points of the record a reading of the search's


def evaluate(
    loop: ClosedLoop | Rig,
    references: Step | Sequence[Step],
    parameters: ParameterSet,
    *,
    scenarios: Scenarios = NO_SCENARIOS,
    band: float = 0.02,
    envelope: Envelope = (),
) -> "pd.DataFrame":
    """Certified metrics: by the tight independent simulation, at the given parameters.

    Parameters
    ----------
    loop : ClosedLoop or Rig
        What is measured is the plant's true signal, not what a sensor shows the controller of it. A rig's loop runs
        behind the rig's actuator and sensors (`record`, seed 0), and is measured at the controller's samples;
        PeakControl is then what gets through the actuator. Margins are those of a smooth loop: a rig has none.
    references : Step or sequence of Step
        Each from rest, or from steady motion.
    parameters : ParameterSet
    scenarios : mapping of str to mapping, optional
        Further plants, or tolerances: of `corners`, `samples`, `draws`, `tolerances`.
    band : float
        Half width of the settling band around the reference, a fraction of the step.
    envelope : sequence of (float, float, float)
        The bounds of a `StepEnvelope`.

    Returns
    -------
    DataFrame
        A row a metric, a column a reference ("0 to 0.25"), then one a reference and scenario
        ("0 to 0.25 [load.mass high]"): those of `step_metrics`, LimitCycleAmplitude [measured unit],
        LimitCycleFrequency [Hz] and StickShare where it hunts, of a pneumatic drive AirUse [l(ANR)] and ValveTravel
        [half travels], then, not for a rig,
        MaxSensitivity, MaxComplementarySensitivity, GainMargin, PhaseMargin [deg] and NoiseGain [command's
        unit/measured unit] of the loop linearised about the state and command in which the response ends, under
        dither their means over its last period, with the slope that friction has at that speed, of drives that have a
        load FrictionSlope [N s/m]; infinite, and the margins NaN, where that loop is unstable.

    Raises
    ------
    InputError
        If two references have one label, or a scenario names an unknown parameter.
    ConvergenceError
        If the simulation stops.

    Warns
    -----
    PhysicsWarning
        If the piston reaches an end stop, or a chamber is emptied.

    Examples
    --------
    >>> from pneuopt.control.pid import PID
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
    import pandas as pd

    steps = [references] if isinstance(references, Step) else list(references)
    inner, rig = _loop_and_rig(loop, steps)
    full = inner.parameters | parameters
    every = cases(steps, scenarios, full)
    return pd.DataFrame({case.label: _evaluate_case(inner, rig, case, full, band, envelope) for case in every})


def respond(loop: ClosedLoop | Rig, reference: Step, parameters: ParameterSet) -> Trajectory:
    """The response that `evaluate` measures, from rest or from steady motion.

    Parameters
    ----------
    loop : ClosedLoop or Rig
    reference : Step
    parameters : ParameterSet

    Returns
    -------
    Trajectory
        Of a loop states and outputs, simulated tightly, on a grid finer than the search's; of a rig the truth.
    """
    return _respond(*_loop_and_rig(loop, [reference]), reference, parameters)


def _respond(loop: ClosedLoop, rig: Rig | None, reference: Step, parameters: ParameterSet) -> Trajectory:
    run = loop_inputs(loop, reference, sample_spacing(loop, reference, parameters))
    start = loop.initial(parameters, reference=reference.initial, start=reference.start)
    if rig is not None:
        return record(rig, run, parameters, initial=start).truth
    count = POINTS_PER_READING * readings_a_sample(loop, reference) * (len(run) - 1) + 1
    return simulate(loop, run, parameters, initial=start, t_out=np.linspace(run.t[0], run.t[-1], count))


def _evaluate_case(
    loop: ClosedLoop, rig: Rig | None, case: TuningCase, parameters: ParameterSet, band: float, envelope: Envelope
) -> dict[str, float]:
    parameters = case.case_parameters(parameters)
    response = _respond(loop, rig, case.reference, parameters)
    metrics = measure(loop, parameters, case.reference, response, band, envelope)
    metrics |= limit_cycle_metrics(loop, parameters, case.reference, response)
    metrics |= meter_metrics(loop, parameters, response, case.reference.at)
    if rig is not None:
        return metrics
    x, command = final_operating_point(loop, parameters, response)
    metrics |= friction_slope(loop, parameters, x, command)
    return metrics | _margin_metrics(loop, parameters, x, command, case.reference)


def final_operating_point(loop: ClosedLoop, parameters: ParameterSet, response: Trajectory) -> tuple[Array, float]:
    """The plant's state, shape (n_plant_states,), and the command in which a response ends.

    Under dither they are means over its last period: at an instant they depend on the dither's phase.
    """
    rows = np.array([response[n] for n in (*(q.name for q in loop.plant.states), "control")])
    period = loop.dither_period(parameters) or np.inf
    if period <= response.t[-1] - response.t[0]:
        ends = period_mean(response.t, rows, 0.0, period, np.array([response.t[-1] - period / 2]))[:, 0]
    else:
        ends = rows[:, -1]
    return ends[:-1], float(ends[-1])


def limit_cycle_metrics(
    loop: ClosedLoop, parameters: ParameterSet, reference: Step, response: Trajectory
) -> dict[str, float]:
    """The limit cycle in what follows the transient, for which the step's first 40 % are taken; amplitude 0: none.

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


def friction_slope(loop: ClosedLoop, parameters: ParameterSet, x: Array, command: float) -> dict[str, float]:
    """FrictionSlope, the static friction's derivative to speed at a plant state [N s/m], of drives that have a load.

    With this slope friction is in the linearised loop at low frequencies, its own states, bristles, following; a
    negative one makes crawl likely.
    """
    states, full, axis = [q.name for q in loop.plant.states], loop.parameters | parameters, loop.plant.axis
    if axis is None or not any(n.startswith("friction.") for n in loop.plant.parameters):
        return {}
    A = loop.plant.linearise(x, {loop.command.name: command}, full).A
    v, z = states.index(axis.speed), [k for k, n in enumerate(states) if n.startswith("friction.")]
    followed = A[v, z] @ np.linalg.solve(A[np.ix_(z, z)], A[z, v]) if z else 0.0
    return {"FrictionSlope": float(-full.value(axis.inertia) * (A[v, v] - followed))}


def _margin_metrics(
    loop: ClosedLoop, parameters: ParameterSet, x: Array, command: float, reference: Step
) -> dict[str, float]:
    open_loop = linearise_open_loop(loop, parameters, x, command, reference)
    robust = margins(open_loop)
    Kp, Ki, Kd, Tf = linear_gains(loop, loop.parameter_vector(parameters)).full().ravel().tolist()
    found = {
        "MaxSensitivity": robust.max_sensitivity,
        "MaxComplementarySensitivity": robust.max_complementary_sensitivity,
        "GainMargin": robust.gain_margin,
        "PhaseMargin": robust.phase_margin,
        "NoiseGain": noise_gain(open_loop, (Kp, Ki, Kd, Tf)),
    }
    return found if robust.stable else {n: nan if n.endswith("Margin") else inf for n in found}


def _loop_and_rig(model: ClosedLoop | Rig, references: Sequence[Step]) -> tuple[ClosedLoop, Rig | None]:
    """The loop with the inputs of the references' disturbances, and the rig in which it runs, if any."""
    rig = model if isinstance(model, Rig) else None
    loop = rig.loop if rig is not None else model
    if not isinstance(loop, ClosedLoop):
        raise ModelError("this rig is a plant alone, which follows no reference; give it a ClosedLoop")
    loop = add_disturbances(loop, references)
    return loop, replace(rig, model=loop) if rig is not None else None
