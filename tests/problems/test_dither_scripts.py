"""The scripts on dither and stiction windup: what is quick of them at every run, the whole when slow ones run."""

from pathlib import Path

import numpy as np
import pytest

from pneuopt.quantities.trajectories import Trajectory
from problems.dither import averaged_dither, dither_map, margins_under_dither
from problems.friction import force_loop, hunting, stiction_windup


def test_friction_makes_the_papers_gains_overshoot_by_40_percent() -> None:
    smooth, sticking = (
        stiction_windup.stepped(stiction_windup.FAST, stiction_windup.PAPERS, lugre=k) for k in (False, True)
    )
    assert smooth.overshoot == pytest.approx(1.4, abs=0.1)
    assert sticking.overshoot == pytest.approx(40.2, abs=0.3)


def test_the_map_at_amplitude_zero_is_the_same_at_every_frequency(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dither_map, "AMPLITUDES", np.array([0.0, 0.5]))
    monkeypatch.setattr(dither_map, "FREQUENCIES", np.array([40.0, 110.0]))
    loop = dither_map.controlled()
    gains = {"pid.Kp": 3.7, "pid.Ki": 82.0, "pid.Kd": 0.23}
    settled, air = dither_map.mapped(loop, dither_map.filled(loop).with_values(gains))
    assert settled.shape == air.shape == (2, 2)
    np.testing.assert_allclose(settled[0, 0], settled[1, 0], equal_nan=True)
    assert air[0, 0] == pytest.approx(air[1, 0])
    assert air[0, 1] > air[1, 1] > 0  # the valve passes less of the faster


def test_the_sensitivity_under_dither_is_what_injected_sines_measure() -> None:
    """Where the ripple opens the dead zone a linearisation about the mean state has twice the peak."""
    rows = margins_under_dither.main(margins_under_dither.run({"edge": margins_under_dither.CASES["edge"]}))
    assert rows["holds"].all()
    value = rows.set_index("name")["value"]
    assert value["edge.plain"] > 1.5 * value["edge.injected"]


@pytest.mark.slow
def test_margins_under_dither(tmp_path: Path) -> None:
    measured = margins_under_dither.run()
    rows = margins_under_dither.main(measured)
    assert list(rows.loc[~rows["holds"].astype(bool), "name"]) == []
    margins_under_dither.figure(measured).savefig(tmp_path / "margins.png")


@pytest.mark.slow
def test_stiction_windup(tmp_path: Path) -> None:
    job = stiction_windup.run()
    rows = stiction_windup.main(job)
    assert list(rows.loc[~rows["holds"].astype(bool), "name"]) == []
    assert set(stiction_windup.BOUNDS) <= set(rows["name"])
    stiction_windup.figure(job).savefig(tmp_path / "windup.png")


@pytest.mark.slow
def test_dither_map(tmp_path: Path) -> None:
    job = dither_map.run()
    rows = dither_map.main(job)
    assert list(rows.loc[~rows["holds"].astype(bool), "name"]) == []
    assert set(dither_map.BOUNDS) <= set(rows["name"])
    for picture in (dither_map.figure(job), dither_map.responses(job)):
        picture.savefig(tmp_path / "map.png")


@pytest.mark.slow
def test_averaged_dither(tmp_path: Path) -> None:
    runs = averaged_dither.run()
    rows = averaged_dither.main(runs)
    assert list(rows.loc[~rows["holds"].astype(bool), "name"]) == []
    averaged_dither.over_frequency(runs).savefig(tmp_path / "error.png")


def test_hunting(tmp_path: Path) -> None:
    """One of the script's PIDs, the one that it draws: it hunts where static friction falls at once, and only there."""
    gains = list(hunting.random_pids(hunting.SHOWN + 1))[hunting.SHOWN]
    ends = {n: [hunting.watch(gains | hunting.FRICTIONS[n])] for n in ("coulomb", "static")}
    rows = hunting.main(hunting.Job(ends, [gains])).set_index("name")["value"]
    assert (rows["static.hunting"], rows["coulomb.hunting"], rows["coulomb.resting"]) == (1, 0, 1)
    hunting.figure(hunting.Job(ends, [gains])).savefig(tmp_path / "hunting.png")


@pytest.mark.slow
def test_a_reset_ends_hunting_for_a_minute() -> None:
    gains = next(g for g in hunting.random_pids(hunting.COUNT) if g["pid.Tf"] >= hunting.SAMPLE_TIME)
    ends = {f"reset_{n}": [hunting.watch_reset(gains | friction)] for n, friction in hunting.FRICTIONS.items()}
    rows = hunting.main(hunting.Job(ends, [gains])).set_index("name")
    assert list(rows["value"][[f"{n}.slips" for n in ends]]) == [0, 0, 0]
    assert rows["holds"].all()


def test_force_loop(tmp_path: Path) -> None:
    """Gains by hand: the dither makes the force finer, the integral does not."""
    plain = {"pid.Kp": 5e-3, "dead_zone_inverse.smoothing": 2e-3}
    gains = {"proportional": plain, "dither": plain | {"dither.amplitude": 0.5, "dither.frequency": 100.0}}
    gains |= {"feedforward": plain | {"feedforward.gain": 0.05, "feedforward.time": 0.01}}
    gains |= {"integral": plain | {"pid.Ki": force_loop.INTEGRAL}}
    job = force_loop.Job(gains, {n: force_loop.follow(g) for n, g in gains.items()})
    rows = force_loop.main(job).set_index("name")["value"]
    assert rows["dither.resolution"] < 0.6 * rows["proportional.resolution"] < 0.6 * rows["integral.resolution"]
    force_loop.figure(job).savefig(tmp_path / "force.png")


def test_a_force_that_settles_has_a_time() -> None:
    """5 N above each level for 0.1 s, then at it."""
    n, count = force_loop.samples(force_loop.DWELL), len(force_loop.LEVELS)
    force = np.repeat(force_loop.LEVELS, n) + np.tile(np.where(np.arange(n) < 100, 5.0, 0.0), count)
    run = Trajectory(1e-3 * np.arange(n * count + 1), {"load_force": np.append(force, 0.0)})
    assert force_loop.settling(run) == pytest.approx(0.1)
    assert force_loop.resolution(run) == 0
