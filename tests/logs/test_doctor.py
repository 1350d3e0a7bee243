"""Every check of the log doctor finds its fault, and no other log has it."""

import re
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from pneuopt.logs import doctor
from pneuopt.logs.doctor import CHECKS, PISTON, _find_moves, examine
from pneuopt.logs.experiment import Experiment
from pneuopt.logs.noise import noise_level
from pneuopt.logs.read_log import read_log
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.trajectories import Trajectory
from tests.logs.bad_logs import BAD_LOGS, STATED, T, dwelling, swing

DATA = Path(__file__).parents[2] / "data"


def faults(experiment: Experiment) -> list[str]:
    """The checks that find faults."""
    return [f.check for f in examine(experiment) if f.fault]


def test_a_sound_log_has_no_findings() -> None:
    assert examine(swing()) == ()


def test_two_checks_share_one_balance_and_a_stated_noise_is_not_estimated_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    levels, weighed = Mock(wraps=noise_level), Mock(wraps=doctor._weigh)
    monkeypatch.setattr(doctor, "_weigh", weighed)
    monkeypatch.setattr(doctor, "noise_level", levels)
    log = swing().with_noise({"position": 1e-5, "speed": 1e-3})
    axis = PISTON._replace(forces={"force": 1.0}, constant=0.0, inertia=1.0)
    examine(log, axis)
    assert (levels.call_count, weighed.call_count) == (0, 1)
    examine(log, axis._replace(inertia=3.0))
    assert weighed.call_count == 2


def test_every_check_has_a_log_that_trips_it_alone_and_shows_why() -> None:
    assert list(BAD_LOGS) == list(CHECKS)
    for name, log in BAD_LOGS.items():
        (finding,) = examine(log, STATED.get(name, PISTON))
        assert (finding.check, finding.log) == (name, "swing")
        shown = finding.evidence
        assert shown is not None, name
        inside = (shown.t >= shown.view[0]) & (shown.t <= shown.view[1])
        assert shown.contradiction[inside].any(), name
        assert all(curve.shape == shown.t.shape for panel in shown.panels for curve in panel.curves.values()), name


def test_a_log_of_moves_and_dwells_says_what_share_is_motion() -> None:
    """No check takes a dwell for a fault, whatever is logged of it."""
    for channels in (("position",), ("speed",), ("position", "force"), ("position", "pressure_a", "pressure_b")):
        (finding,) = examine(BAD_LOGS["dwells"].select(channels))
        assert (finding.fault, finding.check, finding.channel) == (False, "dwells", channels[0])
        shown = re.search(r"moves in (\d+)% of the log, (.*) of 4 s, in 4 moves, and stands", finding.message)
        assert shown is not None, finding.message
        assert int(shown[1]) == pytest.approx(24, abs=4)
        assert float(shown[2]) == pytest.approx(0.01 * int(shown[1]) * 4, abs=0.03)


def test_a_counted_position_does_not_move_while_its_last_count_flickers() -> None:
    log, count = dwelling().select(["position"]), 1e-4
    x = log.trajectory["position"] + 2e-5 * np.sin(211.0 * T)
    coarse = replace(log, trajectory=log.trajectory.with_columns({"position": count * np.round(x / count)}), noise={})
    (finding,) = (f for f in examine(coarse) if f.check == "dwells")
    assert "in 4 moves" in finding.message


def thinned(log: Experiment, every: int) -> Experiment:
    """Each channel in rows of its own, as loggers write that poll one sensor after the other."""
    columns = {n: log.trajectory[n].copy() for n in log.trajectory}
    for k, column in enumerate(columns.values()):
        column[np.arange(T.size) % every != k % every] = np.nan
    return replace(log, trajectory=log.trajectory.with_columns(columns))


@pytest.mark.parametrize("every", [2, 5])
@pytest.mark.parametrize("name", ["right", *(n for n in BAD_LOGS if n != "sampling")])
def test_channels_in_rows_of_their_own_are_checked_like_others(name: str, every: int) -> None:
    log = thinned(BAD_LOGS.get(name, swing()), every)
    stated = PISTON._replace(inertia=2.65, constant=0.0) if name == "right" else STATED.get(name, PISTON)
    found = examine(log, stated)
    assert [f.check for f in found if f.check != "sampling"] == ([] if name == "right" else [name])


