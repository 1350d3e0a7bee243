"""An integral that nothing fills empties, and a start far from the set point does not wait for a slow one."""

from math import inf

import casadi as ca
import numpy as np
import pytest

from pneuopt.control.bumpless import bumpless_transfer
from pneuopt.control.forms import Form
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID, AntiWindup
from pneuopt.control.position_loop import PositionLoop
from pneuopt.dynamics.system import names
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Viscous
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import ParameterSet

H, Tt = 5e-3, 0.2
FORCE = ForceDrive(friction=Viscous()).system()
SERVO = {"pid.Kp": 2000.0, "pid.Kd": 100.0, "pid.Tt": Tt, "pid.lower": -200.0, "pid.upper": 200.0}
WINDUPS = pytest.mark.parametrize("windup", [None, *AntiWindup])
RESTS = {"no integral": 0.0, "slow": 250.0, "usual": 4000.0}  # Ki


def servo(
    windup: AntiWindup | None = AntiWindup.BACK_CALCULATION, h: float | None = H, form: Form = Form.PARALLEL
) -> ClosedLoop:
    kind = windup or AntiWindup.BACK_CALCULATION
    return ClosedLoop(FORCE, PID(h, windup is not None, form, anti_windup=kind), measured="position")


def settings(loop: ClosedLoop, **values: float) -> ParameterSet:
    own = SERVO | {f"pid.{n}": v for n, v in values.items()}
    return loop.parameters.with_values({n: v for n, v in own.items() if n in loop.parameters})


def follow(
    loop: ClosedLoop, p: ParameterSet, x: Array, reference: float, duration: float
) -> tuple[Array, Array, Array]:
    """The first states after a sample, the last ones, and the outputs, under a constant reference."""
    v, step, control, first = loop.parameter_vector(p), loop.discrete(4).step, [], None
    u = [reference] + [0.0] * (len(loop.inputs) - 1)
    for k in range(round(duration / H)):
        x = loop.update(k * H, x, u, v).full().ravel()
        first = x if first is None else first
        control.append(x[names(loop.states).index("pid.command")])
        x = step(k * H, H, x, u, v)[0].full().ravel()
    assert first is not None
    return first, x, np.array(control)


def emptying_time(windup: AntiWindup | None) -> float:
    """Tt, or where there is none its default [s]."""
    return Tt if windup is AntiWindup.BACK_CALCULATION else 0.1


def state(loop: ClosedLoop, x: Array, name: str) -> float:
    return float(x[names(loop.states).index(name)])


@WINDUPS
@pytest.mark.parametrize("rest", RESTS)
def test_a_start_away_from_the_set_point_does_not_jump_and_arrives(windup: AntiWindup | None, rest: str) -> None:
    loop = servo(windup)
    p = settings(loop, Ki=RESTS[rest])
    x = loop.initial(p, [0.0, 0.0], reference=0.05)
    first, last, control = follow(loop, p, x, 0.05, 5.0)
    assert abs(control[0]) <= RESTS[rest] * H * 0.05 * (1 + 1e-9)
    assert np.max(np.abs(np.diff(control))) < 8.0  # of 100 N, which a step would have taken at once
    assert state(loop, last, "position") == pytest.approx(0.05, abs=2e-3 if rest == "slow" else 1e-4)
    kept = RESTS[rest] * H * 0.05 if RESTS[rest] else -100.0 / (1 + H / emptying_time(windup))
    assert state(loop, first, "pid.integral") == pytest.approx(kept)


@WINDUPS
def test_without_an_integral_a_hands_output_passes_with_Tt(windup: AntiWindup | None) -> None:
    loop = servo(windup)
    p, time = settings(loop, Ki=0.0), emptying_time(windup)
    x = loop.initial(p, [0.0, 0.0], command=20.0)
    v = loop.parameter_vector(p)
    for k in range(1, 30):
        x = loop.update(0.0, x, [0.0], v).full().ravel()
        assert state(loop, x, "pid.integral") == pytest.approx(20.0 * (1 + H / time) ** -k)
        assert state(loop, x, "pid.command") == pytest.approx(20.0 * (1 + H / time) ** (1 - k))


@pytest.mark.parametrize("form", Form)
@pytest.mark.parametrize("Ti", [inf, 1.0e30, 3.4e38])
def test_an_infinite_time_is_no_integral_in_every_form(form: Form, Ti: float) -> None:
    loop = servo(form=form)
    given = (
        {"Ki": 0.0} if form is Form.PARALLEL else {"Ti": Ti, "K" if form is Form.SERIES else "Kp": 2000.0, "Td": 0.05}
    )
    p = settings(loop, **given)
    _, x, control = follow(loop, p, loop.initial(p, [0.0, 0.0], command=150.0), 0.5, 3.0)
    assert control.max() == 200.0
    assert state(loop, x, "position") == pytest.approx(0.5, abs=1e-4)
    assert abs(state(loop, x, "pid.integral")) < 1e-3


