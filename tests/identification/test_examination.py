""""""

import math

import numpy as np
import pytest

from pneuopt.identification.examination import axis_from_model, examine_logs
from pneuopt.logs.experiment import Experiment
from pneuopt.models.drives import ForceDrive, RotaryDrive
from pneuopt.models.friction import Asymmetric, Coulomb
from pneuopt.models.linear import FirstOrder
from pneuopt.models.load import Load
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.quantities.trajectories import Trajectory
from tests.logs.bad_logs import BAD_LOGS

LOG = Experiment(Trajectory([0.0, 0.1], {"position": [0.0, 0.1], "force": [1.0, 1.0]}))


def test_what_is_stated_of_a_pushed_load() -> None:
    drive = ForceDrive(Coulomb(), Load(spring=True, inclined=True))
    values = {"load.mass": 3.0, "load.force": 4.0, "load.stiffness": 50.0, "load.rest_position": 0.2}
    given = drive.parameters.with_values({**values, "load.inclination": math.asin(0.5)})
    axis = axis_from_model(drive.system(), LOG, given)
    assert axis.forces == pytest.approx({"position": -50.0, "force": 1.0})
    assert axis.constant == pytest.approx(-4.0 + 50.0 * 0.2 - 3.0 * 9.80665 * 0.5)
    assert (axis.inertia, axis.inertia_name, axis.offset_parameter) == (3.0, "load.mass", "load.force")


@pytest.mark.parametrize(
    ("free", "inertia", "is_constant", "has_forces"),
    [("friction.*", 5.0, True, True), ("load.mass", math.nan, True, True), ("load.force", 5.0, False, True)],
)
def test_what_is_free_is_not_stated(free: str, inertia: float, is_constant: bool, has_forces: bool) -> None:
    drive = ForceDrive(Coulomb())
    axis = axis_from_model(drive.system(), LOG, drive.parameters.freed(free))
    assert axis.inertia == pytest.approx(inertia, nan_ok=True)
    assert math.isfinite(axis.constant) == is_constant
    assert bool(axis.forces) == has_forces
    known = LOG.with_conditions({"load.mass": 2.0, "load.force": 1.0})
    own = axis_from_model(drive.system(), known, drive.parameters.freed(free))
    assert (own.inertia, own.constant) == (2.0, -1.0)


def test_friction_that_differs_by_direction_leaves_no_offset_to_be_seen() -> None:
    drive = ForceDrive(Asymmetric(Coulomb()))
    assert math.isnan(axis_from_model(drive.system(), LOG, drive.parameters.freed("friction.*")).constant)


def test_a_cylinder_has_its_areas_its_ambient_pressure_and_its_stops() -> None:
    drive = PneumaticDrive()
    truth = drive.parameters
    axis = axis_from_model(drive.system(), LOG, truth)
    area = math.pi / 4 * truth.value("cylinder.bore") ** 2
    rod = math.pi / 4 * truth.value("cylinder.rod") ** 2
    assert axis.forces == pytest.approx({"pressure_a": area, "pressure_b": rod - area}, rel=1e-6)
    assert axis.constant == pytest.approx(-rod * truth.value("ambient.pressure") - truth.value("load.force"), rel=1e-2)
    assert axis.stops == pytest.approx((0.0, truth.value("cylinder.stroke")), abs=2e-4)
    assert axis_from_model(drive.system(), LOG, truth.freed("cylinder.bore")).forces == {}


def test_other_plants_name_their_own_channels_or_none() -> None:
    rotary = RotaryDrive(Coulomb())
    axis = axis_from_model(rotary.system(), LOG, rotary.parameters)
    assert (axis.position, axis.push) == ("angle", "torque")
    assert axis.forces == pytest.approx({"torque": 1.0})
    system = FirstOrder().system()
    assert axis_from_model(system, LOG, system.parameters).forces == {}


def test_a_stated_mass_is_held_against_the_log_and_a_free_one_is_not() -> None:
    drive, log = ForceDrive(Coulomb()), BAD_LOGS["mass"].select(["position", "speed", "force"])
    stated = drive.parameters.with_values({"load.mass": 20.0}).freed("friction.coulomb")
    (finding,) = examine_logs(drive, log, stated)
    assert (finding.check, finding.fault, finding.log) == ("mass", True, "swing")
    found = float(finding.message.split("those of ")[1].split(" kg")[0])
    assert found == pytest.approx(5 / (0.3 * 2 * np.pi), rel=0.06)
    assert examine_logs(drive, log, stated.freed("load.mass")) == ()
