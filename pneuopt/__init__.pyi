"""The public names and their homes, from which `__init__.py` loads them when they are first used."""

from . import plotting
from .control.averaging import average_dither, mean_start, ripple
from .control.compensators import (
    AccelerationFeedback,
    DeadZoneInverse,
    Direction,
    FrictionFeedforward,
    ImpulsiveControl,
    Knocker,
    MotionFeedforward,
    PressureFeedback,
)
from .control.controller import Feedforward, PositionLoop
from .control.dither import Dither, Waveform
from .control.gain_schedule import GainSchedule
from .control.linear_loop import linear_plant, open_loop
from .control.loop import ClosedLoop, bumpless_transfer
from .control.moves import MotionPath, Move, MoveProfile, MoveSequence
from .control.pid import (
    PID,
    AntiWindup,
    Form,
    ParallelForm,
    SeriesForm,
    StandardForm,
    proportional_band,
    proportional_gain,
    to_parallel,
    to_series,
    to_standard,
)
from .control.reference import Reference, Step
from .control.sensor import Encoder, SensorLag
from .dynamics.python_control import from_control, to_control
from .dynamics.simulate import StickSlipResult, contacts, simulate, simulate_stick_slip
from .dynamics.stick_slip import EventKind
from .dynamics.system import DiscreteSystem, Linearisation, System, add_dead_time, define, discretise
from .evaluation.certificate import Certificate, Defect, Finding, certificate
from .evaluation.dither import (
    CompensatorVerdict,
    DitherVerdict,
    Usefulness,
    dither_effect,
    judge_compensators,
    judge_dither,
)
from .evaluation.evaluate import evaluate, respond
from .evaluation.limit_cycle import LimitCycle, NoHunting, RestCase, RestCheck, RestKind, check_rest, find_limit_cycle
from .evaluation.margins import Margins, frequency_response, margins
from .evaluation.metric import Tolerance
from .evaluation.metrics import BandCentre, step_metrics
from .evaluation.moves import ExcitationRun, check_move, excitation_run, shortest_move
from .evaluation.plants import ExpectedPlants, expected_plants, monte_carlo
from .evaluation.requirements import (
    IAE,
    ISE,
    ITAE,
    AirUse,
    Compliance,
    ControlRate,
    EnergyUse,
    FollowingError,
    FollowingErrorRMS,
    GainMargin,
    MaxComplementarySensitivity,
    MaxSensitivity,
    NoiseGain,
    Overshoot,
    OvershootDistance,
    PeakControl,
    PhaseMargin,
    Ripple,
    RiseTime,
    SettlingTime,
    SettlingTimeRaw,
    SteadyStateError,
    StepEnvelope,
)
from .evaluation.rig import Actuator, Recording, Rig, Sensor, record
from .evaluation.scenarios import (
    Factor,
    LogNormal,
    LogUniform,
    Normal,
    Sampling,
    Uniform,
    apply_scenario,
    corners,
    draws,
    samples,
    tolerances,
)
from .experiments.design import AOptimal, DOptimal, ExperimentDesign, Precision, WantedPrecision
from .experiments.next_experiment import DesignOutlook, next_experiment, predict_loss
from .export.blocks import export_settings
from .export.fmu import export_fmu
from .export.languages import Language, export_controller
from .export.makers import Block
from .files.drive import read_drive, write_fit
from .files.outputs import load_result
from .files.tuned import write_tuned
from .files.tuning import read_path, read_tuning
from .identification.checkup import Assumption, Checkup, check
from .identification.forecast import predict, validate
from .identification.identifiability import examine_logs, identifiability
from .identification.identify import identify
from .identification.losses import Huber, SoftL1
from .identification.profiles import Profile, PropagatedValue, profile, propagate_error
from .identification.result import ChosenWindow, IdentificationResult, Mark, Verdict
from .identification.select_model import ModelSelection, select_model
from .identification.tracking import LogComparison, Tracking, compare_logs, track
from .logs.doctor import LogFinding, Severity
from .logs.experiment import Experiment, differentiate, resample, split
from .logs.read_log import read_log
from .models import catalog
from .models.drive_kinds import stick_slip_drive
from .models.drives import ForceDrive, MotionDrive, RotaryDrive
from .models.friction import (
    Asymmetric,
    Coulomb,
    Karnopp,
    LoadDependent,
    LuGre,
    Presliding,
    PressureDependent,
    Stribeck,
    Viscous,
    friction_ladder,
)
from .models.linear import FirstOrder, Integrator, SecondOrder
from .models.load import Load
from .models.pneumatic.chamber import Polytropic, Thermal
from .models.pneumatic.cylinder import Cylinder
from .models.pneumatic.drive import PneumaticDrive
from .models.pneumatic.gas import IsentropicNozzle, Iso6358
from .models.pneumatic.valve import ProportionalValve, Spool
from .models.sensing import coarse_delay, with_sensors
from .plotting.canvas import save_figure
from .plotting.diagram import plot_loop
from .plotting.fits import plot_correlation, plot_fit, plot_friction, plot_prediction, plot_residuals
from .plotting.logs import plot_logs
from .plotting.loops import plot_bode, plot_steps
from .plotting.studies import plot_distribution, plot_front, plot_map, plot_sensitivity, plot_tracking
from .quantities.errors import ConvergenceError, InputError, PhysicsWarning, PneuoptError
from .quantities.parameters import Intersample, Parameter, ParameterSet, Quantity
from .quantities.report import Report
from .quantities.status import Code, Progress, Status
from .quantities.trajectories import Trajectory
from .report.tuning_page import write_report
from .shooting.full_space import FullSpace
from .shooting.least_squares import LeastSquares
from .studies.batch import BatchEvaluation, evaluate_batch
from .studies.bootstrap import Bootstrap, bootstrap
from .studies.executors import Processes, open_executor
from .studies.journal import Journal, RowFile
from .studies.sensitivity import (
    LocalSensitivity,
    Sensitivity,
    local_sensitivity,
    search_again,
    sensitivity,
    sweep_from_neighbours,
)
from .studies.sweep import grid, read_cases, sweep
from .tuning.front import pareto_front
from .tuning.racing import Racing
from .tuning.tune import TuningResult, certify, tune, tune_without_dither
from .tuning.two_phase import TwoPhase
from .tuning.validation import DesignValidation, validate_design

