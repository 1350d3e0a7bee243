"""What logs cannot identify is said before the search; nothing is said of good logs."""

import numpy as np
import pytest

from pneuopt.dynamics.simulate import simulate
from pneuopt.identification import identify as identify_module
from pneuopt.identification.examination import pose_problem
from pneuopt.identification.identifiability import foresee_unidentifiable
from pneuopt.logs.experiment import Experiment
from pneuopt.models.drives import ForceDrive, MotionDrive
from pneuopt.models.friction import Stribeck
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import PhysicsWarning
from pneuopt.quantities.parameters import Intersample
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.least_squares import LeastSquares

DRIVE = ForceDrive(Stribeck())
LEVELS = ("friction.coulomb", "friction.viscous", "friction.static", "friction.stribeck_velocity")
TIME = np.arange(0, 1.5, 2e-3)
SWINGING = 60 * np.sin(2 * np.pi * TIME) + 40 * np.sin(2 * np.pi * 2.3 * TIME)  # [N] slides, sticks and turns
ONE_WAY = 150 + 40 * np.sin(2 * np.pi * 2 * TIME)  # [N] slides forwards, never slowly


def log(force: Array, first: int = 0) -> Experiment:
    """The drive's position under a force, with 20 um of noise, from a sample on."""
    held = {"force": Intersample.HELD}
    run = simulate(DRIVE.system(), Trajectory(TIME, {"force": force}), DRIVE.parameters, intersample=held)
    noisy = run["position"] + 2e-5 * np.random.default_rng(0).standard_normal(TIME.size)
    table = Trajectory(TIME, {"force": force, "position": noisy}).rows(first, TIME.size)
    return Experiment(table, {"position": 2e-5}, name="run").with_intersample(held)


def foreseen(run: Experiment, *free: str) -> tuple[str, ...]:
    return foresee_unidentifiable(pose_problem(DRIVE, run, DRIVE.parameters.freed(*free), LeastSquares()))


def test_nothing_is_said_of_a_log_that_shows_all() -> None:
    assert foreseen(log(SWINGING), *LEVELS, "load.mass", "load.force") == ()


def test_a_log_that_moves_one_way_does_not_tell_friction_from_a_constant_force() -> None:
    said = foreseen(log(ONE_WAY, 100), "friction.coulomb", "friction.viscous", "load.mass", "load.force")
    lack = "before the search: the logs do not identify load.force: the drive moves forwards only; log both directions"
    assert said == (lack,)


def test_a_log_that_never_slides_slowly_does_not_tell_static_friction() -> None:
    said = foreseen(log(ONE_WAY, 100), *LEVELS)
    assert any("friction.static" in sentence for sentence in said)
    assert all("slower than the Stribeck velocity" in s or "where friction is one level" in s for s in said), said
    assert not any("friction.coulomb" in sentence.partition(": the logs do not identify")[2] for sentence in said)


def test_what_is_known_is_not_doubted() -> None:
    """One way, too, Coulomb friction and mass are identified where no constant force is free."""
    assert foreseen(log(ONE_WAY, 100), "friction.coulomb", "load.mass") == ()


def test_a_static_map_is_fitted_as_soon_as_it_is_doubted() -> None:
    rig = MotionDrive(Stribeck(), chamber=False)
    speed = np.full(100, 0.3)
    force = 50 + 0.5 * np.random.default_rng(0).standard_normal(100)
    run = Experiment(Trajectory(TIME[:100], {"speed": speed, "force": force}), {"force": 0.5}, accept=("motion",))
    assert foresee_unidentifiable(pose_problem(rig, run, rig.parameters.freed(*LEVELS), LeastSquares())) == ()


def test_identify_warns_before_it_searches(monkeypatch: pytest.MonkeyPatch) -> None:
    def search(*_: object, **__: object) -> None:
        raise RuntimeError("the search has begun")

    monkeypatch.setattr(identify_module, "choose_widths", search)
    given = DRIVE.parameters.freed("friction.coulomb", "load.force")
    with (
        pytest.warns(PhysicsWarning, match=r"before the search: .*load\.force: the drive moves forwards only"),
        pytest.raises(RuntimeError, match="has begun"),
    ):
        identify_module.identify(DRIVE, log(ONE_WAY, 100), given)
