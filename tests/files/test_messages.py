"""What a user hears of a file that cannot be used: what triggers each message, and its words with their place."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.dynamics.system import System
from pneuopt.files.drive import read_drive, read_fit
from pneuopt.files.rig import read_rig
from pneuopt.files.study import read_axes, read_pareto, read_study, read_study_cases
from pneuopt.files.toml import read_toml
from pneuopt.files.tuning import read_scenarios, read_tuning
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb, Stribeck
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet
from tests.files.test_drive import AXIS, CYLINDER
from tests.files.test_loop import AT_5_06_V, ENCODER, SAFE, STANDARD, VALVE_DRIVE
from tests.files.test_rig import DRIVE, LOOP
from tests.files.test_study import CASE_RIG, FIT, FRONT, HEAD, RIG, SAMPLED, STUDY, UNITS
from tests.files.test_tuning import ACCEPT, BOXES, CAM, KINDS, MOVE, PLANT, REST_TUNING, TUNING, cam

FORCE_AXIS = ForceDrive(Coulomb()).system()
Read = Callable[[Path], object]


def tuning(plant: System = PLANT, parameters: ParameterSet | None = None) -> Read:
    return lambda path: read_tuning(path, plant, parameters)


def read_path_tuning(path: Path) -> object:
    cam(path.parent, "time [ms],position [mm]")
    return read_tuning(path, FORCE_AXIS)


def read_cases(path: Path) -> object:
    (path.parent / "fit.toml").write_text(FIT, encoding="utf-8")
    (path.parent / "plants.csv").write_text("load.mass [g]\n4000\n6000\n", encoding="utf-8")
    study = read_study(path)
    return read_study_cases(study, read_fit(study.drive), CASE_RIG)


ANYWHERE, PLACE, LINE, REFERENCE = "", "^{path}: ", r"^{path}(:\d+)?: ", r"^{path}: \[\[reference\]\] 1"
BASES: dict[str, tuple[str, str, Read, str]] = {
    "drive": ("drive.toml", AXIS, read_drive, LINE),
    "a drive whose load is no section": (
        "drive.toml",
        f"load = 3\n{AXIS}".replace("[load]", "[rig]"),
        read_drive,
        LINE,
    ),
    "cylinder": ("drive.toml", CYLINDER, read_drive, ANYWHERE),
    "tuning": ("tuning.toml", TUNING, tuning(), PLACE),
    "empty tuning": ("tuning.toml", "", tuning(), PLACE),
    "requirements": ("tuning.toml", TUNING[: TUNING.index("[minimise]")] + KINDS, tuning(), PLACE),
    "accept": ("tuning.toml", ACCEPT, tuning(), PLACE),
    "no hunting": ("tuning.toml", REST_TUNING.format('"60 s"'), tuning(ForceDrive(Stribeck()).system()), PLACE),
    "scenarios": (
        "tuning.toml",
        "",
        lambda path: read_scenarios(read_toml(path).unwrap()["scenarios"], str(path), BOXES),
        PLACE,
    ),
    "move": ("tuning.toml", MOVE, tuning(FORCE_AXIS), REFERENCE),
    "path": ("tuning.toml", CAM, read_path_tuning, REFERENCE),
    "path of a speed": ("tuning.toml", CAM.replace("N/m", "N*s/m"), read_path_tuning, REFERENCE),
    "standard form": ("tuning.toml", STANDARD, tuning(), PLACE),
    "faults": ("tuning.toml", SAFE, tuning(VALVE_DRIVE.system(), AT_5_06_V), PLACE),
    "encoder": ("tuning.toml", ENCODER, tuning(FORCE_AXIS), PLACE),
    "rig": ("rig.toml", "", lambda path: read_rig(path, DRIVE, LOOP), PLACE),
    "study": ("study.toml", STUDY, lambda path: read_axes(read_study(path), RIG), PLACE),
    "front": ("study.toml", FRONT, lambda path: read_pareto(read_study(path), UNITS), PLACE),
    "cases": ("study.toml", HEAD, read_cases, ANYWHERE),
}
"""By what is edited: the file's name, its text, its reader, and where its messages begin."""
ROWS: dict[str, list[tuple[str, ...]]] = {
    "drive": [
        ('kind = "force"', "", '[drive] has no kind; write kind = "...", one of: pneumatic, force, motion, linear'),
        ('kind = "force"', 'kind = "forse"', "[drive]: unknown kind 'forse'; did you mean 'force'?"),
        ('kind = "force"', "kind = 3", "[drive] kind must be text, got 3"),
        ("[friction]", "[fricton]", ": unknown section 'fricton'; did you mean 'friction'?"),
        ("[load]", "[rig]", "kind 'force': unknown section 'rig'; did you mean 'drive'?"),
        ('model = "stribeck"', 'model = "stribek"', "[friction]: unknown model 'stribek'; did you mean 'stribeck'?"),
        ('model = "stribeck"', "", "[friction] has no model"),
        ("asymmetric = true", 'asymmetric = "yes"', "[friction] asymmetric must be true or false, got 'yes'"),
        ("asymmetric = true", 'pressure_dependent = ["pressure_c"]', "unknown chamber 'pressure_c'; did you mean"),
        ("coulomb = ", "coulom = ", "[friction]: unknown key 'coulom'; did you mean 'coulomb'?"),
        ('"20 N"', '"20"', "[friction] coulomb: '20' has no unit; write \"20 N\""),
        ('"20 N"', "20", '[friction] coulomb: 20 has no unit; write "20 N"'),
        ('"20 N"', '"20 mm"', "[friction] coulomb: unit 'mm' does not measure 'N'"),
        ('"20 N"', '"20,5 N"', 'write "20.5 N"'),
        ('"20 N"', '["20 N"]', "[friction] coulomb: ['20 N'] is not a number with a unit"),
        ('"20 N"', '"-20 N"', "[friction] coulomb: value -20 N lies outside its bounds [0, 100000]; move the value"),
        ('"95 kg"', '"195 kg"', "[load] mass: value 195 kg lies outside its bounds [50, 150]"),
        ('"50 kg"', '"160 kg"', "[load] mass: lower bound 160 lies above upper bound 150 kg"),
        ("upper =", "uper =", "[load] mass: unknown key 'uper'; did you mean 'upper'?"),
        ("free = true", "free = 1", "[load] mass: free must be true or false"),
        ("[load]", "[load", "not valid TOML"),
    ],
    "a drive whose load is no section": [
        ("", "", "load must be a section, [load]"),
    ],
    "cylinder": [
        (
            '"12 mm"',
            '"40 mm"',
            'drive.toml:5: [cylinder] rod = "40 mm" is impossible; a rod is thinner than the bore, 32 mm;',
        ),
        ('"12 mm"', '"-12 mm"', 'drive.toml:5: [cylinder] rod = "-12 mm" is impossible; '),
        ('= "32 mm"\nrod', '= "10 mm"\n# rod', "cylinder.rod = 12 mm is impossible; ", "10 mm", "the file has none"),
        ('"8 cm^3"', '"-8 cm^3"', 'drive.toml:7: [cylinder] dead_volume_a = "-8 cm^3" is impossible; ports and hoses'),
        ("= 0.3", "= 1.2", "drive.toml:11: [valve] critical_ratio = 1.2 is impossible; ", " between 0 and 1"),
        ("= 0.3", "= 0.7", "drive.toml:11: [valve] critical_ratio: value 0.7 1 lies outside its bounds [0.05, 0.6]"),
        (
            '"6 bar(g)"',
            '"-5 kPa(g)"',
            'drive.toml:15: [supply] pressure = "-5 kPa(g)" is impossible; ',
            " ambient ",
            " 1.01325 bar",
        ),
        ('"10 %"', '"110 %"', 'drive.toml:8: [cylinder] start = "110 %" is impossible; a start lies within the stroke'),
        ('"6 bar(g)"', '"6 bar"', "may be absolute or gauge"),
        ("dead_zone", "deadzone", "unknown key 'deadzone'; did you mean 'dead_zone'"),
        ("dead_zone = ", 'nominal_flow = "700 l/min(ANR)" #', "nominal_flow and conductance say the same; leave one"),
        (
            'conductance = "2e-8 m^3/(s*Pa)"',
            'nominal_flow = "700 l/min"',
            "nominal_flow: '700 l/min': a nominal flow, 6 to 5 bar(g), is written",
        ),
        (
            'conductance = "2e-8 m^3/(s*Pa)"',
            'nominal_flow = "-7 l/min(ANR)"',
            "drive.toml:10: [valve] nominal_flow: a flow is positive",
        ),
        (
            'conductance = "2e-8 m^3/(s*Pa)"',
            'nominal_flow = "700 mm(ANR)"',
            "nominal_flow: unit 'mm' does not measure 'm^3/s'",
        ),
        ("[load]", "[valve.smoothing]\nzero = 0\n[load]", "smoothing zero must be positive, got 0"),
        ("[load]", "[valve.smoothing]\nzero_flow = 1\n[load]", "unknown key 'zero_flow'; did you mean 'zero'"),
        ("critical_ratio = 0.3", 'law = "iso"', "unknown law 'iso'; did you mean 'iso6358'"),
        ("critical_ratio = 0.3", 'spool = "second order"', "unknown spool 'second order'; did you mean 'second_order'"),
        ("[load]", '[chamber]\nmodel = "adiabatic"\n[load]', "unknown model 'adiabatic'"),
        ("[load]", '[chamber]\nmodel = "thermal"\nmixed = true\n[load]', "a thermal chamber has no exponents"),
        ("[cylinder]", '[cylinder]\nstops = "no"', "[cylinder] stops must be true or false"),
    ],
    "tuning": [
        ("[pid]", "[pd]", ": unknown section 'pd'; did you mean 'pid'?"),
        ("[minimise]", "[wishes]", ": unknown section 'wishes'"),
        ('"parallel"', '"paralel"', "[pid]: unknown form 'paralel'; did you mean 'parallel'?"),
        ("Tf = ", "Tff = ", "[pid]: unknown key 'Tff'; did you mean 'Tf'?"),
        ("Tf = ", "Td = ", "[pid] Td does not belong to the parallel form, which has Kp, Ki, Kd, Tf, b, c, Tt"),
        ('"1 ms"', '"1"', "[pid] sample_time: '1' has no unit"),
        ('"1 ms"', '"0 ms"', "[pid]: PID: sample_time must be positive"),
        ('"1 ms"', '"10 ms"', "dither.frequency 160 Hz cannot be sampled every 10 ms"),
        ('"2 V*s/m", lower', '"2 V", lower', "[pid] Kp: unit 'V' does not measure 'V*s/m'"),
        ('"2 V*s/m", lower', '"99 V*s/m", lower', "[pid] Kp: value 99 V*s/m lies outside its bounds [0.2, 60]"),
        (', upper = "60 V*s/m"', "", "[pid] Kp is free, so it needs both bounds: lower and upper"),
        ("upper = ", "uper = ", "[pid] Kp: unknown key 'uper'; did you mean 'upper'?"),
        ('["-5 V", "5 V"]', '"5 V"', "[pid] limits must be a list, got '5 V'"),
        ('["-5 V", "5 V"]', '["5 V", "-5 V"]', "[pid] limits: 5 V is not below -5 V"),
        ('limits = ["-5 V", "5 V"]', 'Tt = "1 s"', "[pid] Tt unwinds the integral at limits; write limits, too"),
        ('"sine"', '"square"', "[dither]: unknown waveform 'square'"),
        ('frequency = "160 Hz"', "", "[dither] has no frequency"),
        ('"160 Hz"', '"1000 rad/s"', "[dither] frequency: unit 'rad/s' does not measure 'Hz'; write it in Hz"),
        ("offset = ", "ofset = ", "[dither]: unknown key 'ofset'; did you mean 'offset'?"),
        ('waveform = "sine"', "analogue = 1", "[dither] analogue must be true or false"),
        (
            'horizon = "1 s"\n\n[[ref',
            'horizon = "1 s"\nstart = "250 mm"\n[[ref',
            "[[reference]] 1 start must be a table",
        ),
        (
            'horizon = "1 s"\n\n[[ref',
            'horizon = "1 s"\nstart = { positon = "250 mm" }\n[[ref',
            "[[reference]] 1 start: unknown output 'positon'",
        ),
        ("horizon", "horizn", "[[reference]] 1: unknown key 'horizn'; did you mean 'horizon'?"),
        ('horizon = "1 s"\n\n[[ref', "\n[[ref", "[[reference]] 1 has no horizon"),
        ('"0.2 m/s"\nhorizon', '"0 m/s"\nhorizon', "[[reference]] 1: Step: size must not be zero"),
        ('step = "-100 mm/s"\ninitial = "0.2 m/s"', 'step = "0.2 m/s"', "two references step between the same values"),
        ("[[reference]]   #", "[reference2]   #", ": unknown section 'reference2'; did you mean 'reference'?"),
        ("overshoot = {", "overshot = {", "[minimise]: unknown requirement 'overshot'; did you mean 'overshoot'?"),
        (
            "{ weight = 2 }",
            "2",
            "[minimise] overshoot: write overshoot = { weight = 1.0 }; a limit belongs under [limits]",
        ),
        ("{ weight = 2 }", "{ weight = 0 }", "[minimise] overshoot weight must be positive, got 0"),
        ("{ weight = 2 }", "{ band = 0.1 }", "[minimise] overshoot: unknown key 'band'"),
        ('band = "2 %"', 'band = "3 %"', "[minimise] and [limits]: settling bands differ: [0.02, 0.03]"),
        ('"5 %"', '"5 mm"', "[limits] overshoot: unit 'mm' does not measure '1'"),
        ('"5 %"', '"500 %"', "[limits] overshoot: Overshoot: max must be above 0 and below 1, a fraction"),
        ("= 1.6", "= 0.9", "[limits] max_sensitivity: MaxSensitivity: max must be above 1"),
        ('max = "500 ms", ', "", "[limits] settling_time has no max"),
        ('band = "2 %"', 'band = "2 mm"', "unit 'mm' does not measure 'm/s'"),
        ('band = "2 %"', 'band = "-2 mm/s"', "Tolerance: half_width must be positive"),
        ('"4500 mV"', "4.5", '[limits] peak_control: 4.5 has no unit; write "4.5 V"'),
        ("[limits]\n", "[[limits]]\n", ": limits must be a section, [limits]"),
        (
            "# my loop, 2024\n",
            "[sensor]\n",
            '[sensor] has no lag; write lag = "5 ms", or of an encoder resolution = "10 um"',
        ),
        ("# my loop, 2024\n", '[sensor]\nlag = "0 ms"\n', "[sensor]: SensorLag: lag must be at least"),
        ("# my loop, 2024\n", '[sensor]\nlag = "5 mm"\n', "[sensor] lag"),
        ("# my loop, 2024\n", '[sensor]\ndelay = "5 ms"\n', "[sensor]", "delay"),
        ("# my loop, 2024\n", '[sensor]\nlag = { value = "5 ms", free = true }\n', "[sensor] lag"),
        ('waveform = "sine"', 'waveform = "square"', "unknown waveform 'square'", "sine, triangle"),
        ("max_sensitivity = 1.6", 'air_use = "2 l"', "air_use", "'2 l': air is counted at 20 degC", '"2 l(ANR)"'),
        ("max_sensitivity = 1.6", "air_use = 2.0", "air_use", "air is counted at 20 degC"),
    ],
    "empty tuning": [
        ("", "# nothing\n", "no pid; add a section [pid]"),
        ("", '[pid]\nKi = "1 V/m"\n[[reference]]\n', "[pid] has no gain; write at least Kp"),
        ("", '[pid]\nKp = "2 V*s/m"\n', "no reference; add a section [[reference]]"),
        (
            "",
            '[pid]\nKp = "2 V*s/m"\n[reference]\nstep = "1 m/s"\n',
            "write each reference as a section of its own, [[ref",
        ),
    ],
    "requirements": [
        ("gain_margin = 2.5", "gain_margin = { max = 2.5 }", "[limits] gain_margin: unknown key 'max'"),
        ("gain_margin = 2.5", "gain_margin = {}", "[limits] gain_margin has no min"),
        ("gain_margin = 2.5", "gain_margin = 0.5", "[limits] gain_margin: GainMargin: min must be above 1"),
        ('"45 deg"', "45", '[limits] phase_margin min: 45 has no unit; write "45 deg"'),
        ('"2 V/ms"', '"2 V"', "[limits] control_rate: unit 'V' does not measure 'V/s'"),
        ('[["0 s", "-10 %", "110 %"],', '[["0 s", "-10 %"],', "bounds: write instants with a lower and an upper"),
        ("step_envelope = {", "step_envelope = { band = 0.1,", "[limits] step_envelope: unknown key 'band'"),
        ('"300 ms", 0.9', '"300 ms", 1.9', "[limits] step_envelope: StepEnvelope: at 0.3 s the bounds"),
        ("rise_time", "risetime", "[limits]: unknown requirement 'risetime'; did you mean 'rise_time'?"),
    ],
    "accept": [
        ("[pid]", 'accept = ["hunt"]\n[pid]', "tuning.toml: accept", "unknown defect 'hunt'; did you mean 'hunts'"),
        ("[pid]", 'accept = "hunts"\n[pid]', "tuning.toml: accept must be a list"),
        ("[pid]", "accept = [1]\n[pid]", "tuning.toml: accept must be text"),
        ("[pid]", 'acept = ["hunts"]\n[pid]', "unknown section 'acept'", "accept"),
    ],
    "no hunting": [
        ('"60 s"', '"20 mm"', "[limits] no_hunting: unit 'mm' does not measure 's'"),
        ('"60 s"', '{ repeatability = "1 V" }', "[limits] no_hunting repeatability: unit 'V' does not measure 'm'"),
        (
            '"60 s"',
            '{ repeatability = "0 mm" }',
            "[limits] no_hunting: NoHunting: repeatability must be positive, got 0",
        ),
        ('"60 s"', '{ time = "20 s" }', "[limits] no_hunting: unknown key 'time'"),
    ],
    "scenarios": [
        ("", '[scenarios.corner]\n"load.mass" = "30 %"', "tuning.toml: [scenarios]", "corner"),
        ("", '[scenarios]\ncorners = "30 %"', "[scenarios.corners] must be a section"),
        ("", '[scenarios.corners]\n"load.mas" = "30 %"', "[scenarios.corners] ", "load.mas"),
        ("", '[scenarios.corners]\n"load.mass" = ["3 kg"]', "[scenarios.corners] load.mass: write a fraction"),
        ("", '[scenarios.corners]\n"load.mass" = "3 kg"', "[scenarios.corners] load.mass"),
        ("", '[scenarios.tolerances]\n"pid.Kp" = ["1 V*s/m", "3 V*s/m"]', "a tolerance is a fraction"),
        ("", '[scenarios.samples]\ncount = "many"\n"load.mass" = "30 %"', "count must be a whole number"),
        ("", "[scenarios.samples]\ncount = 100000000\n'load.mass' = '30 %'", "count must be from 1 to 20000"),
        ("", "[scenarios.samples]\ncount = 3\nseed = -1\n'load.mass' = '30 %'", "seed must be at least 0"),
        (
            "",
            "[scenarios.corners]\n" + "".join(f"'friction.{k}' = '30 %'\n" for k in range(20)),
            "20 parameters have too many corners; take",
        ),
    ],
    "move": [
        ('dwell = "2 s"', 'horizon = "2 s"', "horizon does not belong to a move, which ends by dwell"),
        ('move = "-200 mm"', 'step = "-200 mm"', "speed does not belong to a step, which ends by horizon"),
        ('move = "-200 mm"', 'step = "1 mm"\nmove = "1 mm"', "has more than one of step, move, moves and path"),
        ('move = "-200 mm"', 'moves = "-200 mm"', "moves must be a list"),
        ('move = "-200 mm"', 'moves = ["-200 mm", "0 mm"]', "Move: distance must not be zero"),
        ('move = "-200 mm"', 'moves = ["1 mm", { speed = "1 m/s" }]', "moves 2 has no distance"),
        ('move = "-200 mm"', 'moves = ["1 mm", { distance = "1 mm", at = "1 s" }]', "unknown key 'at'"),
        ('speed = "0.5 m/s"', "", "[[reference]] 1 has no speed"),
        ('jerk = "100 m/s^3"', 'profile = "ramp"', "unknown profile 'ramp'"),
        ('jerk = "100 m/s^3"', 'jerk = "9 m/s^3"\nprofile = "trapezoid"', "the acceleration of a trapezoid steps"),
        ('"0.5 m/s"', '"0.5 m"', "speed: unit 'm' does not measure 'm/s'"),
        ('"0.5 m/s"', '"-0.5 m/s"', "Move: speed is a limit on its size and must be positive"),
    ],
    "path": [
        ("cams/cam.csv", "cam.csv", "path: ", "/cam.csv: cannot be read (No such file or directory)"),
        ('"cams/cam.csv"', "3", "[[reference]] 1 path must be text, got 3"),
        ('dwell = "0.4 s"', 'horizon = "1 s"', "horizon does not belong to a path, which ends by dwell"),
        ('dwell = "0.4 s"', 'speed = "1 m/s"', "speed does not belong to a path, which ends by dwell"),
        ('dwell = "0.4 s"', 'step = "1 mm"', "has more than one of step, move, moves and path"),
        ('dwell = "0.4 s"', 'dwell = "-2 s"', "MotionPath: dwell -2 s ends the experiment before it begins"),
    ],
    "path of a speed": [
        ('"position"', '"speed"', "no column of a path; name one speed [m/s]"),
    ],
    "standard form": [
        (
            "Ti =",
            "Ki =",
            "[pid] Ki does not belong to the standard form, which has Kp, Ti, Td, N, b, c, Tt; say Ti = Kp/Ki",
        ),
        (
            "N = 10",
            'Tf = "20 ms"',
            "[pid] Tf does not belong to the standard form, which has Kp, Ti, Td, N, b, c, Tt; say N",
        ),
        (
            '"standard"',
            '"series"',
            "[pid] Kp does not belong to the series form, which has K, Ti, Td, Tf, b, c, Tt; say K",
        ),
        (
            '"standard"',
            '"parallel"',
            "[pid] Ti does not belong to the parallel form, which has Kp, Ki, Kd, Tf, b, c, Tt; say",
        ),
        ("N = 10", "N = 0", "pid.N = 0 would switch the derivative off; the ISA ratio N is 5 to 20, inf unfiltered"),
        ('Td = "250 ms"', 'Td = "-1 ms"', "[pid] Td: value -0.001 s lies outside its bounds [0, inf]"),
        ('sample_time = "2 ms"\n', "", "[pid]: PID: a delay of 1 sample needs a sample_time"),
        ('"1 sample"', '"2 ms"', "[pid] delay: '2 ms' is no number of samples; write delay = \"1 sample\""),
        ('"1 sample"', "3", "[pid]: PID: delay is 0 or 1, whole samples, got 3"),
        ('"2 mm/s"', '"-2 mm/s"', "[pid] dead_band: value -0.002 m/s lies outside its bounds [0, inf]"),
        ('"30 ms"', '"0 ms"', "[feedforward]: Feedforward: time must be at least 1e-06 s, got 0 s"),
        ("gain =", "gian =", "[feedforward] has no gain"),
        ('time = "30', 'tine = "30', "[feedforward]: unknown key 'tine'; did you mean 'time'?"),
    ],
    "faults": [
        ('"6 V"', '{ value = "6 V", lower = "5 V", upper = "7 V", free = true }', "fault_output says what the machine"),
        ("= 8", "= { value = 8, lower = 1, upper = 9, free = true }", "fault_samples says what the machine"),
        ("= 8", "= 0", "fault_samples"),
        ("= 8", "= 2.5", "fault_samples is a whole number"),
        ('sample_time = "2 ms"\n', "", "unknown key 'fault_"),
    ],
    "encoder": [
        ('filter = "5 ms"', 'lag = "5 ms"', "[sensor] has a lag or an encoder, not both"),
        ('"10 um"', '"-10 um"', "[sensor]: Encoder: resolution must not be negative"),
        ('"10 um"', '"10 ms"', "[sensor] resolution: unit 'ms' does not measure 'm'"),
        ('sample_time = "1 ms"\n', "", "an Encoder is read once a sample"),
    ],
    "rig": [
        ("", "[valve]\n", "unknown section 'valve'"),
        ("", '[actuator]\nhysterese = "1 N"\n', "[actuator]: unknown key 'hysterese'; did you mean 'hysteresis'"),
        ("", '[sensors.speeed]\nnoise = "1 mm/s"\n', "[sensors]: unknown output 'speeed'; did you mean 'speed'"),
        ("", '[sensors.speed]\nnoise = "1 mm"\n', "[sensors.speed] noise"),
        ("", '[sensors.speed]\nnoise = "-1 mm/s"\n', "noise must not be negative"),
        ("", "actuator = 3\n", "actuator must be a section, [actuator]"),
        (
            "",
            '[sensors.position]\nnoise = "1 um"\n[encoder]\nresolution = "-1 um"\n',
            "resolution must not be negative",
        ),
    ],
    "study": [
        ("[axes]", "[axis]", "study.toml: unknown section 'axis'; did you mean 'axes'"),
        ("tuning =", "tunning =", "[study]: unknown key 'tunning'; did you mean 'tuning'"),
        ('drive = "fit.toml"', "", "[study] has no drive; write drive = "),
        ('"fit.toml"', "3", "[study] drive must be text, got 3"),
        ("[axes]", "[metrics]", "[metrics]: unknown key"),
        ("load.mass", "load.mas", "[axes]: unknown parameter 'load.mas'; did you mean 'load.mass'"),
        ('"5 bar(g)"', '"5 bar"', "[axes] supply.pressure: a pressure level in 'bar' may be absolute or gauge"),
        ('"2 kg"', '"2 m"', "[axes] load.mass from: unit 'm' does not measure 'kg'"),
        ("{ from", '"3 kg"#', "[axes] load.mass: write a list or a range"),
        ("{ from", "[]#", "[axes] load.mass: write a list or a range"),
        (", steps = 4", "", "[axes] load.mass has no steps; write"),
        ("steps =", "step =", "[axes] load.mass: unknown key 'step'; did you mean 'steps'"),
        ("steps = 4", "steps = 1000000000", "steps must be from 2 to 20000, got 1000000000"),
        ("steps = 4", "steps = 20000", "make ", " cells, 20000 are allowed; take fewer values"),
        ("steps = 4", "steps = 1", "load.mass steps must be from 2 to 20000, got 1"),
        ("[axes]", "[metrics]\nband = 2\n[axes]", "[metrics] band must be above 0 and below 1, got 2"),
        ("[axes]", "[metrics]\nshow = 2\n[axes]", "[metrics] show must be a list, got 2"),
        (
            STUDY,
            "[study]\ndrive = 'a'\ntuning = 'b'\n",
            'no axis; add [axes] with "load.mass" = ',
        ),
        ("[axes]", 'batch = "yes"\n[axes]', "batch must be true or false, got 'yes'"),
        ("[axes]", "batch = true\ntune = true\n[axes]", "a batch is of one design"),
        ("[axes]", 'tune = "yes"\n[axes]', "tune must be true or false, got 'yes'"),
        ("[axes]", 'tune = true\n[metrics]\nband = "5 %"\n[axes]', "state it in tuned.toml"),
    ],
    "front": [
        ("points", "pints", "[pareto]: unknown key 'pints'; did you mean 'points'"),
        ("peak_control", "peek_control", "[pareto] between: unknown requirement 'peek_control'; did you"),
        ("settling_time", "peak_control", "[pareto] between names peak_control twice; a front needs two"),
        ('"settling_time", ', "", "[pareto] between must be a list of 2, got"),
        ("between =", "#", "[pareto] has no between"),
        ("= 5\n", "= 1\n", "[pareto] points must be from 2 to 20000, got 1"),
        ("= 5\n", "= true\n", "[pareto] points must be a whole number, got True"),
        ("2 V", "2 s", "[pareto] lower: unit 's' does not measure 'V'"),
        ('"2 V"', "2", "[pareto] lower: 2 has no unit"),
        ("2 V", "-2 V", "[pareto] lower: peak_control must be positive, got '-2 V'"),
        ("2 V", "6 V", "[pareto] lower, 6 V, is not below upper, 5000 mV"),
        ("[pareto]", "[axes]\nload.mass = [1.0]\n[pareto]", "[axes] belongs to a grid, [pareto] to a front"),
        ("[pareto]", '[metrics]\nband = "1 %"\n[pareto]', "[metrics] belongs to a grid"),
        ("[pareto]", "batch = true\n[pareto]", "batch is of cases; a front is tuned"),
        ("[pareto]", "tune = true\n[pareto]", "tune belongs to a grid; a front is tuned anyway"),
    ],
    "cases": [
        ("", "[samples]\ncount = 5", "study.toml: [samples] nothing varies: state how"),
        ("", '[samples]\ncount = -1\n"load.mass" = 0.1', "[samples] count must be from 1 to 20000, got -1"),
        ("", '[samples]\ncount = 1e9\n"load.mass" = 0.1', "[samples] count must be a whole number"),
        ("", '[samples]\ncount = 100000000\n"load.mass" = 0.1', "[samples] count must be from 1 to 20000"),
        ("", '[samples]\nseed = -1\n"load.mass" = 0.1', "[samples] seed must be at least 0"),
        ("", '[samples]\nsampling = "sobel"\n"load.mass" = 0.1', "unknown sampling 'sobel'; did you mean 'sobol'"),
        ("", '[samples]\nsampling = ["sobol"]\n"load.mass" = 0.1', "[samples] sampling must be text"),
        ("", '[samples]\nfit = 1\n"load.mass" = 0.1', "fit must be true or false"),
        ("", '[samples]\n"load.mas" = 0.1', "[samples] unknown parameter 'load.mas'"),
        ("", '[samples]\n"load.mass" = "3 kg"', "[samples] load.mass"),
        ("", '[samples]\n"load.mass" = ["3 kg"]', "write a fraction"),
        ("", '[samples]\n"load.mass" = {}', "load.mass has no spread"),
        ("", '[samples]\n"load.mass" = { normal = "5 %" }', "unknown key 'normal'"),
        ("", '[samples]\n"load.mass" = { distribution = "norml", spread = 0.1 }', "did you mean 'normal'"),
        (
            "",
            '[samples]\n"load.mass" = { distribution = 3, spread = 0.1 }',
            "load.mass distribution must be text, got 3",
        ),
        ("", '[samples]\n"load.mass" = { distribution = "normal", spread = -0.1 }', "Normal: a spread is a positive"),
        ("", '[samples]\n"load.mass" = { distribution = "normal", spread = ["500 kg", "1 kg"] }', "leaves its bounds"),
        ("", '[samples]\n"supply.pressure" = { distribution = "normal", spread = ["6 bar", "1 bar"] }', "bar"),
        ("", '[corners]\n"load.mass" = { spread = 0.1 }', "[corners] load.mass"),
        ("", "[corners]", "study.toml: [corners] no spread"),
        ("", "[table]", "[table] has no file"),
        ("", "[table]\nfile = 3", "[table] file must be text, got 3"),
        ("", '[table]\nfile = "none.csv"', "none.csv: cannot be read"),
        ("", '[table]\nfil = "plants.csv"', "did you mean 'file'"),
        (
            "",
            '[corners]\nload.mass = 0.1\n[table]\nfile = "plants.csv"',
            "[corners], [table]: a study has cases of one",
        ),
        ("", '[corners]\nload.mass = 0.1\n[axes]\nload.mass = ["1 kg"]', "[axes], [corners]: a study has cases of one"),
        (
            "",
            "tune = true\n" + SAMPLED,
            "tune needs a grid, whose cells have neighbours",
        ),
    ],
}


@pytest.mark.parametrize(
    ("base", "row"),
    [(base, row) for base, rows in ROWS.items() for row in rows],
    ids=lambda x: x if isinstance(x, str) else "",
)
def test_a_message_names_its_place(tmp_path: Path, base: str, row: tuple[str, ...]) -> None:
    name, text, read, lead = BASES[base]
    (old, new, *words), path = row, tmp_path / name
    assert old in text
    path.write_text(text.replace(old, new, 1) if old else text + new, encoding="utf-8")
    with pytest.raises(InputError) as error:
        read(path)
    said = str(error.value)
    assert re.match(lead.format(path=re.escape(str(path))), said)
    assert "\n" not in said
    assert [w for w in words if w not in said] == []


def test_a_continuous_loop_has_no_rig(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").touch()
    with pytest.raises(InputError, match=r"rig.toml: a rig's controller is sampled"):
        read_rig(tmp_path / "rig.toml", DRIVE, ClosedLoop(DRIVE.system(), PID()))
