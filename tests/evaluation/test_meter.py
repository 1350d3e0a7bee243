"""What plants' meters show, by channel, against the formulas by hand."""

import math

import numpy as np
import pytest

from pneuopt.dynamics.system import names
from pneuopt.evaluation.meter import meter_channels
from pneuopt.models.catalog import t32
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Viscous
from pneuopt.models.linear import FirstOrder


def test_air_power_is_the_isothermal_work_of_the_volume_drawn() -> None:
    drive, values = t32()
    plant = drive.system()
    assert plant.meter is not None
    assert meter_channels(plant) == ("air", "spool", "power")
    p = plant.parameters | values.select(plant.parameters)
    x = np.array([q.nominal for q in plant.states])
    x[names(plant.states).index("pressure_a")] = 2e5
    if "valve.spool" in names(plant.states):
        x[names(plant.states).index("valve.spool")] = 0.5
    air, _, power = (float(found) for found in plant.meter(0, x, [2.5], [p.value(n) for n in p]))
    supply, volume = (
        p.value("supply.pressure"),
        air * 287.0 * p.value("ambient.temperature") / p.value("supply.pressure"),
    )
    assert air > 0
    assert power == pytest.approx(supply * volume * math.log(supply / p.value("ambient.pressure")), rel=2e-3)


def test_a_motor_draws_what_it_drives_with_and_nothing_in_braking() -> None:
    plant = ForceDrive(Viscous()).system()
    assert plant.meter is not None
    p = [q.value for q in plant.parameters.values()]
    shown = [float(plant.meter(0, [0.0, speed], [10.0], p)) for speed in (0.2, -0.2)]
    assert shown == [2.0, 0.0]


def test_what_has_no_meter_shows_nothing() -> None:
    assert meter_channels(FirstOrder().system()) == ()