def test_nothing_is_assumed_of_a_channel_across_a_hole() -> None:
    """The position lacks 3.5 s, in which the force pushes up and the piston comes down: work that nobody saw.

    A spline would run through them, and the force would brake on balance.
    """
    hole = (T > 0.25) & (T < 3.75)
    force, position = (swing().trajectory[n].copy() for n in ("force", "position"))
    force[hole] = 300.0
    position[hole] = np.nan
    assert examine(swing(force=force, position=position).select(["position", "force"])) == ()


RECORDER: dict[str, str | bool | dict[str, str | float]] = {
    "time": "t [ms]",
    "valve_voltage": "U_valve [V]",
    "position": "x [mm]",
    "pressure_a": {"column": "pA [bar]", "unit": "bar(g)"},
    "pressure_b": {"column": "pB [bar]", "unit": "bar(g)"},
}
"""The columns of the stranger's logs, which have no sidecar: the README's reader makes one."""


@pytest.mark.parametrize("path", sorted(DATA.glob("*/*.csv")), ids=lambda p: f"{p.parent.name}/{p.stem}")
def test_the_example_logs_have_no_faults(path: Path) -> None:
    assert faults(read_log(path, columns=RECORDER if path.parent.name == "own_rig" else None)) == []


@pytest.mark.parametrize("channel", ["position", "speed"])
def test_a_wrong_sign_is_seen_between_position_and_speed(channel: str) -> None:
    assert "speed" in faults(swing(**{channel: -swing().trajectory[channel]}))


def test_a_wrong_sign_of_the_force_is_seen_in_its_work() -> None:
    log = swing(force=-swing().trajectory["force"])
    (found,) = examine(replace(log, trajectory=log.trajectory.select(["position", "force"]), noise={}))
    assert (found.check, found.channel, found.fault) == ("work", "force", True)


def test_exchanged_pressures_are_seen_in_their_work() -> None:
    log = swing().trajectory
    (found,) = [f for f in examine(swing(pressure_a=log["pressure_b"], pressure_b=log["pressure_a"])) if f.fault]
    assert (found.check, found.channel) == ("work", "pressures")
    assert "exchange pressure_a and pressure_b" in found.message


@pytest.mark.parametrize(("zero", "remedy"), [(-101325.0, "write bar(g)"), (101325.0, "write bar(a)")])
def test_pressures_of_another_zero_are_told_by_the_rod(zero: float, remedy: str) -> None:
    """Both are one atmosphere off, which pushes on the rod's section alone: 10.1 N of a friction of 30 N."""
    weights = {"pressure_a": 8e-4, "pressure_b": -7e-4}
    log = swing().trajectory
    push = {"pressure_a": 5e5 + log["force"] / 16e-4, "pressure_b": 5e5 * 8 / 7 - log["force"] / 14e-4}
    axis = PISTON._replace(forces=weights, constant=0.0, offset_parameter="load.force")
    shifted = {n: p + zero for n, p in push.items()}
    right = replace(swing(**push), trajectory=swing(**push).trajectory.select(["position", *push]), noise={})
    wrong = replace(right, trajectory=swing(**shifted).trajectory.select(["position", *push]))
    assert "offset" not in [f.check for f in examine(right, axis)]
    (told,) = [f.message for f in examine(wrong, axis) if f.check == "offset"]
    assert remedy in told
    assert "load.force" not in told


def commanded(frequency: float, sign: float = 1.0) -> Experiment:
    """A speed that follows a valve as a lag of first order, 50 ms, would."""
    w = 2 * np.pi * frequency
    size, late = 0.3 / np.hypot(1, 0.05 * w), np.arctan(0.05 * w)
    columns = {"valve_voltage": sign * np.cos(w * T), "position": 0.1 + size / w * np.sin(w * T - late)}
    return Experiment(Trajectory(T, columns))


