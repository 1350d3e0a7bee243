from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pneuopt.control.dither import Dither, Waveform
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
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
from pneuopt.files.drive import read_status
from pneuopt.files.toml import read_toml
from pneuopt.files.tuned import write_tuned
from pneuopt.files.tuning import Tuning, read_tuning
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Coulomb, PressureDependent
from pneuopt.models.linear import SecondOrder
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.status import Code, Status
from pneuopt.tuning.result import TuningResult

PLANT = SecondOrder().system()
TUNING = """# my loop, 2024
[pid]
form = "parallel"          # | standard
sample_time = "1 ms"       # leave out: continuous
Kp = { value = "2 V*s/m", lower = "0.2 V*s/m", upper = "60 V*s/m", free = true }   # by hand
Ki = { value = "5 V/m", lower = "0 V/m", upper = "100 V/m", free = true }
Tf = "2 ms"
limits = ["-5 V", "5 V"]

[dither]
waveform = "sine"
frequency = "160 Hz"
amplitude = { value = "0 V", lower = "0 V", upper = "2 V", free = true }
offset = "0 V"

[[reference]]
step = "0.2 m/s"
horizon = "1 s"

[[reference]]   # the way back
step = "-100 mm/s"
initial = "0.2 m/s"
at = "50 ms"
horizon = "1 s"

[minimise]
settling_time = { band = "2 %", weight = 1.0 }
overshoot = { weight = 2 }

[limits]
overshoot = "5 %"
steady_state_error = 0.01
settling_time = { max = "500 ms", band = 0.02 }
max_sensitivity = 1.6
peak_control = "4500 mV"
"""


def tuned(parameters: ParameterSet, status: Status | None = None) -> TuningResult:
    """A result with nothing but what a file shows of it."""
    table, certified = pd.DataFrame(), pd.DataFrame({"0 to 0.2": {"SettlingTime": np.float64(0.25)}})
    status = status or Status(Code.CONVERGED, ("certified",))
    return TuningResult(parameters, certified, certified, table, table, (), status, {}, {"pneuopt": "0.1"})


