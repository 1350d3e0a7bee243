"""Books of mass and energy: what a pneumatic drive's chambers hold is what has crossed their borders."""

import casadi as ca
import numpy as np
import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import Symbols, System, define, names
from pneuopt.models.friction import Viscous
from pneuopt.models.pneumatic.chamber import Polytropic, Thermal, convection
from pneuopt.models.pneumatic.cylinder import Cylinder, areas, piston_leak
from pneuopt.models.pneumatic.drive import PneumaticDrive
from pneuopt.models.pneumatic.gas import GAS_CONSTANT
from pneuopt.models.pneumatic.valve import Port
from pneuopt.quantities.parameters import Quantity, without_prefix
from pneuopt.quantities.trajectories import Trajectory

AREAS = np.pi / 4 * 0.032**2, np.pi / 4 * (0.032**2 - 0.012**2)


def books(drive: PneumaticDrive) -> System:
    """The drive with what crosses its border, integrated: mass into each chamber [kg], energy into the whole [J]."""
    own = drive.system()
    ledger = tuple(
        Quantity(n, unit, s) for n, unit, s in (("fed_a", "kg", 1e-3), ("fed_b", "kg", 1e-3), ("energy", "J", 10))
    )
    thermal = isinstance(drive.chamber, Thermal)

    def rhs(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:
        xs, ps = (ca.vertcat(*(v[n] for n in order)) for v, order in ((x, names(own.states)), (p, own.parameters)))
        xdot, y = own.ode(t, xs, u["valve_voltage"], ps)
        outside = p["ambient.temperature"]
        ports = [Port(x[f"pressure_{s}"], x[f"temperature_{s}"] if thermal else outside) for s in "ab"]
        borders = [Port(p[n], outside) for n in ("supply.pressure", "ambient.pressure")]
        w = drive.valve.flows(x["valve.spool"], borders[0], borders[1], ports[0], ports[1], without_prefix(p, "valve"))
        leak = piston_leak(ports[0].pressure, ports[1].pressure, p["cylinder.leak"])
        crossing = {"a": (w.supply_a, -w.a_exhaust), "b": (w.supply_b, -w.b_exhaust)}
        fed = {"fed_a": sum(crossing["a"]) + leak, "fed_b": sum(crossing["b"]) - leak}
        c_p, inside = 3.5 * p["gas.constant"], dict(zip("ab", (q.temperature for q in ports), strict=True))
        power = sum(
            (c_p * convection(rate, outside, inside[s]) for s, rates_ in crossing.items() for rate in rates_),
            start=ca.SX(0),
        )
        if thermal:
            power += sum((p["chamber.wall_conductance"] * (outside - q.temperature) for q in ports), start=ca.SX(0))
        a, b = areas(p["cylinder.bore"], p["cylinder.rod"])
        friction = drive.friction.force(x["speed"], {}, {}, without_prefix(p, "friction")).value
        power -= ((a - b) * p["ambient.pressure"] + friction + p["load.force"]) * x["speed"]
        rates_ = {n: xdot[k] for k, n in enumerate(names(own.states))} | fed | {"energy": power}
        return rates_, {n: y[k] for k, n in enumerate(names(own.outputs))}

    states = (*own.states, *ledger)
    return define(states, own.inputs, own.outputs, own.parameters, rhs, rest_hook=own.rest_hook)


@pytest.mark.parametrize("chamber", [Polytropic(), Thermal()], ids=["isothermal", "thermal"])
def test_ten_seconds_leave_no_mass_or_energy_behind(chamber: Polytropic | Thermal) -> None:
    drive = PneumaticDrive(friction=Viscous(), chamber=chamber, cylinder=Cylinder(stops=False))
    thermal = isinstance(chamber, Thermal)
    loop = ClosedLoop(books(drive), PID(limits=False), measured="position")
    p = loop.parameters.with_values({"pid.Kp": 25.0, "load.force": 20.0, "cylinder.leak": 2e-10, "valve.leak": 0.002})
    p = p if thermal else p.with_values({"chamber.exponent": 1.0})
    t = np.linspace(0, 10, 1001)
    wave = Trajectory(t, {"reference": 0.1 + 0.09 * np.sin(2 * np.pi * 1.1 * t)})
    run = simulate(loop, wave, p, initial=loop.initial(p, reference=0.1))
    y = run["position"]
    assert 0 < y.min() < 0.04
    assert 0.16 < y.max() < 0.2
    V = 8e-6 + AREAS[0] * y, 8e-6 + AREAS[1] * (0.2 - y)
    warmth = [run[f"temperature_{s}"] if thermal else 293.15 for s in "ab"]
    for side, volume, temperature in zip("ab", V, warmth, strict=True):
        mass = run[f"pressure_{side}"] * volume / (GAS_CONSTANT * temperature)
        turnover = np.abs(np.diff(run[f"fed_{side}"])).sum()
        assert turnover > 3 * mass.mean()
        assert np.abs(mass - mass[0] - run[f"fed_{side}"]).max() < 1e-11 * turnover  # 1e-13 found
    if thermal:
        inner = sum(run[f"pressure_{s}"] * volume / 0.4 for s, volume in zip("ab", V, strict=True))
        energy = inner + 2.5 * run["speed"] ** 2
        assert np.ptp(energy) > 5.0
        assert np.abs(energy - energy[0] - run["energy"]).max() < 1e-8  # of 177 J that crossed the border


def test_much_wall_is_isothermal_and_none_adiabatic() -> None:
    """The temperature state between the two exponents it stands for, on a closed valve and a moving load."""
    t = np.linspace(0, 0.3, 151)
    held = Trajectory(t, {"valve_voltage": np.zeros_like(t)})
    found = {}
    for label, chamber, values in (
        ("isothermal", Polytropic(), {"chamber.exponent": 1.0}),
        ("much", Thermal(), {"chamber.wall_conductance": 1e3}),
        ("adiabatic", Polytropic(), {"chamber.exponent": 1.4}),
        ("none", Thermal(), {"chamber.wall_conductance": 0.0}),
    ):
        drive = PneumaticDrive(friction=Viscous(), chamber=chamber)
        fixed = {"valve.dead_zone": 0.1, "valve.rounding": 1e-5, "friction.viscous": 5.0}
        p = drive.parameters.with_values({**fixed, **values})
        state = {**drive.rest(p, pressure_b=4e5).states, "speed": 0.3}
        found[label] = simulate(drive.system(), held, p, initial=state)["speed"]
    assert np.abs(found["much"] - found["isothermal"]).max() < 5e-3
    assert np.abs(found["none"] - found["adiabatic"]).max() < 2e-3
    assert np.abs(found["isothermal"] - found["adiabatic"]).max() > 0.05
