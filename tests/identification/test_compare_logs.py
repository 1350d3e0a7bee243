"""Whether logs are of one drive."""

import numpy as np
import pandas as pd
import pytest

from pneuopt.dynamics.simulate import simulate
from pneuopt.identification.compare_logs import _disagreements, compare_logs
from pneuopt.identification.identify import identify
from pneuopt.logs.experiment import Experiment
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb
from pneuopt.quantities.parameters import Intersample
from pneuopt.quantities.trajectories import Trajectory

TRUTH = {"load.mass": 3.0, "load.force": 5.0, "friction.coulomb": 30.0, "friction.viscous": 60.0}
DRIVE = ForceDrive(Coulomb()).system()
FREE = DRIVE.parameters.freed(*TRUTH)


def pushed(name: str, seed: int, **other: float) -> Experiment:
    t = np.arange(1000) * 1e-3
    force = 50 * np.sin(2 * np.pi * t) + 40 * np.sin(2 * np.pi * 2.3 * t + seed)
    truth = {**TRUTH, **{n.replace("__", "."): v for n, v in other.items()}}
    run = simulate(
        DRIVE,
        Trajectory(t, {"force": force}),
        DRIVE.parameters.with_values(truth),
        intersample={"force": Intersample.LINEAR},
    )
    noisy = run["position"] + 2e-5 * np.random.default_rng(seed).standard_normal(t.size)
    return Experiment(Trajectory(t, {"force": force, "position": noisy}), {"position": 2e-5}, name=name)


def test_the_parameter_and_the_log_that_disagree_are_named() -> None:
    logs = [pushed("a", 1), pushed("b", 2), pushed("other", 3, friction__coulomb=36.0)]
    joint = identify(DRIVE, logs, FREE, throw=False)
    assert "compare_logs shows whether the logs are of one drive" in joint.status.message
    found = compare_logs(DRIVE, logs, FREE)
    assert not found.agree
    assert found.reason.startswith("the logs disagree in friction.coulomb, by ")
    assert "in other alone, and 30" in found.reason
    deviation = found.table["deviation"].abs()
    assert deviation["friction.coulomb"]["other"] > 20
    assert deviation["load.mass"].max() < 4


def test_logs_of_one_drive_agree_whatever_is_each_ones_own() -> None:
    logs = [pushed("a", 1, load__force=-4.0), pushed("b", 2, load__force=9.0)]
    found = compare_logs(DRIVE, logs, FREE.per_log("load.force"))
    assert found.agree, found
    assert "load.force" not in found.table.index.get_level_values("parameter")
    assert found.reason == "the 2 logs agree in load.mass, friction.coulomb, friction.viscous"
    masses = [pushed("a", 1), pushed("b", 2, load__mass=6.0).with_conditions({"load.mass": 6.0})]
    assert compare_logs(DRIVE, masses, FREE).agree


@pytest.mark.parametrize(
    ("deviation", "value", "disagree"), [(3.9, 2.0, 0), (4.1, 2.0, 1), (-4.1, 2.0, 1), (40.0, 1.01, 0)]
)
def test_a_disagreement_is_beyond_four_deviations_and_two_percent(
    deviation: float, value: float, disagree: int
) -> None:
    table = pd.DataFrame({"deviation": [deviation], "value": [value], "others": [1.0]})
    assert len(_disagreements(table)) == disagree


def test_what_no_two_logs_identify_is_not_compared() -> None:
    known = FREE.fixed(*TRUTH).freed("load.mass")
    logs = [pushed("a", 1), pushed("b", 2).with_conditions({"load.mass": 3.0})]
    found = compare_logs(DRIVE, logs, known)
    assert found.agree
    assert found.reason.startswith("nothing could be compared")