@pytest.mark.parametrize("frequency", [0.5, 1.0, 2.0, 5.0, 12.0])
def test_a_piston_that_follows_its_valve_is_sound(frequency: float) -> None:
    assert faults(commanded(frequency)) == []


@pytest.mark.parametrize("frequency", [0.5, 1.0, 2.0])
def test_a_wrong_sign_of_the_command_is_seen_in_slow_motion(frequency: float) -> None:
    assert faults(commanded(frequency, -1.0)) == ["command"]


@pytest.mark.parametrize("path", sorted(DATA.glob("[ps]*_rig/*.csv")), ids=lambda p: f"{p.parent.name}/{p.stem}")
def test_the_example_logs_with_a_wrong_sign_of_the_command(path: Path) -> None:
    log = read_log(path).trajectory
    turned = log.with_columns({"valve_voltage": -log["valve_voltage"]})
    assert "command" in faults(Experiment(turned))


def test_a_constant_command_moves_a_piston_one_way_only() -> None:
    still = np.full(T.size, 0.4)
    (found,) = [f for f in examine(swing(valve_voltage=still)) if f.fault]
    assert found.check == "command"
    assert found.message.startswith("'valve_voltage' is constant while the piston goes to and fro")
    rng = np.random.default_rng(5)
    moved = {"position": 0.05 * np.minimum(T, 1.0) + 2e-5 * rng.standard_normal(T.size)}
    moved |= {"speed": 0.05 * (T < 1.0) + 2e-3 * rng.standard_normal(T.size)}
    for name, column in moved.items():
        assert faults(Experiment(Trajectory(T, {"valve_voltage": still, name: column}))) == []


def test_a_load_that_is_only_lowered_may_be_braked() -> None:
    down = {"position": 0.5 - 0.1 * T, "force": np.full(T.size, 50.0)}
    assert faults(Experiment(Trajectory(T, down))) == []


def test_a_rest_before_a_motion_one_way_is_no_stop() -> None:
    """The noise of a slow motion goes to and fro, which is no motion back: there is no middle of two pushes."""
    rng = np.random.default_rng(9)
    advance = np.clip(T - 1.0, 0.0, None) % 1.0 < 0.5
    position = 0.1 + np.cumsum(0.02 * advance * (T >= 1.0)) * 1e-3 + 5e-5 * rng.standard_normal(T.size)
    force = np.where(T < 1.0, 2.0, 16.0) + 0.3 * rng.standard_normal(T.size)
    assert faults(Experiment(Trajectory(T, {"position": position, "force": force}))) == []


