"""Identify and optimally tune pneumatic drives, and any servo axis with friction.

The concept map, in the order in which data flow:

    read_log(path)                    -> Experiment: a measured Trajectory, its noise and conditions
    read_drive(path)                  -> a drive and its ParameterSet; or build one: ForceDrive(Stribeck())
    identify(system, logs, freed)     -> IdentificationResult: estimates with confidence intervals
    select_model(systems, logs, ...)  -> which of several models the logs support, and why
    identifiability(system, logs, freed) -> Verdict: what the logs can tell, in words, before a fit
    profile, propagate_error(...)     -> an interval where a linear one lies; one of a figure made of estimates
    validate(system, logs, fitted)    -> how well a held-out log is predicted, and what is left in the residuals
    ClosedLoop(system, PID, Dither)   -> the loop to be tuned, continuous or sampled
    tune(loop, steps, freed, ...)     -> TuningResult: gains and dither, claimed and certified
    validate_design(loop, ...)        -> a design on fresh plants: worst, 95th percentile, violations
    judge_dither(loop, steps, tuned)  -> whether the dither is useful, useless or harmful, and why, in numbers
    find_limit_cycle(t, speed)        -> hunting or crawl in a response or a log: amplitude, frequency, stick share
    evaluate, simulate                -> certified metrics; any trajectory, independently of the optimiser
    bumpless_transfer(loop, x, ...)   -> the state from which a running loop goes on with new gains, without a bump
    record(Rig(loop, sensors), ...)   -> the log of a rig with stick-slip, hysteresis, sensors; and the truth
    pareto_front(loop, steps, ...)    -> what one requirement costs in terms of another: a row a certified design
    grid, sweep(fn, parameters, cases)-> a study: any function over named cases, in processes, as a table

Names are loaded when first used; importing the package costs nothing.
"""

import importlib
import sys
from types import ModuleType
from typing import Any