@pytest.mark.parametrize("windup", AntiWindup)
@pytest.mark.parametrize("slow", [Tt, 1e9, inf])
def test_out_of_saturation_nothing_is_left(windup: AntiWindup, slow: float) -> None:
    """Whatever Tt: a back-calculation that is switched off is one that takes nothing, and keeps nothing."""
    loop = servo(windup)
    p = settings(loop, Ki=0.0, Tt=slow)
    _, x, control = follow(loop, p, loop.initial(p), 0.2, 5.0)
    assert (control == 200.0).sum() > 3
    assert state(loop, x, "position") == pytest.approx(0.2, abs=1e-6)
    _, x, _ = follow(loop, p, loop.initial(p, [0.0, 0.0], reference=0.2, command=20.0), 0.2, 8.0)
    assert state(loop, x, "position") == pytest.approx(0.2, abs=1e-4)


def test_the_cascade_arrives() -> None:
    loop = ClosedLoop(PneumaticDrive(friction=Viscous()).system(), PID(H), measured="position", outer=PositionLoop())
    values = {"pid.Kp": 2.0, "pid.lower": -1.0, "pid.upper": 1.0, "position_loop.Kp": 4.0}
    p = loop.parameters.with_values({**values, "friction.viscous": 200.0, "cylinder.stroke": 0.6})
    ends = []
    for command, reference in ((0.0, 0.05), (0.5, 0.05), (0.0, 0.2)):
        rest = loop.initial(p)[: len(loop.plant.states)]
        x = loop.initial(p, rest, reference=reference if reference < 0.2 else 0.0, command=command)
        ends.append(state(loop, follow(loop, p, x, reference, 6.0)[1], "position") - reference)
    assert max(ends) - min(ends) < 2e-4  # a proportional loop's own rest, 1.7 mm off
    assert max(np.abs(ends)) < 2e-3


@pytest.mark.parametrize("h", [H, None])
def test_the_gain_counts_where_it_is_zero(h: float | None) -> None:
    """The derivative by Ki is that of an integral, so that a search can leave zero."""
    loop = servo(h=h)
    p = ca.SX.sym("p", len(loop.parameters))
    x = np.zeros(len(loop.states))
    after = loop.system().ode(0, x, [0.03], p)[0] if h is None else loop.update(0, x, [0.03], p)
    slope = ca.Function("slope", [p], [ca.jacobian(after, p)])(loop.parameter_vector(settings(loop, Ki=0.0)))
    row, column = names(loop.states).index("pid.integral"), list(loop.parameters).index("pid.Ki")
    assert float(slope[row, column]) == pytest.approx(0.03 * (h or 1.0))


@pytest.mark.parametrize("limits", [True, False])
def test_a_continuous_integral_empties_too(limits: bool) -> None:
    loop = ClosedLoop(FORCE, PID(None, limits), measured="position")
    p = settings(loop, Ki=0.0)
    x = loop.initial(p, [0.0, 0.0], command=20.0)
    rates = loop.system().ode(0, x, [0.5], loop.parameter_vector(p))[0].full().ravel()
    assert state(loop, rates, "pid.integral") == pytest.approx(-20.0 / (Tt if limits else 0.1))


def test_at_rest_on_the_set_point_nothing_is_transferred() -> None:
    loop = servo()
    p = settings(loop, Ki=4000.0, b=0.3)
    x = loop.initial(p, [0.07, 0.0], reference=0.07, command=11.0)
    assert state(loop, x, "pid.transfer") == 0.0
    assert state(loop, x, "pid.integral") == 11.0 - 2000.0 * (0.3 * 0.07 - 0.07)
    _, last, control = follow(loop, p, loop.initial(p, reference=0.07), 0.07, 1.0)
    assert np.max(np.abs(control)) < 1e-9
    assert state(loop, last, "position") == pytest.approx(0.07, abs=1e-12)


@pytest.mark.parametrize("Ki", [0.0, 250.0])
def test_new_gains_on_the_way_neither_jump_nor_keep_the_axis(Ki: float) -> None:
    """In the middle of a move, to half the gain: what the distance was worth passes."""
    loop = servo(None)
    old, new = settings(loop, Ki=4000.0), settings(loop, Ki=Ki, Kp=1000.0)
    _, x, control = follow(loop, old, loop.initial(old), 0.1, 0.035)
    assert (2000.0 - 1000.0) * (0.1 - state(loop, x, "position")) / 1000.0 > 0.03  # what the distance is worth [m]
    moved = bumpless_transfer(loop, x, old, new, reference=0.1)
    before = state(loop, loop.update(0.0, x, [0.1], loop.parameter_vector(old)).full().ravel(), "pid.command")
    after = state(loop, loop.update(0.0, moved, [0.1], loop.parameter_vector(new)).full().ravel(), "pid.command")
    assert after == pytest.approx(before, abs=1e-9)
    assert abs(control[-1]) > 1.0
    _, x, _ = follow(loop, new, moved, 0.1, 4.0)
    never = follow(loop, new, loop.initial(new), 0.1, 4.0)[1]
    assert state(loop, x, "position") == pytest.approx(state(loop, never, "position"), abs=6e-3)


def test_a_gain_that_becomes_zero_leaves_nothing() -> None:
    loop = servo()
    old, new = settings(loop, Ki=4000.0), settings(loop, Ki=0.0)
    _, x, _ = follow(loop, old, loop.initial(old), 0.1, 0.2)
    assert abs(state(loop, x, "pid.integral")) > 1.0
    _, x, _ = follow(loop, new, x, 0.1, 4.0)
    assert state(loop, x, "position") == pytest.approx(0.1, abs=1e-6)
