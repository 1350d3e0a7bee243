"""The words of refusals: what triggers each, its error, what it says. Elsewhere tests hold the error and its place."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.identification.identify import identify
from pneuopt.identification.logged_loop import LoggedLoop
from pneuopt.identification.losses import Huber, SoftL1
from pneuopt.identification.problem import NEEDED, check_logs
from pneuopt.identification.tracking import compare_logs, track
from pneuopt.logs.experiment import Experiment
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb
from pneuopt.quantities.errors import InputError, LogError, ModelError, UnknownNameError
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.quantities.trajectories import Trajectory
from tests.identification import test_identify, test_search
from tests.identification.test_logged_loop import H, given, logged, loop_of, pressure_fed
from tests.identification.test_problem import RIG, braked, log_with
from tests.identification.test_tracking import DATES, fits

SYSTEM = RIG.system()
FREE = RIG.parameters.freed("friction.coulomb")


def fit_drive(log: Experiment) -> None:
    identify(SYSTEM, [log], FREE)


def fit_loop(change: Callable[[Experiment, Trajectory], Experiment], h: float = 1e-3) -> None:
    log, run = logged(loop_of(), "position", h=h)
    identify(loop_of(), [change(log, run)], given(loop_of()).freed("load.mass"))


def without_a_row(log: Experiment, _: Trajectory) -> Experiment:
    rows = np.delete(np.arange(1500), 700)
    columns = {n: c[rows] for n, c in log.trajectory.values.items()}
    return replace(log, trajectory=Trajectory(log.trajectory.t[rows], columns))


def fit_without_pressures() -> None:
    loop, values = pressure_fed()
    t = np.arange(50) * H
    moved = {"position_reference": 0.1 + 0 * t, "position": 0.1 + 0.01 * np.sin(90 * t)}
    log = Experiment(Trajectory(t, moved), {"position": 1e-5})
    identify(loop, [log], loop.parameters.with_values(values).freed("load.mass"))


def fit_loop_in_windows() -> None:
    drive = test_search.DRIVE.system()
    loop, pushed = ClosedLoop(drive, PID(sample_time=test_search.STEP_WINDOWS)), test_search.pushed()
    columns = {
        "speed_reference": np.sign(test_search.FORCE_WINDOWS) * 0.1,
        "position": test_search.y_centred(pushed),
    }
    log = Experiment(Trajectory(test_search.TIME_WINDOWS, columns))
    identify(loop, log, loop.parameters.freed(*test_search.FREE_WINDOWS), window=0.5)


def with_the_command(log: Experiment, run: Trajectory) -> Experiment:
    return replace(log, trajectory=log.trajectory.with_columns({"force": run["control"]}))


Refusal = tuple[Callable[[], object], type[Exception], str]

REFUSALS: dict[str, Refusal] = {
    "no input": (
        lambda: fit_drive(log_with(force=None)),
        LogError,
        r"run 0: the model needs the channel 'force' \[N\] as input; the log has position",
    ),
    "input without a run": (
        lambda: fit_drive(log_with(force=np.where(np.arange(100) % 20 < 5, 0.0, math.nan))),
        LogError,
        "run 0: no part holds force and 10 samples of an output; log them together",
    ),
    "foreign channel": (
        lambda: fit_drive(log_with(pressure_a=np.ones(100))),
        LogError,
        "cannot use channel 'pressure_a', it reads force, position, speed",
    ),
    "no output": (
        lambda: fit_drive(log_with(position=None)),
        LogError,
        "run 0: none of the outputs is logged: position, speed",
    ),
    "empty output": (
        lambda: fit_drive(log_with(position=np.full(100, math.nan))),
        LogError,
        "run 0: channel 'position' holds no sample; leave it out",
    ),
    "constant output": (
        lambda: fit_drive(log_with(position=np.full(100, 3.0))),
        LogError,
        "run 0: channel 'position' is constant; leave it out",
    ),
    "too short": (
        lambda: fit_drive(replace(log_with(), trajectory=log_with().trajectory.rows(0, 9))),
        LogError,
        "9 samples are too short a log; at least 10",
    ),
    "unknown condition": (
        lambda: fit_drive(log_with().with_conditions({"load.mas": 1.0})),
        UnknownNameError,
        r"run 0: condition: unknown parameter 'load\.mas'; did you mean 'load\.mass'",
    ),
    "condition out of bounds": (
        lambda: fit_drive(log_with().with_conditions({"load.mass": -1.0})),
        InputError,
        r"run 0: condition load\.mass: value -1 kg lies outside",
    ),
    "condition on what is free": (
        lambda: fit_drive(log_with().with_conditions({"friction.coulomb": 9.0})),
        ModelError,
        r"friction\.coulomb is free, but every log's conditions give its value",
    ),
    "no logs": (lambda: identify(SYSTEM, [], FREE), LogError, "no experiments: give at least one log"),
    "nothing free": (
        lambda: identify(SYSTEM, [log_with()], SYSTEM.parameters),
        ModelError,
        "no parameter is free; mark what to estimate",
    ),
    "unknown parameter": (
        lambda: identify(SYSTEM, [log_with()], ParameterSet({"load.mess": Parameter(1.0, "kg", free=True)})),
        UnknownNameError,
        r"unknown parameter 'load\.mess'; did you mean 'load\.mass'",
    ),
    "unknown check": (
        lambda: check_logs(SYSTEM, [braked(("werk",))], RIG.parameters),
        UnknownNameError,
        r"run: accept: unknown check 'werk'; did you mean 'work'",
    ),
    "log with the command": (
        lambda: fit_loop(with_the_command),
        LogError,
        "holds the command 'force'; identify the plant alone",
    ),
    "log without the reference": (
        lambda: fit_loop(lambda log, _: log.select(["position"])),
        LogError,
        "needs the channel 'speed_reference'",
    ),
    "log without a row": (
        lambda: fit_loop(without_a_row),
        LogError,
        r"no sample at t = 0\.7 s; log at the controller's sample time",
    ),
    "log too slow": (
        lambda: fit_loop(lambda log, _: log, h=3e-3),
        LogError,
        r"the log has no sample at t = 0\.002 s",
    ),
    "continuous controller": (lambda: LoggedLoop(replace(loop_of(), pid=PID())), ModelError, "sample_time"),
    "log without pressures": (
        fit_without_pressures,
        LogError,
        "the controller reads 'pressure_a', which the log does not hold; log it",
    ),
    "resetting integral": (
        lambda: LoggedLoop(
            ClosedLoop(ForceDrive(Coulomb()).system(), PID(H, limits=False, reset=True), measured="position")
        ),
        ModelError,
        r"PID\(reset=False\)\), or log the command",
    ),
    "loop in windows": (fit_loop_in_windows, InputError, "a sampled controller goes on"),
    "Huber": (lambda: Huber(0.0), InputError, "threshold must be positive"),
    "soft L1": (lambda: SoftL1(0.0), InputError, "threshold must be positive"),
    "no time": (lambda: test_identify.fit_within(0.0), InputError, "cpu_seconds must be positive, got 0"),
    "one log": (lambda: compare_logs(SYSTEM, [log_with()], FREE), LogError, "at least two"),
    "three fits": (lambda: track(fits(3), DATES[:3]), InputError, "3 logs show no drift; give 4 at least"),
    "too few dates": (lambda: track(fits(), DATES[:5]), InputError, "12 fits have 5 dates"),
    "no date": (
        lambda: track(fits(), ["12.3.26", *DATES[1:]]),
        InputError,
        r"'12\.3\.26' is no date; write it as 2026-03-12",
    ),
    "one moment": (lambda: track(fits(), [DATES[0]] * 12), InputError, "are of one moment"),
    "unknown estimate": (
        lambda: track(fits(), DATES, parameters=["friction.colomb"]),
        InputError,
        r"did you mean 'friction\.coulomb'",
    ),
    "no probability": (lambda: track(fits(), DATES, level=1.5), InputError, "give a probability"),
    **{
        f"accept {name}": (
            lambda name=name: check_logs(SYSTEM, [braked((name,))], RIG.parameters),  # type: ignore[misc]
            LogError,
            f"run: accept: '{name}' cannot be accepted: {NEEDED[name][:20]}",
        )
        for name in ("length", "inputs", "outputs", "noise")
    },
}


@pytest.mark.parametrize("name", REFUSALS)
def test_a_refusal_names_the_place_and_the_remedy(name: str) -> None:
    trigger, error, words = REFUSALS[name]
    with pytest.raises(error, match=words):
        trigger()