@pytest.mark.parametrize("slip", [0.1, 0.15])
def test_a_mass_that_sticks_and_slips_is_not_blamed(slip: float) -> None:
    """While a part of a window rests, the force there is what friction holds, and no acceleration goes with it."""
    t, cycle, mass, rng = np.arange(10_000) * 2e-3, 1.0, 3.0, np.random.default_rng(6)
    side, since = np.where((t // cycle) % 2 < 1, 1.0, -1.0), t % cycle
    moves, w, size = since < slip, np.pi / slip, 8e-3
    shift = size * np.where(moves, 0.5 - 0.5 * np.cos(w * since), 1.0)
    position = 0.1 + np.where(side > 0, shift, size - shift) + 4e-5 * rng.standard_normal(t.size)
    rest = side * (20.0 - 100.0 * np.clip((since - slip) / (cycle - slip), 0.0, 1.0))
    force = np.where(moves, side * (40.0 + mass * size / 2 * w**2 * np.cos(w * since)), rest)
    log = Experiment(Trajectory(t, {"position": position, "force": force}))
    assert [f.check for f in examine(log, PISTON._replace(inertia=mass)) if f.fault] == []


def test_units_of_position_and_speed_must_agree() -> None:
    found = examine(swing(speed=1e3 * swing().trajectory["speed"]))
    assert any("times the slope of the position: check both units" in f.message for f in found if f.check == "speed")


def test_gauge_read_as_absolute_is_a_vacuum() -> None:
    (found,) = [f for f in examine(swing(pressure_b=swing().trajectory["pressure_b"] - 4.3e5)) if f.fault]
    assert (found.check, found.channel) == ("pressures", "pressure_b")


def test_absolute_read_as_gauge_exceeds_the_supply() -> None:
    found = examine(swing().with_conditions({"supply.pressure": 4.2e5}))
    assert any("above the supply of 4.20 bar(a)" in f.message for f in found if f.check == "pressures")


@pytest.mark.parametrize("declared", [True, False])
@pytest.mark.parametrize("size", [0.0, 1e-5])
def test_a_log_without_motion_is_refused(size: float, declared: bool) -> None:
    still = 0.1 + size * np.random.default_rng(2).standard_normal(T.size)
    noise = {"position": 1e-5} if declared else {}
    assert faults(Experiment(Trajectory(T, {"position": still, "force": np.sin(T)}), noise)) == ["motion"]


def test_a_constant_speed_is_motion_and_zero_is_none() -> None:
    """A friction rig may well run at one speed."""
    log = {"speed": np.full(T.size, 0.1), "force": 30 + np.random.default_rng(0).standard_normal(T.size)}
    assert faults(Experiment(Trajectory(T, log))) == []
    assert len(faults(Experiment(Trajectory(T, {**log, "speed": np.zeros(T.size)})))) == 1


def test_slow_creep_is_motion() -> None:
    rng = np.random.default_rng(3)
    creep = 5e-5 * T / T[-1] + 1e-5 * rng.standard_normal(T.size)
    assert faults(Experiment(Trajectory(T, {"position": creep, "force": np.sin(T)}), {"position": 1e-5})) == []


def test_what_blurs_is_noted_and_no_fault() -> None:
    rng = np.random.default_rng(4)
    log = swing().trajectory
    jittering = Trajectory(T + 2e-4 * rng.uniform(-1, 1, T.size), log.values)
    clipped = swing(pressure_a=np.minimum(log["pressure_a"], 5.15e5))
    coarse = swing(position=np.round(log["position"] / 5e-3) * 5e-3)
    for blurred, channel in ((Experiment(jittering), "time"), (clipped, "pressure_a"), (coarse, "position")):
        assert [(f.check, f.channel, f.fault) for f in examine(blurred)] == [("sampling", channel, False)]


def hunting(frequency: float, rate: float, seconds: float, lag: float = 0.0) -> dict[str, Array]:
    """A mass under friction that swings; its speed comes late by `lag`."""
    t = np.arange(round(seconds * rate)) / rate
    w, rng = 2 * np.pi * frequency, np.random.default_rng(7)
    size = 0.2 / w
    force = 20 * np.sign(np.cos(w * t)) + 40 * size * w * np.cos(w * t) - 3 * size * w**2 * np.sin(w * t)
    position = 0.1 + size * np.sin(w * t) + 1e-5 * rng.standard_normal(t.size)
    speed = size * w * np.cos(w * (t - lag)) + 1e-3 * rng.standard_normal(t.size)
    return {"time": t, "position": position, "speed": speed, "force": force}


@pytest.mark.parametrize("frequency", [0.1, 1.7, 3.0, 12.5, 20.0])
@pytest.mark.parametrize(("rate", "seconds"), [(50.0, 60.0), (1000.0, 60.0), (50.0, 1000.0), (5000.0, 4.0)])
def test_a_right_log_is_sound_at_any_frequency_rate_and_length(frequency: float, rate: float, seconds: float) -> None:
    """The speed from positions was taken over a hundredth of the log, be that several cycles."""
    run = hunting(frequency, rate, max(seconds, 2 / frequency), lag=5e-3)
    t = run.pop("time")
    assert faults(Experiment(Trajectory(t, run))) == []
    for channels in (["position", "force"], ["speed", "force"]):
        assert faults(Experiment(Trajectory(t, run).select(channels))) == []


@pytest.mark.parametrize("frequency", [0.3, 1.7, 3.0])
def test_wrong_signs_and_units_are_seen_in_long_logs_too(frequency: float) -> None:
    run = hunting(frequency, 500.0, 60.0)
    t = run.pop("time")
    alone = Experiment(Trajectory(t, {"position": run["position"], "force": -run["force"]}))
    assert [f.check for f in examine(alone) if f.fault] == ["work"]
    for changed in ({"position": -run["position"]}, {"speed": 60 * run["speed"]}, {"position": 1e3 * run["position"]}):
        log = Experiment(Trajectory(t, {"position": run["position"], "speed": run["speed"], **changed}))
        assert [f.check for f in examine(log) if f.fault] == ["speed"]


def test_a_fault_shows_the_signals_that_contradict_each_other() -> None:
    log = swing()
    flat = {"force": np.zeros(T.size), "pressure_a": np.full(T.size, 4e5), "pressure_b": np.full(T.size, 4e5)}
    (fault,) = [f for f in examine(swing(position=-log.trajectory["position"], **flat)) if f.fault]
    found = re.search(r"at (\S+) s position changes by (\S+)/s, speed is ([^)]+)\)", fault.message)
    assert found is not None
    at, slope, speed = map(float, found.groups())
    true = 0.3 * np.cos(2 * np.pi * at)
    assert slope == pytest.approx(-true, rel=0.1)
    assert speed == pytest.approx(true, rel=0.1)


def test_millimetres_read_as_metres_are_named_before_a_fit() -> None:
    """Speed and force agree with the position then, but for a factor; the fit used to end in a stiff model."""
    run = hunting(1.0, 500.0, 10.0)
    t = run.pop("time")
    (found,) = examine(Experiment(Trajectory(t, {"position": 1e3 * run["position"], "force": run["force"]})))
    assert (found.check, found.channel, found.fault) == ("scale", "position", True)
    assert re.match(r"'position' moves at (19\d|20\d|2e\+02) m/s", found.message)
    both = {"position": 1e3 * run["position"], "speed": 1e3 * run["speed"], "force": run["force"]}
    assert [f.check for f in examine(Experiment(Trajectory(t, both))) if f.fault] == ["scale"]
    high = {n: 1e3 * swing().trajectory[n] for n in ("pressure_a", "pressure_b")}
    assert "pressures" in faults(swing(**high))


def test_outliers_and_strokes_within_few_samples_are_no_jumps() -> None:
    """A lost sample is a robust loss's business; a short stroke at 50 Hz takes three samples."""
    rng, log = np.random.default_rng(6), swing().trajectory
    hit = rng.random(T.size) < 0.01
    spiked = log["position"] + np.where(hit, rng.choice([-0.02, 0.02], T.size), 0.0)
    t = np.arange(500) * 0.02
    strokes = 0.1 + 0.05 * np.interp((t % 1.0), [0, 0.44, 0.5, 0.94, 1.0], [-1, -1, 1, 1, -1])
    for time, position in ((T, spiked), (t, strokes + 1e-5 * rng.standard_normal(t.size))):
        assert "jumps" not in [f.check for f in examine(Experiment(Trajectory(time, {"position": position})))]


def test_the_steps_of_a_log_are_taken_once_for_all_its_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    """Once a move, they took 2 of 45 CPU s of the identification from a million samples with 1859 moves."""
    gradient, taken = np.gradient, list[Array]()

    def count(t: Array) -> Array:
        taken.append(t)
        return np.asarray(gradient(t))

    monkeypatch.setattr(np, "gradient", count)
    t = 0.01 * np.arange(4000.0)
    moves = _find_moves(t, np.where(t % 1.0 < 0.195, 0.3, 0.0))
    assert [first for first, _ in moves] == list(range(0, 4000, 100))
    assert {last - first for first, last in moves} == {20}
    assert len(taken) == 1


def test_a_short_creep_beside_long_moves_is_no_move() -> None:
    t = np.cumsum(np.random.default_rng(0).uniform(0.005, 0.015, 3000))  # steps of different lengths
    size = np.zeros(3000)
    size[500:900] = size[1500:1900] = 0.5
    size[2500:2502] = 0.1  # 1 mm of 2 m
    assert _find_moves(t, size) == [(500, 900), (1500, 1900)]