def written(folder: Path, text: str, name: str = "tuning.toml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_reads_what_design_draws(tmp_path: Path) -> None:
    tuning = read_tuning(written(tmp_path, TUNING), PLANT)
    assert tuning.loop.plant is PLANT
    assert (tuning.loop.pid, tuning.loop.dither) == (PID(sample_time=1e-3), Dither(160.0))
    assert tuning.references == (Step(0.2, horizon=1.0), Step(-0.1, at=0.05, initial=0.2, horizon=1.0))
    assert tuning.specification.weights == {SettlingTime(0.02): 1.0, Overshoot(): 2.0}
    limits = {Overshoot(0.05), SteadyStateError(0.01), SettlingTime(0.02, 0.5), MaxSensitivity(1.6), PeakControl(4.5)}
    assert set(tuning.specification.limits) == limits
    given = tuning.parameters
    assert given.free_names == ("pid.Kp", "pid.Ki", "dither.amplitude")
    assert (given["pid.Kp"].value, given["pid.Kp"].lower, given["pid.Kp"].upper) == (2.0, 0.2, 60.0)
    assert [given.value(f"pid.{n}") for n in ("Kd", "Tf", "b", "c", "lower", "upper")] == [
        0.0,
        2e-3,
        1.0,
        1.0,
        -5.0,
        5.0,
    ]
    assert all(n.startswith(("pid.", "dither.")) for n in given)


def test_a_short_file_describes_a_continuous_loop_without_limits(tmp_path: Path) -> None:
    text = '[pid]\nKp = "2 V*s/m"\n[[reference]]\nstep = "0.1 m/s"\nhorizon = "1 s"\n'
    tuning = read_tuning(written(tmp_path, text), PLANT)
    assert (tuning.loop.pid, tuning.loop.dither) == (PID(limits=False), None)
    assert (tuning.specification.weights, tuning.specification.limits, tuning.parameters.free_names) == ({}, (), ())


def test_the_loop_says_which_signals_where_the_plant_has_several(tmp_path: Path) -> None:
    plant = ForceDrive(PressureDependent(Coulomb())).system()
    text = '[pid]\nKp = "200 N/m"\n[[reference]]\nstep = "10 mm"\nhorizon = "1 s"\n[loop]\n'
    signals = 'actuated = "force"\nmeasured = "position"\n'
    tuning = read_tuning(written(tmp_path, text + signals), plant)
    assert (tuning.loop.command.name, tuning.loop.feedback.name) == ("force", "position")
    assert tuning.references == (Step(0.01),)
    with pytest.raises(
        InputError, match=r"tuning\.toml: the plant has the inputs force, pressure_a, pressure_b; choose"
    ):
        read_tuning(written(tmp_path, text), plant)
    with pytest.raises(InputError, match=r"unknown output 'positon'; did you mean 'position'"):
        read_tuning(written(tmp_path, text + signals.replace("position", "positon")), plant)


def test_a_reference_may_start_elsewhere(tmp_path: Path) -> None:
    path, drive = tmp_path / "tuning.toml", ForceDrive(Coulomb()).system()
    text = (
        '[pid]\nKp = "200 N*s/m"\n[[reference]]\nstep = "-0.1 m/s"\nhorizon = "1 s"\nstart = { position = "250 mm" }\n'
    )
    path.write_text(text + "[minimise]\nsettling_time = {}\n", encoding="utf-8")
    assert read_tuning(path, drive).references == (Step(-0.1, start={"position": 0.25}),)


def test_a_reference_may_be_a_disturbance(tmp_path: Path) -> None:
    path, drive = tmp_path / "tuning.toml", ForceDrive(Coulomb()).system()
    held = '[[reference]]\ninitial = "0.1 m/s"\nhorizon = "1 s"\ndisturbance = { "load.force" = "20 N" }\n'
    still = '[[reference]]\nscale = "50 mm/s"\nat = "0.2 s"\nhorizon = "1 s"\ndisturbance.load.force = "-5 N"\n'
    path.write_text(f'[pid]\nKp = "200 N*s/m"\n{held}{still}[minimise]\nsettling_time = {{}}\n', encoding="utf-8")
    first, second = read_tuning(path, drive).references
    assert first == Step(0.0, initial=0.1, disturbance={"load.force": 20.0})
    assert second == Step(0.0, at=0.2, scale=0.05, disturbance={"load.force": -5.0})


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
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
        ('["-5 V", "5 V"]', '"5 V"', '[pid] limits must be a pair: ["-5 V", "5 V"]'),
        ('["-5 V", "5 V"]', '["5 V", "-5 V"]', "[pid] limits: 5 V is not below -5 V"),
        ('limits = ["-5 V", "5 V"]', 'Tt = "1 s"', "[pid] Tt unwinds the integral at limits; write limits, too"),
        ('"sine"', '"square"', "[dither]: unknown waveform 'square'"),
        ('frequency = "160 Hz"', "", '[dither] has no frequency; write frequency = "160 Hz"'),
        ('"160 Hz"', '"1000 rad/s"', "[dither] frequency: unit 'rad/s' does not measure 'Hz'; write it in Hz"),
        ("offset = ", "ofset = ", "[dither]: unknown key 'ofset'; did you mean 'offset'?"),
        ('waveform = "sine"', "analogue = 1", "[dither] analogue must be true or false"),
        (
            'horizon = "1 s"\n\n[[ref',
            'horizon = "1 s"\nstart = "250 mm"\n[[ref',
            '[[reference]] 1 start: write start = { position = "250 mm" }',
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
        ("{ weight = 2 }", "{ weight = 0 }", "[minimise] overshoot: weight must be positive, got 0"),
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
    ],
)
def test_refuses_a_tuning_and_says_where(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in TUNING
    path = written(tmp_path, TUNING.replace(old, new, 1))
    with pytest.raises(InputError) as error:
        read_tuning(path, PLANT)
    assert str(error.value).startswith(f"{path}: ")
    assert said in str(error.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("# nothing\n", "no controller; add a section [pid]"),
        ('[pid]\nKi = "1 V/m"\n', "[pid] has no gain; write at least Kp"),
        ('[pid]\nKp = "2 V*s/m"\n', "no reference; add [[reference]]"),
        ('[pid]\nKp = "2 V*s/m"\n[reference]\nstep = "1 m/s"\n', "write each reference as a section of its own, [[ref"),
    ],
)
def test_refuses_what_is_missing(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(InputError) as error:
        read_tuning(written(tmp_path, text), PLANT)
    assert said in str(error.value)


def read_all(folder: Path, tuned: Mapping[str, float]) -> tuple[Tuning, ParameterSet]:
    given = read_tuning(written(folder, TUNING), PLANT)
    return given, given.parameters.with_values(tuned)


def test_a_tuned_file_keeps_the_users_text_and_adds_the_results(tmp_path: Path) -> None:
    given, found = read_all(tmp_path, {"pid.Kp": 12.34, "pid.Ki": 56.78, "dither.amplitude": 0.5})
    write_tuned(tmp_path / "tuned.toml", tmp_path / "tuning.toml", tuned(PLANT.parameters | found))
    text = (tmp_path / "tuned.toml").read_text(encoding="utf-8")
    for kept in (
        "# my loop, 2024",
        "# by hand",
        "# the way back",
        'lower = "0.2 V*s/m"',
        '"12.34 V*s/m"',
        '"56.78 V/m"',
    ):
        assert kept in text
    again = read_tuning(tmp_path / "tuned.toml", PLANT)
    assert again.parameters == found
    assert again.references == given.references
    assert vars(again.specification) == vars(given.specification)
    said = read_toml(tmp_path / "tuned.toml").unwrap()
    assert said["certified"] == {"0 to 0.2": {"SettlingTime": 0.25}}
    assert said["provenance"] == {"pneuopt": "0.1"}
    assert read_status(tmp_path / "tuned.toml") == Status(Code.CONVERGED, ("certified",))


@settings(max_examples=30, deadline=None)
@given(st.floats(0.2, 60.0), st.floats(0.0, 100.0), st.floats(0.0, 2.0))
def test_any_gains_read_back(tmp_path_factory: pytest.TempPathFactory, Kp: float, Ki: float, amplitude: float) -> None:
    folder = tmp_path_factory.mktemp("tuned")
    _, found = read_all(folder, {"pid.Kp": Kp, "pid.Ki": Ki, "dither.amplitude": amplitude})
    write_tuned(folder / "tuned.toml", folder / "tuning.toml", tuned(found))
    again = read_tuning(folder / "tuned.toml", PLANT).parameters
    assert again.free_names == found.free_names
    for name, parameter in found.items():
        assert again.value(name) == pytest.approx(parameter.value, rel=1e-8)


def test_a_sensor_lags_what_the_controller_sees(tmp_path: Path) -> None:
    path = tmp_path / "tuning.toml"
    path.write_text(TUNING + '[sensor]\nlag = "5.5 ms"   # of the encoder\n', encoding="utf-8")
    tuning = read_tuning(path, PLANT)
    assert tuning.parameters.value("sensor.lag") == pytest.approx(5.5e-3)
    assert [q.name for q in tuning.loop.states if q.name.startswith("sensor.")] == ["sensor.reading"]
    assert tuning.loop.feedback.name == "speed"


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ("[sensor]\n", r'\[sensor\] has no lag; write lag = "5 ms", or of an encoder resolution = "10 um"'),
        ('[sensor]\nlag = "0 ms"\n', r"\[sensor\]: SensorLag: lag must be at least"),
        ('[sensor]\nlag = "5 mm"\n', r"\[sensor\] lag"),
        ('[sensor]\ndelay = "5 ms"\n', r"\[sensor\].*delay"),
        ('[sensor]\nlag = { value = "5 ms", free = true }\n', r"\[sensor\] lag"),
    ],
)
def test_a_bad_sensor_is_refused(tmp_path: Path, section: str, message: str) -> None:
    path = tmp_path / "tuning.toml"
    path.write_text(TUNING + section, encoding="utf-8")
    with pytest.raises(InputError, match=message):
        read_tuning(path, PLANT)


