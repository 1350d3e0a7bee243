import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pneuopt.dynamics.hooks import Log
from pneuopt.identification.checks import NEEDED, check_logs, log_remarks
from pneuopt.identification.examination import check_content
from pneuopt.identification.identify import identify, predict, validate
from pneuopt.identification.losses import Huber
from pneuopt.identification.select_model import select_model
from pneuopt.logs.experiments import Experiment
from pneuopt.logs.read_log import read_log
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Coulomb
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import InputError, LogError, ModelError, PhysicsWarning, UnknownNameError
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.least_squares import LeastSquares
from pneuopt.tuning.racing import Racing

PLANT = ForceDrive(Coulomb()).system()
NOISE = 2e-5  # [m]
RIG = ForceDrive(Coulomb())


def log_with(**columns: Array | None) -> Experiment:
    """100 ms of a drive that coasts, with other columns, or without those that are None."""
    t = np.linspace(0, 0.1, 100, endpoint=False)
    position = 0.01 * t + NOISE * np.random.default_rng(0).standard_normal(100)
    given = {"force": np.zeros(100), "position": position, **columns}
    return Experiment(Trajectory(t, {n: c for n, c in given.items() if c is not None}), name="run 0")


BAD_LOGS = {
    "no input": (
        log_with(force=None),
        LogError,
        r"run 0: the model needs the channel 'force' \[N\] as input; the log has position",
    ),
    "input without a run": (
        log_with(force=np.where(np.arange(100) % 20 < 5, 0.0, math.nan)),
        LogError,
        "run 0: no part holds force and 10 samples of an output; log them together",
    ),
    "foreign channel": (
        log_with(pressure_a=np.ones(100)),
        LogError,
        "cannot use channel 'pressure_a', it reads force, position, speed",
    ),
    "no output": (log_with(position=None), LogError, "run 0: none of the outputs is logged: position, speed"),
    "empty output": (
        log_with(position=np.full(100, math.nan)),
        LogError,
        "run 0: channel 'position' holds no sample; leave it out",
    ),
    "constant output": (
        log_with(position=np.full(100, 3.0)),
        LogError,
        "run 0: channel 'position' is constant; leave it out",
    ),
    "too short": (
        replace(log_with(), trajectory=log_with().trajectory.rows(0, 9)),
        LogError,
        "9 samples are too short a log; at least 10",
    ),
    "unknown condition": (
        log_with().with_conditions({"load.mas": 1.0}),
        UnknownNameError,
        r"run 0: condition: unknown parameter 'load\.mas'; did you mean 'load\.mass'",
    ),
    "condition out of bounds": (
        log_with().with_conditions({"load.mass": -1.0}),
        InputError,
        r"run 0: condition load\.mass: value -1 kg lies outside",
    ),
    "condition on what is free": (
        log_with().with_conditions({"friction.coulomb": 9.0}),
        ModelError,
        r"friction\.coulomb is free, but every log's conditions give its value",
    ),
}


@pytest.mark.parametrize("name", BAD_LOGS)
def test_a_bad_log_is_refused_with_the_remedy(name: str) -> None:
    log, error, message = BAD_LOGS[name]
    with pytest.raises(error, match=message):
        identify(RIG.system(), [log], RIG.parameters.freed("friction.coulomb"))


def test_bad_parameters_are_refused() -> None:
    system, log = RIG.system(), log_with()
    with pytest.raises(LogError, match="no experiments: give at least one log"):
        identify(system, [], system.parameters.freed("load.mass"))
    with pytest.raises(ModelError, match="no parameter is free; mark what to estimate"):
        identify(system, [log], system.parameters)
    stranger = ParameterSet({"load.mess": Parameter(1.0, "kg", free=True)})
    with pytest.raises(UnknownNameError, match=r"unknown parameter 'load\.mess'; did you mean 'load\.mass'"):
        identify(system, [log], stranger)