__version__: str
__all__ = [
    "IAE",
    "ISE",
    "ITAE",
    "PID",
    "AOptimal",
    "AccelerationFeedback",
    "Actuator",
    "AirUse",
    "AntiWindup",
    "Assumption",
    "Asymmetric",
    "BandCentre",
    "BatchEvaluation",
    "Block",
    "Bootstrap",
    "Certificate",
    "Checkup",
    "ChosenWindow",
    "ClosedLoop",
    "Code",
    "CompensatorVerdict",
    "Compliance",
    "ControlRate",
    "ConvergenceError",
    "Coulomb",
    "Cylinder",
    "DOptimal",
    "DeadZoneInverse",
    "Defect",
    "DesignOutlook",
    "DesignValidation",
    "Direction",
    "DiscreteSystem",
    "Dither",
    "DitherVerdict",
    "Encoder",
    "EnergyUse",
    "EventKind",
    "ExcitationRun",
    "ExpectedPlants",
    "Experiment",
    "ExperimentDesign",
    "Factor",
    "Feedforward",
    "Finding",
    "FirstOrder",
    "FollowingError",
    "FollowingErrorRMS",
    "ForceDrive",
    "Form",
    "FrictionFeedforward",
    "FullSpace",
    "GainMargin",
    "GainSchedule",
    "Huber",
    "IdentificationResult",
    "ImpulsiveControl",
    "InputError",
    "Integrator",
    "Intersample",
    "IsentropicNozzle",
    "Iso6358",
    "Journal",
    "Karnopp",
    "Knocker",
    "Language",
    "LeastSquares",
    "LimitCycle",
    "Linearisation",
    "Load",
    "LoadDependent",
    "LocalSensitivity",
    "LogComparison",
    "LogFinding",
    "LogNormal",
    "LogUniform",
    "LuGre",
    "Margins",
    "Mark",
    "MaxComplementarySensitivity",
    "MaxSensitivity",
    "ModelSelection",
    "MotionDrive",
    "MotionFeedforward",
    "MotionPath",
    "Move",
    "MoveProfile",
    "MoveSequence",
    "NoHunting",
    "NoiseGain",
    "Normal",
    "Overshoot",
    "OvershootDistance",
    "ParallelForm",
    "Parameter",
    "ParameterSet",
    "PeakControl",
    "PhaseMargin",
    "PhysicsWarning",
    "PneumaticDrive",
    "PneuoptError",
    "Polytropic",
    "PositionLoop",
    "Precision",
    "Presliding",
    "PressureDependent",
    "PressureFeedback",
    "Processes",
    "Profile",
    "Progress",
    "PropagatedValue",
    "ProportionalValve",
    "Quantity",
    "Racing",
    "Recording",
    "Reference",
    "Report",
    "RestCase",
    "RestCheck",
    "RestKind",
    "Rig",
    "Ripple",
    "RiseTime",
    "RotaryDrive",
    "RowFile",
    "Sampling",
    "SecondOrder",
    "Sensitivity",
    "Sensor",
    "SensorLag",
    "SeriesForm",
    "SettlingTime",
    "SettlingTimeRaw",
    "Severity",
    "SoftL1",
    "Spool",
    "StandardForm",
    "Status",
    "SteadyStateError",
    "Step",
    "StepEnvelope",
    "StickSlipResult",
    "Stribeck",
    "System",
    "Thermal",
    "Tolerance",
    "Tracking",
    "Trajectory",
    "TuningResult",
    "TwoPhase",
    "Uniform",
    "Usefulness",
    "Verdict",
    "Viscous",
    "WantedPrecision",
    "Waveform",
    "add_dead_time",
    "apply_scenario",
    "average_dither",
    "bootstrap",
    "bumpless_transfer",
    "catalog",
    "certificate",
    "certify",
    "check",
    "check_move",
    "check_rest",
    "coarse_delay",
    "compare_logs",
    "contacts",
    "corners",
    "define",
    "differentiate",
    "discretise",
    "dither_effect",
    "draws",
    "evaluate",
    "evaluate_batch",
    "examine_logs",
    "excitation_run",
    "expected_plants",
    "export_controller",
    "export_fmu",
    "export_settings",
    "find_limit_cycle",
    "frequency_response",
    "friction_ladder",
    "from_control",
    "grid",
    "identifiability",
    "identify",
    "judge_compensators",
    "judge_dither",
    "linear_plant",
    "load_result",
    "local_sensitivity",
    "margins",
    "mean_start",
    "monte_carlo",
    "next_experiment",
    "open_executor",
    "open_loop",
    "pareto_front",
    "plot_bode",
    "plot_correlation",
    "plot_distribution",
    "plot_fit",
    "plot_friction",
    "plot_front",
    "plot_logs",
    "plot_loop",
    "plot_map",
    "plot_prediction",
    "plot_residuals",
    "plot_sensitivity",
    "plot_steps",
    "plot_tracking",
    "plotting",
    "predict",
    "predict_loss",
    "profile",
    "propagate_error",
    "proportional_band",
    "proportional_gain",
    "read_cases",
    "read_drive",
    "read_log",
    "read_path",
    "read_tuning",
    "record",
    "resample",
    "respond",
    "ripple",
    "samples",
    "save_figure",
    "search_again",
    "select_model",
    "sensitivity",
    "shortest_move",
    "simulate",
    "simulate_stick_slip",
    "split",
    "step_metrics",
    "stick_slip_drive",
    "sweep",
    "sweep_from_neighbours",
    "to_control",
    "to_parallel",
    "to_series",
    "to_standard",
    "tolerances",
    "track",
    "tune",
    "tune_without_dither",
    "validate",
    "validate_design",
    "with_sensors",
    "write_fit",
    "write_report",
    "write_tuned",
]
