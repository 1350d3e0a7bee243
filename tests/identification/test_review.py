"""What a fit that failed says, and that following its advice helps."""

import re

import numpy as np

import pneuopt as po

FREE = ("friction.coulomb", "friction.static", "friction.viscous", "friction.stribeck_velocity")


def sticking() -> po.Experiment:
    """A pulled mass that sticks between its slips, its events located."""
    t = np.arange(1200) * 1e-3
    rig = po.ForceDrive(po.Karnopp(po.Stribeck()))
    truth = rig.parameters.with_values({"friction.coulomb": 30.0, "friction.static": 45.0, "load.mass": 5.0})
    pull = np.where(t % 1.0 < 0.5, 1, -1) * (20 + 60 * (t % 0.5))
    sensors = {"position": po.Sensor(noise=1e-5)}
    return po.record(po.Rig(rig.system(), sensors), po.Trajectory(t, {"force": pull}), truth).experiment


def test_a_log_that_sticks_asks_for_a_narrower_smoothing_and_is_explained_by_it() -> None:
    system, log = po.ForceDrive(po.Stribeck()).system(), sticking()
    given = system.parameters.with_values({"load.mass": 5.0, "friction.smoothing": 1e-3}).freed(*FREE)
    failed = po.identify(system, [log], given, throw=False)
    assert not failed.status.converged
    advice = re.search(r"try friction.smoothing = (\S+) m/s in place of 0.001 m/s", failed.status.message)
    assert advice is not None
    followed = po.identify(system, [log], given.with_values({"friction.smoothing": float(advice[1])}))
    for name, true in (("friction.coulomb", 30.0), ("friction.static", 45.0)):
        assert abs(followed.parameters.value(name) / true - 1) < 0.05
