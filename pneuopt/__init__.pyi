"""Types of the names that `__init__.py` loads lazily."""

from pneuopt.control.averaging import average_dither, mean_start, ripple
from pneuopt.control.bumpless import bumpless_transfer
from pneuopt.control.dither import Dither, Waveform
from pneuopt.control.feedforward import Feedforward
from pneuopt.control.forms import (
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
from pneuopt.control.linear_loop import linear_plant, open_loop
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.control.sensor import Encoder, SensorLag
from pneuopt.dynamics.simulate import StickSlipResult, contacts, simulate, simulate_stick_slip
from pneuopt.dynamics.stick_slip import EventKind
from pneuopt.dynamics.system import DiscreteSystem, Linearisation, System, define, discretise
from pneuopt.evaluation.dither_verdict import DitherVerdict, Usefulness, dither_effect, judge_dither
from pneuopt.evaluation.energy import EnergyUse
from pneuopt.evaluation.evaluate import evaluate, respond
from pneuopt.evaluation.limit_cycle import LimitCycle, find_limit_cycle
from pneuopt.evaluation.margins import Margins, frequency_response, margins
from pneuopt.evaluation.metrics import BandCentre, step_metrics
from pneuopt.evaluation.record import Recording, record
from pneuopt.evaluation.requirements import (
    IAE,
    ISE,
    ITAE,
    AirUse,
    ControlRate,
    GainMargin,
    MaxComplementarySensitivity,
    MaxSensitivity,
    NoiseGain,
    Overshoot,
    PeakControl,
    PhaseMargin,
    Ripple,
    RiseTime,
    SettlingTime,
    SteadyStateError,
    StepEnvelope,
)
from pneuopt.evaluation.rig import Actuator, Rig, Sensor
from pneuopt.evaluation.scenarios import Factor, apply_scenario, corners, draws, samples, tolerances
from pneuopt.files.drive import read_drive, write_fit
from pneuopt.files.tuning import read_tuning, write_tuned
from pneuopt.identification.compare_logs import LogComparison, compare_logs
from pneuopt.identification.identifiability import identifiability
from pneuopt.identification.identify import identify, predict, validate
from pneuopt.identification.losses import Huber, SoftL1
from pneuopt.identification.profiles import Profile, profile
from pneuopt.identification.propagation import PropagatedValue, propagate_error
from pneuopt.identification.result import IdentificationResult, Verdict
from pneuopt.identification.select_model import ModelSelection, select_model
from pneuopt.logs.experiments import Experiment, differentiate, read_log, resample, split
from pneuopt.models.drive import ForceDrive, MotionDrive
from pneuopt.models.friction import (
    Asymmetric,
    Coulomb,
    LuGre,
    PressureDependent,
    Stribeck,
    Viscous,
)
from pneuopt.models.friction_laws import friction_ladder
from pneuopt.models.karnopp import Karnopp
from pneuopt.models.linear import FirstOrder, Integrator, SecondOrder
from pneuopt.models.load import Load
from pneuopt.models.load_dependent import LoadDependent
from pneuopt.models.pneumatic.chamber import Polytropic, Thermal
from pneuopt.models.pneumatic.cylinder import Cylinder
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.models.pneumatic.gas import IsentropicNozzle, Iso6358
from pneuopt.models.pneumatic.valve import ProportionalValve, Spool
from pneuopt.models.rotary import RotaryDrive
from pneuopt.models.sensing import coarse_delay, with_sensors
from pneuopt.plotting import (
    plot_bode,
    plot_correlation,
    plot_fit,
    plot_friction,
    plot_front,
    plot_map,
    plot_prediction,
    plot_residuals,
    plot_steps,
    save_figure,
)
from pneuopt.quantities.errors import ConvergenceError, InputError, PhysicsWarning, PneuoptError
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.full_space import FullSpace
from pneuopt.shooting.least_squares import LeastSquares
from pneuopt.studies.sweep import grid, sweep
from pneuopt.tuning.condensed import Condensed
from pneuopt.tuning.pareto import pareto_front
from pneuopt.tuning.screening import Screening
from pneuopt.tuning.tune import TuningResult, tune
from pneuopt.tuning.two_phase import TwoPhase
from pneuopt.tuning.validation import DesignValidation, validate_design

__version__: str
__all__ = [
    "IAE",
    "ISE",
    "ITAE",
    "PID",
    "Actuator",
    "AirUse",
    "Asymmetric",
    "BandCentre",
    "ClosedLoop",
    "Code",
    "Condensed",
    "ControlRate",
    "ConvergenceError",
    "Coulomb",
    "Cylinder",
    "DesignValidation",
    "DiscreteSystem",
    "Dither",
    "DitherVerdict",
    "Encoder",
    "EnergyUse",
    "EventKind",
    "Experiment",
    "Factor",
    "Feedforward",
    "FirstOrder",
    "ForceDrive",
    "Form",
    "FullSpace",
    "GainMargin",
    "Huber",
    "IdentificationResult",
    "InputError",
    "Integrator",
    "IsentropicNozzle",
    "Iso6358",
    "Karnopp",
    "LeastSquares",
    "LimitCycle",
    "Linearisation",
    "Load",
    "LoadDependent",
    "LogComparison",
    "LuGre",
    "Margins",
    "MaxComplementarySensitivity",
    "MaxSensitivity",
    "ModelSelection",
    "MotionDrive",
    "NoiseGain",
    "Overshoot",
    "ParallelForm",
    "Parameter",
    "ParameterSet",
    "PeakControl",
    "PhaseMargin",
    "PhysicsWarning",
    "PneumaticDrive",
    "PneuoptError",
    "Polytropic",
    "PressureDependent",
    "Profile",
    "PropagatedValue",
    "ProportionalValve",
    "Quantity",
    "Recording",
    "Rig",
    "Ripple",
    "RiseTime",
    "RotaryDrive",
    "Screening",
    "SecondOrder",
    "Sensor",
    "SensorLag",
    "SeriesForm",
    "SettlingTime",
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
    "Trajectory",
    "TuningResult",
    "TwoPhase",
    "Usefulness",
    "Verdict",
    "Viscous",
    "Waveform",
    "apply_scenario",
    "average_dither",
    "bumpless_transfer",
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
    "find_limit_cycle",
    "frequency_response",
    "friction_ladder",
    "grid",
    "identifiability",
    "identify",
    "judge_dither",
    "linear_plant",
    "margins",
    "mean_start",
    "open_loop",
    "pareto_front",
    "plot_bode",
    "plot_correlation",
    "plot_fit",
    "plot_friction",
    "plot_front",
    "plot_map",
    "plot_prediction",
    "plot_residuals",
    "plot_steps",
    "predict",
    "profile",
    "propagate_error",
    "proportional_band",
    "proportional_gain",
    "read_drive",
    "read_log",
    "read_tuning",
    "record",
    "resample",
    "respond",
    "ripple",
    "samples",
    "save_figure",
    "select_model",
    "simulate",
    "simulate_stick_slip",
    "split",
    "step_metrics",
    "sweep",
    "to_parallel",
    "to_series",
    "to_standard",
    "tolerances",
    "tune",
    "validate",
    "validate_design",
    "with_sensors",
    "write_fit",
    "write_tuned",
]