_HOME = {
    "pneuopt.quantities.errors": ("ConvergenceError", "InputError", "PhysicsWarning", "PneuoptError"),
    "pneuopt.quantities.parameters": ("Parameter", "ParameterSet", "Quantity"),
    "pneuopt.quantities.trajectories": ("Trajectory",),
    "pneuopt.dynamics.system": ("DiscreteSystem", "Linearisation", "System", "define", "discretise"),
    "pneuopt.quantities.status": (
        "Code",
        "Status",
    ),
    "pneuopt.dynamics.stick_slip": ("EventKind",),
    "pneuopt.models.friction": (
        "Asymmetric",
        "Coulomb",
        "LuGre",
        "PressureDependent",
        "Stribeck",
        "Viscous",
    ),
    "pneuopt.models.friction_laws": ("friction_ladder",),
    "pneuopt.models.load_dependent": ("LoadDependent",),
    "pneuopt.models.karnopp": ("Karnopp",),
    "pneuopt.models.load": ("Load",),
    "pneuopt.models.drive": ("ForceDrive", "MotionDrive"),
    "pneuopt.models.rotary": ("RotaryDrive",),
    "pneuopt.models.linear": ("FirstOrder", "Integrator", "SecondOrder"),
    "pneuopt.models.pneumatic.gas": ("IsentropicNozzle", "Iso6358"),
    "pneuopt.models.pneumatic.valve": ("ProportionalValve", "Spool"),
    "pneuopt.models.pneumatic.chamber": ("Polytropic", "Thermal"),
    "pneuopt.models.pneumatic.cylinder": ("Cylinder",),
    "pneuopt.models.pneumatic.drive": ("PneumaticDrive",),
    "pneuopt.control.pid": ("PID",),
    "pneuopt.control.dither": ("Dither", "Waveform"),
    "pneuopt.evaluation.limit_cycle": ("LimitCycle", "find_limit_cycle"),
    "pneuopt.evaluation.dither_verdict": ("DitherVerdict", "Usefulness", "dither_effect", "judge_dither"),
    "pneuopt.control.feedforward": ("Feedforward",),
    "pneuopt.control.forms": (
        "Form",
        "ParallelForm",
        "SeriesForm",
        "StandardForm",
        "proportional_band",
        "proportional_gain",
        "to_parallel",
        "to_series",
        "to_standard",
    ),
    "pneuopt.control.bumpless": ("bumpless_transfer",),
    "pneuopt.control.reference": ("Step",),
    "pneuopt.control.sensor": ("Encoder", "SensorLag"),
    "pneuopt.control.loop": ("ClosedLoop",),
    "pneuopt.control.linear_loop": ("linear_plant", "open_loop"),
    "pneuopt.control.averaging": ("average_dither", "mean_start", "ripple"),
    "pneuopt.evaluation.margins": ("Margins", "frequency_response", "margins"),
    "pneuopt.evaluation.metrics": ("BandCentre", "step_metrics"),
    "pneuopt.shooting.least_squares": ("LeastSquares",),
    "pneuopt.shooting.full_space": ("FullSpace",),
    "pneuopt.logs.experiments": ("Experiment", "differentiate", "read_log", "resample", "split"),
    "pneuopt.dynamics.simulate": ("StickSlipResult", "contacts", "simulate", "simulate_stick_slip"),
    "pneuopt.evaluation.rig": ("Actuator", "Rig", "Sensor"),
    "pneuopt.evaluation.record": ("Recording", "record"),
    "pneuopt.identification.identify": ("identify", "predict", "validate"),
    "pneuopt.identification.identifiability": ("identifiability",),
    "pneuopt.identification.result": ("IdentificationResult", "Verdict"),
    "pneuopt.identification.profiles": ("Profile", "profile"),
    "pneuopt.identification.propagation": ("PropagatedValue", "propagate_error"),
    "pneuopt.evaluation.energy": ("EnergyUse",),
    "pneuopt.evaluation.requirements": (
        "IAE",
        "ISE",
        "ITAE",
        "AirUse",
        "ControlRate",
        "GainMargin",
        "MaxComplementarySensitivity",
        "MaxSensitivity",
        "NoiseGain",
        "Overshoot",
        "PeakControl",
        "PhaseMargin",
        "Ripple",
        "RiseTime",
        "SettlingTime",
        "SteadyStateError",
        "StepEnvelope",
    ),
    "pneuopt.tuning.condensed": ("Condensed",),
    "pneuopt.tuning.screening": ("Screening",),
    "pneuopt.tuning.two_phase": ("TwoPhase",),
    "pneuopt.evaluation.evaluate": ("evaluate", "respond"),
    "pneuopt.tuning.tune": ("TuningResult", "tune"),
    "pneuopt.evaluation.scenarios": ("Factor", "apply_scenario", "corners", "draws", "samples", "tolerances"),
    "pneuopt.identification.compare_logs": ("LogComparison", "compare_logs"),
    "pneuopt.identification.losses": ("Huber", "SoftL1"),
    "pneuopt.models.sensing": ("coarse_delay", "with_sensors"),
    "pneuopt.identification.select_model": ("ModelSelection", "select_model"),
    "pneuopt.tuning.pareto": ("pareto_front",),
    "pneuopt.studies.sweep": ("grid", "sweep"),
    "pneuopt.tuning.validation": ("DesignValidation", "validate_design"),
    "pneuopt.files.drive": ("read_drive", "write_fit"),
    "pneuopt.files.tuning": ("read_tuning", "write_tuned"),
    "pneuopt.plotting": (
        "plot_bode",
        "plot_correlation",
        "plot_fit",
        "plot_friction",
        "plot_front",
        "plot_map",
        "plot_prediction",
        "plot_residuals",
        "plot_steps",
        "save_figure",
    ),
}
_MODULE = {name: module for module, names in _HOME.items() for name in names}
__version__ = "0.1.0"
__all__ = sorted(_MODULE)  # noqa: PLE0605 - the stub beside this file spells it out


def __getattr__(name: str) -> Any:
    if name not in _MODULE:
        raise AttributeError(f"module 'pneuopt' has no attribute {name!r}")
    value = getattr(importlib.import_module(_MODULE[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULE})


class _Package(ModuleType):
    def __setattr__(self, name: str, value: Any) -> None:
        # the import of a submodule, `pneuopt.identification.identify` say, must not hide the verb of that name
        if not (name in _MODULE and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
