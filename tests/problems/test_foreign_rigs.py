"""The rigs in plain C move as SciPy's integrator with events moves them, and a seed is a rig."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from problems.shared import foreign_rigs
from problems.shared.arrays import Array
from problems.shared.foreign_rigs import SMOOTH, STICKING, draw_cylinder, draw_servo, record, simulate

pytestmark = pytest.mark.skipif(not (shutil.which("cc") or shutil.which("gcc")), reason="a C compiler moves the rigs")


def servo(friction: int) -> foreign_rigs.Rig:
    """A servo of 2 kg under held forces, which slides, sticks and turns within 0.3 s."""
    numbers = dict(draw_servo(0).numbers) | {
        "friction": friction,
        "mass": 2.0,
        "load": 0.5,
        "coulomb": 8.0,
        "static": 12.0,
        "stribeck": 0.02,
        "viscous": 15.0,
        "smoothing": 2e-3,
        "gain": 0.0,
        "damping": 0.0,
        "limit": 100.0,
        "sample": 1e-3,
    }
    return replace(draw_servo(0), numbers=numbers, samples=300)


def by_events(rig: foreign_rigs.Rig, forces: Array) -> Array:
    """Position and speed at each sample: the mode changes where the speed or the force's margin crosses zero."""
    q, x, mode, rows = rig.numbers, np.zeros(2), 0, []
    for force in forces:
        rows.append(x)
        push, at = force - q["load"], 0.0
        while at < q["sample"]:
            if q["friction"] == STICKING and mode == 0:
                if abs(push) <= q["static"]:
                    break
                mode = 1 if push > 0 else -1

            def rates(_: float, y: Array, push: float = push, way: int = mode) -> list[float]:
                v = y[1]
                level = q["coulomb"] + (q["static"] - q["coulomb"]) * np.exp(-((v / q["stribeck"]) ** 2))
                sign = way if q["friction"] == STICKING else np.tanh(v / q["smoothing"])
                return [v, (push - level * sign - q["viscous"] * v) / q["mass"]]

            def stops(_: float, y: Array, way: int = mode) -> float:
                return float(y[1]) * way + (1e-15 if way else 1.0)

            stops.terminal, stops.direction = True, -1  # type: ignore[attr-defined]
            run = solve_ivp(rates, (at, q["sample"]), x, events=stops, rtol=1e-10, atol=1e-14, max_step=2e-4)
            x, at = run.y[:, -1], float(run.t[-1])
            if run.status == 1:
                x, mode = np.array([x[0], 0.0]), 0
    return np.array(rows)


@pytest.mark.parametrize("friction", [SMOOTH, STICKING])
def test_the_rigs_in_c_agree_with_a_simulation_by_events(friction: int) -> None:
    rig = servo(friction)
    t = np.arange(rig.samples) * 1e-3
    forces = rig.numbers["load"] + 16 * np.sin(2 * np.pi * 6 * t)
    found = simulate(rig, forces)
    found[:, 0] -= found[0, 0]
    expected = by_events(rig, forces)
    assert np.ptp(expected[:, 0]) > 3e-3
    assert np.abs(found[:, 0] - expected[:, 0]).max() < 1e-6
    assert np.abs(found[:, 1] - expected[:, 1]).max() < 1e-4
    if friction == STICKING:
        assert np.mean(found[:, 1] == 0) > 0.1


@pytest.mark.parametrize("kind", [foreign_rigs.draw_servo, foreign_rigs.draw_cylinder])
def test_a_seed_is_a_rig_and_a_log(kind: Callable[[int], foreign_rigs.Rig]) -> None:
    rig = replace(kind(2), samples=200)
    assert rig == replace(kind(2), samples=200)
    assert record(rig) == record(rig)
    assert kind(4).numbers != rig.numbers


def test_without_a_compiler_the_script_says_so_in_a_sentence(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(shutil, "which", lambda _: None)
    foreign_rigs._library.cache_clear()
    with pytest.raises(RuntimeError, match=r"^foreign rigs are moved by a C program: install a C compiler, cc or gcc$"):
        foreign_rigs.write_rig(replace(draw_servo(2), samples=50), tmp_path)
    foreign_rigs._library.cache_clear()


def test_a_log_of_the_position_alone_is_recorded() -> None:
    """Its rigs used to end in an error of the script."""
    rig = replace(draw_cylinder(2), samples=50, position_only=True)
    assert list(record(rig)) == ["time [s]", "valve_voltage [V]", "position [mm]"]
