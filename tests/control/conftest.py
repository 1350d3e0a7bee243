"""Small plants with known answers."""

from collections.abc import Callable

import casadi as ca
import numpy as np
import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.parameters import Parameter, ParameterSet, Quantity
from pneuopt.system import Symbols, System, define
from pneuopt.tuning.linearised import Linearised

EQ16 = (1270.12, 17.5, 86.34)


@pytest.fixture
def second_order() -> System:
    """The paper's eq. 16, V(s)/U(s) = k/(s^2 + a1 s + a0)."""
    gain, a1, a0 = EQ16
    parameters = ParameterSet(
        {"plant.k": Parameter(gain, "m/(V*s^3)"), "plant.a1": Parameter(a1, "1/s"), "plant.a0": Parameter(a0, "1/s^2")}
    )

    def rhs(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:
        jerk = p["plant.k"] * u["valve_voltage"] - p["plant.a1"] * x["acceleration"] - p["plant.a0"] * x["speed"]
        return {"speed": x["acceleration"], "acceleration": jerk}, {"speed": x["speed"]}

    states = [Quantity("speed", "m/s"), Quantity("acceleration", "m/s^2")]
    return define(states, [Quantity("valve_voltage", "V")], [Quantity("speed", "m/s")], parameters, rhs)


@pytest.fixture
def axis() -> System:
    """A mass pushed by a force against viscous friction and a constant load; a pressure as a second input."""
    parameters = ParameterSet(
        {"mass": Parameter(2.0, "kg"), "viscous": Parameter(10.0, "N*s/m"), "load": Parameter(3.0, "N")}
    )

    def rhs(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:
        force = u["force"] - p["load"] - p["viscous"] * x["speed"] - 1e-5 * u["pressure"]
        rates = {"position": x["speed"], "speed": force / p["mass"]}
        return rates, {"position": x["position"], "speed": x["speed"], "acceleration": force / p["mass"]}

    states = [Quantity("position", "m"), Quantity("speed", "m/s")]
    inputs = [Quantity("force", "N"), Quantity("pressure", "Pa(g)")]
    outputs = [*states, Quantity("acceleration", "m/s^2")]
    return define(states, inputs, outputs, parameters, rhs)


Run = Callable[[ClosedLoop, ParameterSet, float, float, float], tuple[np.ndarray, np.ndarray, np.ndarray]]


@pytest.fixture
def run() -> Run:
    """Step the loop at rest: run(loop, parameters, reference, h, duration) -> t, states after update, outputs."""

    def march(
        loop: ClosedLoop, parameters: ParameterSet, reference: float, h: float, duration: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        model = loop.discrete(4)
        x, u, p = ca.MX.sym("x", len(model.states)), ca.MX.sym("u", len(model.inputs)), loop.numbers(parameters)
        t = ca.MX.sym("t")
        after, y = model.sample(t, ca.MX(h), x, u, ca.MX(ca.DM(p)))
        n = round(duration / h)
        grid = h * np.arange(n)
        inputs = np.zeros((len(model.inputs), n))
        inputs[0] = reference
        sample = ca.Function("sample", [x, ca.vertcat(t, u)], [after, y])
        states, outputs = sample.mapaccum(n)(loop.initial(parameters), np.vstack([grid, inputs]))
        return grid, np.array(states).T, np.array(outputs).T

    return march


@pytest.fixture(scope="session")
def check_slopes() -> Callable[[Linearised, np.ndarray], None]:
    """The rows' derivatives at z are those of central differences; nodes that move past a kink may be off."""

    def check(posed: Linearised, z: np.ndarray) -> None:
        (point,) = posed.evaluate(z[None])
        for k in range(len(z)):
            nudge = 1e-6 * (np.arange(len(z)) == k)
            above, below = posed.evaluate(np.array([z + nudge, z - nudge]))
            off = np.abs((above.values - below.values) / 2e-6 - point.slopes[:, k])
            scale = np.abs(point.slopes[:, k]).max() + 1e-3
            assert np.quantile(off, 0.99) < 2e-3 * scale, k
            assert np.median(off) < 1e-5 * scale, k

    return check