KINDS = """
[minimise]
iae = { weight = 1.0 }
noise_gain = { weight = 0.01 }
[limits]
rise_time = "200 ms"
ripple = "1 mm/s"
ise = "50 ms"
itae = "0.02 s^2"
control_rate = "2 V/ms"
max_complementary_sensitivity = 1.3
gain_margin = 2.5
phase_margin = { min = "45 deg" }
step_envelope = { bounds = [["0 s", "-10 %", "110 %"], ["300 ms", 0.9, 1.1]] }
"""


def test_every_kind_of_requirement_has_a_key_and_its_units(tmp_path: Path) -> None:
    text = TUNING[: TUNING.index("[minimise]")]
    tuning = read_tuning(written(tmp_path, text + KINDS), PLANT)
    assert tuning.specification.weights == {IAE(): 1.0, NoiseGain(): 0.01}
    assert tuning.specification.limits == (
        RiseTime(0.2),
        Ripple(1e-3),
        ISE(0.05),
        ITAE(0.02),
        ControlRate(2000.0),
        MaxComplementarySensitivity(1.3),
        GainMargin(2.5),
        PhaseMargin(45.0),
        StepEnvelope(((0.0, -0.1, 1.1), (0.3, 0.9, 1.1))),
    )
    term = KINDS.replace("iae = { weight = 1.0 }", 'step_envelope = { bounds = [["0 s", -1, 2]], weight = 3 }')
    term = term[: term.index('step_envelope = { bounds = [["0 s", "-10')] + 'noise_gain = "0.5 V*s/m"\n'
    again = read_tuning(written(tmp_path, text + term), PLANT)
    assert again.specification.weights == {StepEnvelope(((0.0, -1.0, 2.0),), max=None): 3.0, NoiseGain(): 0.01}
    assert again.specification.limits[-1] == NoiseGain(0.5)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
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
)
def test_refuses_a_bad_requirement_and_says_where(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in KINDS
    path = written(tmp_path, TUNING[: TUNING.index("[minimise]")] + KINDS.replace(old, new, 1))
    with pytest.raises(InputError) as error:
        read_tuning(path, PLANT)
    assert said in str(error.value)


def test_a_triangle_and_a_limit_on_the_air(tmp_path: Path) -> None:
    text = TUNING.replace('waveform = "sine"', 'waveform = "triangle"').replace(
        "max_sensitivity = 1.6", 'air_use = "2 l(ANR)"'
    )
    tuning = read_tuning(written(tmp_path, text), PLANT)
    assert tuning.loop.dither == Dither(160.0, waveform=Waveform.TRIANGLE)
    assert AirUse(2.0) in tuning.specification.limits


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('waveform = "sine"', 'waveform = "square"', "unknown waveform 'square'.*sine, triangle"),
        ("max_sensitivity = 1.6", 'air_use = "2 l"', r"air_use.*'2 l': air is counted at 20 degC.*\"2 l\(ANR\)\""),
        ("max_sensitivity = 1.6", "air_use = 2.0", r"air_use.*air is counted at 20 degC"),
    ],
)
def test_air_needs_its_conditions_and_a_waveform_its_name(tmp_path: Path, old: str, new: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        read_tuning(written(tmp_path, TUNING.replace(old, new)), PLANT)