def test_a_loops_set_point_may_stay_in_the_log_and_names_become_distinct() -> None:
    log = log_with(speed_reference=np.zeros(100))
    anonymous = replace(log, name="")
    free = RIG.parameters.freed("friction.coulomb")
    result = identify(RIG.system(), [log, log, anonymous], free, throw=False)
    assert list(result.trajectories) == ["run 0", "run 0 (2)", "log 3"]


def test_a_sensors_noise_is_shared_between_logs() -> None:
    still = log_with(position=np.full(100, 0.5))
    result = identify(
        RIG.system(),
        [log_with(), replace(still, name="b")],
        RIG.parameters.freed("load.force"),
        throw=False,
    )
    noise = result.fit["noise"]
    assert noise.iloc[0] == noise.iloc[1] == pytest.approx(NOISE, rel=0.3)


def test_a_log_that_contradicts_itself_is_refused() -> None:
    t = np.linspace(0, 2, 2000, endpoint=False)
    swing = {"position": 0.1 * np.sin(6 * t), "force": -(30 * np.sign(np.cos(6 * t)) + 20 * np.cos(6 * t))}
    log = Experiment(Trajectory(t, swing), name="run")
    with pytest.raises(LogError, match=r"run: the force brakes the motion on balance .* change the sign of 'force'"):
        identify(RIG.system(), [log], RIG.parameters.freed("friction.coulomb"))


def test_a_still_window_among_moving_ones_is_no_fault() -> None:
    still = log_with(position=np.full(100, 0.5))
    check_content(RIG.system(), [log_with(), replace(still, name="b")], RIG.parameters)
    with pytest.raises(LogError, match="b: 'position' is constant"):
        check_content(RIG.system(), [replace(still, name="b")], RIG.parameters)


def test_what_a_model_doubts_is_warned_of_and_stands_in_the_status() -> None:
    """The doubter sees the parameters as they are in each log."""

    def doubting(logs: Mapping[str, Log]) -> Sequence[str]:
        return [f"{name}: {log.parameters.value('load.mass'):g} kg?" for name, log in logs.items()]

    system = replace(RIG.system(), log_warning_hook=doubting)
    t = np.arange(400) * 1e-3
    motion = {"force": 100 * np.cos(20 * t), "position": 0.02 * np.sin(20 * t) + 1e-6 * np.sin(1e5 * t)}
    log = Experiment(Trajectory(t, motion), name="run").with_conditions({"load.mass": 7.0})
    with pytest.warns(PhysicsWarning, match=r"run: 7 kg\?"):
        fit = identify(system, [log], RIG.parameters.freed("friction.viscous"), throw=False)
    assert fit.status.message.endswith("; run: 7 kg?")


def braked(accept: tuple[str, ...] = ()) -> Experiment:
    """A log whose force brakes; smooth, so that a fit of it is quick."""
    t = np.linspace(0, 2, 2000, endpoint=False)
    swing = {"position": 0.1 * np.sin(6 * t), "force": -(30 * np.sign(np.cos(6 * t)) + 20 * np.cos(6 * t))}
    return Experiment(Trajectory(t, swing), name="run", accept=accept)


def test_a_refusal_names_its_check_and_is_overridden_by_that_name() -> None:
    system = RIG.system()
    with pytest.raises(LogError, match=r"if the log is right, accept = \['work'\] in its sidecar, or --accept work"):
        check_content(system, [braked()], RIG.parameters)
    (told,) = check_content(system, [braked(("work",))], RIG.parameters)
    assert told.startswith("run: accepted as right: the force brakes the motion on balance")
    with pytest.raises(LogError, match="brakes the motion"):
        check_content(system, [braked(("speed",))], RIG.parameters)
    fit = identify(system, braked(), RIG.parameters.freed("friction.coulomb"), accept=["work"], throw=False)
    assert "accepted as right" in fit.status.message


def test_an_unknown_check_is_named() -> None:
    with pytest.raises(UnknownNameError, match=r"run: accept: unknown check 'werk'; did you mean 'work'"):
        check_logs(RIG.system(), [braked(("werk",))], RIG.parameters)


