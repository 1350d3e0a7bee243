"""Rest and steady motion of drives that a known force or torque pushes."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.dynamics.system import System, names, parameter_vector
from pneuopt.evaluation.dither_effect import dither_effect
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Asymmetric, Coulomb, FrictionModel, LuGre, Stribeck, Viscous
from pneuopt.models.load import Load
from pneuopt.models.load_dependent import LoadDependent
from pneuopt.models.rotary import RotaryDrive
from pneuopt.quantities.errors import ConvergenceError, InputError

LAWS = [Viscous(), Coulomb(), Asymmetric(Stribeck()), LuGre(), LoadDependent(Stribeck()), LoadDependent(LuGre())]
LOADS = {"load.force": 12.0, "load.torque": 0.1, "friction.coulomb_load": 0.2, "friction.asymmetry": 0.1}


def loaded(system: System) -> tuple[System, np.ndarray]:
    given = system.parameters.with_values({n: v for n, v in LOADS.items() if n in system.parameters})
    return system, parameter_vector(system.parameters, given)


@pytest.mark.parametrize("law", LAWS, ids=lambda law: repr(law).replace("()", ""))
@pytest.mark.parametrize("drive", [ForceDrive, RotaryDrive])
@pytest.mark.parametrize("speed", [0.0, 0.04, -0.3])
def test_the_rest_keeps_its_speed_when_it_is_integrated(
    drive: type[ForceDrive | RotaryDrive], law: FrictionModel, speed: float
) -> None:
    system, p = loaded(drive(law).system())
    assert system.rest_hook is not None
    rest = system.rest_hook(
        system.parameters.with_values(dict(zip(system.parameters, p, strict=True))), {"speed": speed}
    )
    x, u = [rest.states[n] for n in names(system.states)], [rest.inputs[n] for n in names(system.inputs)]

    def rate(t: float, x: np.ndarray) -> np.ndarray:
        return np.array(system.ode(t, x, u, p)[0]).ravel()

    run = solve_ivp(rate, (0.0, 0.2), x, method="LSODA", rtol=1e-9, atol=1e-12)
    kept = run.y[names(system.states).index("speed")]
    np.testing.assert_allclose(kept, speed, atol=1e-7)
    assert run.y[0, -1] == pytest.approx(0.2 * speed, abs=1e-6)


def test_a_spring_holds_still_where_it_is_and_lets_no_motion_be_steady() -> None:
    system = ForceDrive(Viscous(), Load(spring=True)).system()
    p = system.parameters.with_values({"load.stiffness": 100.0})
    assert system.rest_hook is not None
    assert system.rest_hook(p, {"position": 0.2}).inputs == {"force": pytest.approx(20.0)}
    with pytest.raises(ConvergenceError, match="changes the force that position needs"):
        system.rest_hook(p, {"speed": 0.1})


def test_it_starts_from_nothing_but_position_and_speed() -> None:
    system = RotaryDrive().system()
    assert system.rest_hook is not None
    with pytest.raises(InputError, match=r"from angle and speed, not from torque; leave torque out"):
        system.rest_hook(system.parameters, {"torque": 0.1})


@pytest.mark.parametrize("drive", [ForceDrive(Stribeck()), RotaryDrive(Stribeck())], ids=["force", "rotary"])
def test_a_dither_swings_the_moving_body_not_the_standing_one(drive: ForceDrive | RotaryDrive) -> None:
    """By harmonic balance as by integrating Newton's law under the dithered push."""
    plant = drive.system()
    loop = ClosedLoop(plant, PID(), Dither(100.0))
    amplitude, speed = (10.0, 0.25) if isinstance(drive, ForceDrive) else (0.1, 10.0)
    p = loop.parameters.with_values({"dither.amplitude": amplitude})
    found = dither_effect(loop, Step(speed), p)
    assert plant.rest_hook is not None
    (push,), values = plant.rest_hook(p, {"speed": speed}).inputs.values(), parameter_vector(plant.parameters, p)

    def rate(t: float, x: np.ndarray) -> np.ndarray:
        return np.array(plant.ode(t, x, [push + amplitude * np.sin(200 * np.pi * t)], values)[0]).ravel()

    last = np.linspace(0.99, 1.0, 201)
    run = solve_ivp(rate, (0.0, 1.0), [0.0, speed], t_eval=last, rtol=1e-8, atol=1e-10, max_step=1e-3)
    assert found.speed == pytest.approx(np.ptp(run.y[1]) / 2, rel=0.01)
    assert found.travel == pytest.approx(found.speed / (200 * np.pi))
