"""New gains take over without a bump: in simulation the command goes on where it is."""

import numpy as np
import pytest

from pneuopt.control.bumpless import bumpless_transfer
from pneuopt.control.controller import Feedforward
from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID, Form
from pneuopt.control.sensor import Encoder
from pneuopt.dynamics.simulate import simulate
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.quantities.trajectories import Trajectory

OLD = {"pid.Kp": 200.0, "pid.Ki": 3000.0, "pid.Kd": 1.0, "pid.Tf": 0.01, "pid.b": 0.7, "pid.c": 1.0}
NEW = {"pid.Kp": 350.0, "pid.Ki": 6000.0, "pid.Kd": 2.5, "pid.Tf": 0.02, "pid.b": 0.2, "pid.c": 0.0}
H = 2e-3


LOOPS = {
    "continuous": ClosedLoop(ForceDrive(Stribeck()).system(), PID()),
    "feedforward": ClosedLoop(ForceDrive(Stribeck()).system(), PID(limits=False), feedforward=Feedforward()),
    "sampled": ClosedLoop(ForceDrive(Stribeck()).system(), PID(H)),
    "delayed": ClosedLoop(ForceDrive(Stribeck()).system(), PID(H, delay=1), Dither(60.0)),
    "encoder": ClosedLoop(ForceDrive(Stribeck()).system(), PID(H, dead_band=True), sensor=Encoder(0.0, 5e-3)),
}


def fed(n: int) -> Trajectory:
    return Trajectory(np.arange(n) * H, {"reference": np.full(n, 0.1)})


@pytest.mark.parametrize("name", LOOPS)
def test_the_command_goes_on_where_it_is(name: str) -> None:
    """In the midst of a step, between two samples: the next command is the old gains', and the loop still settles."""
    loop = LOOPS[name]
    old = loop.parameters.with_values(OLD | ({"feedforward.gain": 50.0} if loop.feedforward else {}))
    new = old.with_values(NEW | ({"feedforward.gain": 90.0} if loop.feedforward else {}))
    run = simulate(loop, fed(11), old, t_out=[0.0, 9.999 * H])
    x = np.array([run[q.name][-1] for q in loop.states])
    moved = bumpless_transfer(loop, x, old, new, reference=0.1)
    commands = {}
    for label, state, gains in (("on", x, old), ("jumped", x, new), ("bumpless", moved, new)):
        after = simulate(loop, fed(301), gains, initial=state)
        commands[label] = float(after["control"][loop.pid.delay])
    assert abs(commands["jumped"] - commands["on"]) > 3.0
    assert commands["bumpless"] == pytest.approx(commands["on"], abs=1e-9)
    assert after["speed"][-1] == pytest.approx(0.1, abs=2e-3)


@pytest.mark.parametrize("c", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("name", LOOPS)
def test_a_loop_that_starts_in_steady_motion_goes_on_so(name: str, c: float) -> None:
    """Whatever part of the reference the derivative sees: it remembers that part, not the whole error."""
    loop = LOOPS[name]
    p = loop.parameters.with_values(OLD | {"pid.c": c})
    after = simulate(loop, fed(31), p, initial=loop.initial(p, reference=0.1))
    np.testing.assert_allclose(after["control"], after["control"][0], rtol=1e-6)
    np.testing.assert_allclose(after["speed"], 0.1, rtol=1e-6)


def test_a_form_takes_over_in_its_own_gains() -> None:
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), PID(H, form=Form.STANDARD))
    old = loop.parameters.with_values({"pid.Kp": 100.0, "pid.Ti": 0.1})
    x = loop.initial(old, reference=0.1)
    moved = bumpless_transfer(loop, x, old, old.with_values({"pid.Kp": 300.0, "pid.b": 0.0}), reference=0.1)
    k = [q.name for q in loop.states].index("pid.integral")
    assert moved[k] - x[k] == pytest.approx(300.0 * 0.1)
    np.testing.assert_array_equal(np.delete(moved, k), np.delete(x, k))