@pytest.mark.parametrize("name", ["length", "inputs", "outputs", "noise"])
def test_what_a_fit_cannot_do_without_is_not_accepted_and_it_is_said_why(name: str) -> None:
    with pytest.raises(LogError, match=f"run: accept: '{name}' cannot be accepted: {NEEDED[name][:20]}"):
        check_logs(RIG.system(), [braked((name,))], RIG.parameters)


def test_a_channel_that_no_model_reads_is_left_out_by_name() -> None:
    extra = log_with(temperature=np.full(100, 300.0))
    with pytest.raises(LogError, match=r"cannot use channel 'temperature'.* or accept = \['channels'\]"):
        check_logs(RIG.system(), extra, RIG.parameters)
    accepting = extra.accepting("channels")
    (checked,) = check_logs(RIG.system(), accepting, RIG.parameters)
    assert checked.trajectory.names == ("force", "position")
    (said,) = log_remarks(RIG.system(), [accepting], [checked])
    assert said == "run 0: accepted: temperature, which the model does not read"


def test_a_constant_channel_is_no_obstacle_where_its_noise_is_stated() -> None:
    still = log_with(position=np.full(100, 3.0)).with_noise({"position": NOISE})
    assert check_logs(RIG.system(), still, RIG.parameters)[0].noise == {"position": NOISE}


def test_a_channel_that_stands_exactly_still_for_long_is_told_to_state_its_noise() -> None:
    """A quarter of the log without any change looks like noise of 0, by which no residual can be divided."""
    t = np.arange(2000) * 1e-3
    moves = np.where(t < 1.0, 0.0, 0.05 * (1 - np.cos(np.sqrt(50.0) * (t - 1.0))))
    log = Experiment(Trajectory(t, {"force": np.sin(3 * t), "position": moves}), name="run")
    with pytest.raises(
        LogError, match=r"run: channel 'position' shows no noise, not even rounding; state its \[noise\]"
    ):
        check_logs(RIG.system(), log, RIG.parameters)


def test_a_sidecar_accepts_checks_by_name(tmp_path: Path) -> None:
    rows = "".join(f"{k},{k * k}\n" for k in range(12))
    (tmp_path / "run.csv").write_text(f"time [s],position [m]\n{rows}", encoding="utf-8")
    (tmp_path / "run.toml").write_text('accept = ["work"]\n', encoding="utf-8")
    assert read_log(tmp_path / "run.csv").accept == ("work",)
    (tmp_path / "run.toml").write_text('accept = "work"\n', encoding="utf-8")
    with pytest.raises(LogError, match=r'accept must list checks, as accept = \["work"\]; got \'work\''):
        read_log(tmp_path / "run.csv")


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("window", math.nan),
        ("window", "1 s"),
        ("loss", Huber),
        ("loss", "huber"),
        ("method", LeastSquares),
        ("method", Racing()),
        ("start", ParameterSet()),
        ("cpu_seconds", math.nan),
        ("cpu_seconds", "60 s"),
        ("accept", 3),
    ],
)
def test_an_option_that_is_none_is_named_with_what_it_takes(option: str, value: object) -> None:
    """They were tracebacks, or had another meaning: a window of NaN cut no log."""
    with pytest.raises(InputError, match=rf"^{option} takes .*; got "):
        identify(PLANT, braked(), PLANT.parameters.freed("load.mass"), **{option: value})  # type: ignore[arg-type]
    if option == "window":
        for use in (validate, predict):
            with pytest.raises(InputError, match=r"^window takes"):
                use(PLANT, braked(), PLANT.parameters, window=value)  # type: ignore[arg-type]


def test_one_name_is_a_name_and_no_letters() -> None:
    free = PLANT.parameters.freed("load.mass")
    with pytest.raises(UnknownNameError, match="unknown check 'motions'"):
        identify(PLANT, braked(), free, accept="motions")
    assert replace(braked(), accept="motion").accept == ("motion",)  # type: ignore[arg-type]
    with pytest.raises(UnknownNameError, match=r"unknown parameter 'friction\.x\*'"):
        select_model({"a": PLANT, "b": PLANT}, braked(), PLANT.parameters, free="friction.x*")
