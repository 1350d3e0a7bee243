"""The paper's equations (1) to (16) in one chain from hardware, and what that hardware does beside its linear model.

    python problems/paper/paper_physical.py [--json FILE] [--out DIR]

Ye, Wang, Chen (IJRES 3(7), 2015) print eq. (16), 1270.12/(s^2 + 17.5 s + 86.34), and no hardware. The set R25 (rodless,
25 mm, 12 kg) has it at rest. Rows eq*.*: orifices (1, 2), flow coefficients by AD (3, 4), mass balance (5, 6), chambers
(7, 8), linearised (9, 10), force (11), both chambers as one pressure (12, 13), force and speed (14), b0, w0 and zeta0
(15), and (16) once from these formulas, once as the AD linearisation of the whole drive. "P_b = 0", which the paper
assumes, is no legal assumption; what lets the second order stand is K_cb = m K_ca. Equation (15) drops a constant.

Then the nonlinear closed loop beside eq. (16) (rows beside.*), and with LuGre friction (rows friction.*): friction does
not make the overshoot of a P loop, it takes it away; with an integral it does. Rows dither.*: see
paper_dither.py; rows stroke.*, whether mid stroke is the worst position: paper_stroke.py.
"""

import sys
from collections.abc import Mapping
from dataclasses import replace
from math import sqrt
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import casadi as ca
import numpy as np
from scipy import optimize, signal

import pneuopt as po
from pneuopt.plotting import BLUE, GREY, ORANGE, RED, axes_grid, legend_above
from problems.paper import paper_dither, paper_stroke
from problems.shared.arrays import Array, names, parameter_vector
from problems.shared.claims import Claim, arguments, finish, frame
from problems.shared.paper2015 import (
    KAPPA,
    PRINTED_COEFFICIENTS,
    OperatingPoint,
    R,
    constant_term,
    damping,
    leak_rate,
    natural_frequency,
    operating_point,
    second_order,
    spool_gain,
    third_order,
)
from problems.shared.r25 import HALF_TRAVEL, PER_VOLT, TRANSDUCER, Case, linearised, polynomials, simulated

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

REFERENCE_DENSITY = 1.185  # [kg/m^3] ANR, ISO 8778: 100 kPa, 20 degC, 65 % humidity
CRITICAL_RATIO = (2 / (KAPPA + 1)) ** (KAPPA / (KAPPA - 1))  # where the orifice chokes
SUPPLY, EXHAUST, WARM = 6e5, 1.01325e5, 293.15  # [Pa], [Pa], [K]
DISCHARGE, GRADIENT, ROUNDING = 0.7, 1.5472759716e-2, 8.1499939196e-5  # C_d, W [m], edge rounding [m]
SIZES = {0.1: 0.0002, 1.0: 0.013, 5.0: 0.13}  # [V] and the deviation from eq. (16), of the reference
OTHER_GRADIENT = 1.29837692e-2  # W [m] of both sets below
SHORT_HOSE = dict.fromkeys(("cylinder.dead_volume_a", "cylinder.dead_volume_b"), 1e-4)  # [m^3]
AS_PRINTED = {"load.mass": 10.95905345, "friction.viscous": 184.108273, "valve.rounding": 7.5e-2, **SHORT_HOSE}
LEAK_FREE = {"load.mass": 10.069647123928888, "friction.viscous": 176.21882466875553, "valve.rounding": 1e-6}


def main() -> "pd.DataFrame":
    chain = [*_orifices(), *_coefficients(), *_balances(), *_linear_chambers(), *_one_pressure(), *_equation_15()]
    return frame([*chain, *_equation_16(), *_alternatives(), *_beside(), *_friction(), *_parts()])


def figures() -> "Mapping[str, Figure]":
    return {
        "paper_physical_steps": _draw_sizes(),
        "paper_physical_friction": _draw_friction(),
        "paper_physical_dither": paper_dither.figure(),
        "paper_physical_stroke": paper_stroke.figure(),
    }


def _parts() -> list[Claim]:
    return [*paper_stroke.claims(), *paper_dither.claims()]


def near(name: str, value: float, reference: float, relative: float, unit: str = "1") -> Claim:
    """Held to the reference within a relative accuracy."""
    return Claim(name, value, unit, reference, f"{reference:.7g} +- {abs(reference) * relative:.0e}")


def printed_flow(high: float, low: float) -> float:
    """Equations (1), (2) per opening, as printed and without any rounding [kg/(s m)]."""
    r = max(low / high, CRITICAL_RATIO)
    rest = sqrt(2 * KAPPA / (R * (KAPPA - 1))) * sqrt(r ** (2 / KAPPA) - r ** ((KAPPA + 1) / KAPPA))
    return DISCHARGE * GRADIENT * high / sqrt(WARM) * rest


def smooth_flow(high: float, low: float) -> float:
    """The same of the drive's smooth kernel."""
    drive, p = po.catalog.r25()
    rounding = type(drive.valve.smoothing)()  # the default one, not the sharp one of R25
    scale = p.value("valve.conductance") * REFERENCE_DENSITY / HALF_TRAVEL
    return scale * float(drive.valve.law.flow(ca.SX(high), ca.SX(low), {}, rounding))


def _orifices() -> list[Claim]:
    """(1) inlet and (2) outlet, 0.5 mm open [g/s]."""
    cases = {
        "eq1.inlet": (SUPPLY, 4.84457876e5),
        "eq1.inlet_choked": (SUPPLY, 2e5),
        "eq2.outlet": (1.5e5, EXHAUST),
        "eq2.outlet_choked": (4.84457876e5, EXHAUST),
    }
    return [near(n, 0.5 * smooth_flow(*at), 0.5 * printed_flow(*at), 3e-4, "g/s") for n, at in cases.items()]


def _coefficients() -> list[Claim]:
    """(3), (4) at the null by AD; and what the unrounded (1), (2) make of (16) by central differences."""
    q = operating_point(*po.catalog.r25(), half_travel=HALF_TRAVEL)

    def mass(x: float, p: float) -> float:
        opening = (x + sqrt(x**2 + ROUNDING**2)) / 2
        return opening * printed_flow(SUPPLY, p) - (opening - x) * printed_flow(p, EXHAUST)

    null = float(optimize.brentq(lambda p: mass(0.0, p), 2e5, 5.9e5, xtol=1e-3))
    K_m, K_c = (mass(1e-7, null) - mass(-1e-7, null)) / 2e-7, (mass(0, null - 10) - mass(0, null + 10)) / 20
    top, bottom = second_order(OperatingPoint(K_m, K_m, K_c, K_c, p_ai=null))
    return [
        near("eq3.null_pressure", q.p_ai / 1e5, 4.84457876, 1e-6, "bar(a)"),
        near("eq3.K_ma", q.K_ma, 12.38563, 1e-6, "kg/s/m"),
        near("eq3.K_ca", 1e9 * q.K_ca, 2.659321, 1e-6, "mg/sbar"),
        near("eq4.K_mb", q.K_mb, 12.38563, 1e-6, "kg/s/m"),
        near("eq4.K_cb", 1e9 * q.K_cb, 2.659321, 1e-6, "mg/sbar"),
        near("eq3_4.unrounded.s", bottom[1], 17.50012, 1e-6, "1/s"),
        near("eq3_4.unrounded.constant", bottom[2], 86.3445, 1e-6, "1/s^2"),
        near("eq3_4.unrounded.gain", top[0] * PER_VOLT * TRANSDUCER, 1270.166, 1e-6),
    ]


def _balances() -> list[Claim]:
    """(5) to (8) in motion, off the centre: the rates of the ODE against the flows, relative."""
    drive, p = po.catalog.r25()
    state, voltage = {"position": 0.3, "speed": 0.4, "pressure_a": 4.4e5, "pressure_b": 4.0e5}, 1.7
    x, travel = [state[n] for n in names(drive.states)], voltage * PER_VOLT
    rates = np.array(drive.system().ode(0, x, [voltage], parameter_vector(p, p))[0]).ravel()
    rows, worst = [], 0.0
    for side, sign, number in (("a", 1, 7), ("b", -1, 8)):
        pressure, pressure_rate = state[f"pressure_{side}"], rates[names(drive.states).index(f"pressure_{side}")]
        into, out = ((sign * way * travel + sqrt(travel**2 + ROUNDING**2)) / 2 for way in (1, -1))
        flow = into * smooth_flow(SUPPLY, pressure) - out * smooth_flow(pressure, EXHAUST)  # (5)
        area = sign * OperatingPoint().A_a
        volume = p.value(f"cylinder.dead_volume_{side}") + area * (state["position"] - (side == "b"))
        swept, filled = area * state["speed"] * pressure, volume * pressure_rate
        warming = (KAPPA - 1) / KAPPA * filled  # isentropic
        worst = max(worst, abs((swept + filled - warming) / (R * WARM) / flow - 1))  # (6)
        chamber = (KAPPA * swept + filled) / (KAPPA * R * WARM)  # (7), (8)
        rows.append(Claim(f"eq{number}.residual", abs(chamber / flow - 1), "1", None, "<= 1e-9"))
    return [Claim("eq5_6.residual", worst, "1", None, "<= 1e-9"), *rows]


def _linear_chambers() -> list[Claim]:
    """(9), (10), (11): entries of the AD matrix against the paper's coefficients."""
    found, q = linearised(po.catalog.r25()), OperatingPoint()
    v, a, b = (found.states.index(n) for n in ("speed", "pressure_a", "pressure_b"))
    stiff = KAPPA * q.p_ai * q.A_a / q.V_0a
    return [
        near("eq9.swept", -found.A[a, v] / 1e5, stiff / 1e5, 1e-6, "bar/m"),
        near("eq10.swept", found.A[b, v] / 1e5, stiff / q.m / 1e5, 1e-6, "bar/m"),
        near("eq11.area_a", 1e4 * q.M_L * found.A[v, a], 4.908739, 1e-6, "cm^2"),
        near("eq11.area_b", -1e4 * q.M_L * found.A[v, b], 4.908739, 1e-6, "cm^2"),
        near("eq11.k_v", -q.M_L * found.A[v, v], 200.0, 1e-8, "N s/m"),
    ]


def _one_pressure() -> list[Claim]:
    """(12), (13): what p_b still does; (14): speed over p_La. And where the third order collapses, where not."""
    found, q = linearised(po.catalog.r25()), operating_point(*po.catalog.r25(), half_travel=HALF_TRAVEL)
    s = 5j  # [rad/s]
    state = np.linalg.solve(s * np.eye(3) - found.A, found.B).ravel()
    v, a, b = (state[found.states.index(n)] for n in ("speed", "pressure_a", "pressure_b"))
    rod = replace(OperatingPoint(), n=0.86)
    matched, off = replace(rod, m=1.2, K_cb=1.2 * rod.K_ca), replace(rod, K_cb=1.3 * rod.K_ca)
    return [
        Claim("eq12.p_b_left", abs(q.K_cb * q.n / q.m - q.n * q.K_ca) / q.K_ca, "1", None, "<= 1e-8"),
        Claim("eq12.p_b_over_p_a", float(abs(b / a)), "1", 0.0, ">= 0.9"),
        near("eq13.pole", -leak_rate(q), -0.83333, 1e-5, "1/s"),
        near("eq14.speed_per_bar", 1e5 * abs(v / (a - q.n * b)), 1e5 * q.A_a / abs(q.M_L * s + q.k_v), 1e-6, "m/s"),
        Claim("collapse.K_cb_is_m_K_ca", _apart(matched), "1", None, "<= 1e-9"),
        Claim("collapse.rod_K_cb_1.3_K_ca", _apart(off), "1", None, ">= 0.01"),
    ]


def _apart(point: OperatingPoint) -> float:
    """Largest relative difference between second and third order over 0.1 to 100 rad/s."""
    s = 1j * np.geomspace(0.1, 100, 200)
    (top, bottom), (top_3, bottom_3) = second_order(point), third_order(point)
    ratio = np.polyval(top, s) * np.polyval(bottom_3, s) / (np.polyval(bottom, s) * np.polyval(top_3, s))
    return float(np.max(np.abs(ratio - 1)))


def _equation_15() -> list[Claim]:
    q = operating_point(*po.catalog.r25(), half_travel=HALF_TRAVEL)
    w0 = natural_frequency(q)
    return [
        near("eq15.b0", spool_gain(q), 1270.12 / (PER_VOLT * TRANSDUCER * w0**2), 1e-6, "1/s"),
        Claim("eq15.omega0", w0, "rad/s", None, "8.512 +- 0.0005"),
        near("eq15.zeta0", damping(q), 17.5 / (2 * w0), 1e-6),
        Claim("eq15.constant_printed", w0**2, "1/s^2", 72.45, "72.45 +- 0.005"),
        near("eq15.constant_true", constant_term(q), 86.34, 1e-7, "1/s^2"),
        Claim("eq15.gain_error", 100 * (constant_term(q) / w0**2 - 1), "%", 19, "19 +- 0.5"),
    ]


def _equation_16() -> list[Claim]:
    """(16) from the formulas, and by AD of the whole nonlinear drive; its third pole is its zero."""
    top, bottom = second_order(operating_point(*po.catalog.r25(), half_travel=HALF_TRAVEL))
    formulas = (bottom[1], bottom[2], top[0] * PER_VOLT * TRANSDUCER)
    *by_ad, pole, zero = polynomials(po.catalog.r25())
    rows, printed = [], (PRINTED_COEFFICIENTS[1], PRINTED_COEFFICIENTS[2], PRINTED_COEFFICIENTS[0])
    for label, values in (("formulas", formulas), ("ad", by_ad)):
        for name, value, reference in zip(("s", "constant", "gain"), values, printed, strict=True):
            rows.append(near(f"eq16.{label}.{name}", value, reference, 1e-9))
    return [
        *rows,
        near("eq16.ad.third_pole", pole, -0.83333, 1e-5, "1/s"),
        near("eq16.ad.zero", zero, -0.83333, 1e-5, "1/s"),
        Claim("eq16.gain", PRINTED_COEFFICIENTS[0] / PRINTED_COEFFICIENTS[2], "1", 14.711, "14.711 +- 0.0005"),
    ]


def _alternatives() -> list[Claim]:
    """Other hardware: eq. (15) taken exactly as printed, and a valve that does not leak (printed = true there)."""
    printed, tight = (_other(values) for values in (AS_PRINTED, LEAK_FREE))
    q = operating_point(*printed, half_travel=HALF_TRAVEL)
    top, bottom = second_order(q, dropped_constant=True)
    w = 1j * np.geomspace(1, 100, 50)
    found = linearised(tight)
    ad = [TRANSDUCER * (found.C @ np.linalg.solve(s * np.eye(3) - found.A, found.B)).item() for s in w]
    line = PRINTED_COEFFICIENTS[0] / np.polyval([1.0, *PRINTED_COEFFICIENTS[1:]], w)
    return [
        near("printed_set.eq15.s", bottom[1], 17.5, 1e-7),
        near("printed_set.eq15.constant", bottom[2], 86.34, 1e-7),
        near("printed_set.eq15.gain", top[0] * PER_VOLT * TRANSDUCER, 1270.12, 1e-7),
        Claim("printed_set.true_constant", polynomials(printed)[1], "1/s^2", 98.1, "98.1 +- 0.05"),
        Claim("leak_free_set.off_eq16", float(np.max(np.abs(ad / line - 1))), "1", None, "<= 1e-4"),
    ]


def _other(values: Mapping[str, float]) -> po.catalog.DriveSet:
    drive, p = po.catalog.r25()
    return drive, p.with_values(
        {**values, "valve.conductance": p.value("valve.conductance") * OTHER_GRADIENT / GRADIENT}
    )


def _line(case: Case) -> Array:
    """Eq. (16) under the same gains, from polynomials [V]."""
    gain, rate, constant = PRINTED_COEFFICIENTS
    q = {"Kp": 0.0, "Ki": 0.0, "Kd": 0.0, **case.gains}
    lag, s = [q["Tf"], 1.0], [1.0, 0.0]
    top = np.polyadd(np.polymul([q["Kp"], q["Ki"]], lag), [q["Kd"], 0.0, 0.0])
    closed = np.polyadd(np.polymul([1.0, rate, constant], np.polymul(s, lag)), gain * top)
    return case.volts * np.asarray(signal.step((gain * top, closed), T=simulated(case).t)[1])


def _beside() -> list[Claim]:
    """Largest distance of the nonlinear drive's step response from that of eq. (16), as a share of the step."""
    rows = []
    for label, pid in (("p", False), ("pid", True)):
        for volts, reference in SIZES.items():
            case = Case(volts, pid)
            deviation = float(np.abs(simulated(case).volts - _line(case)).max()) / volts
            bound = "" if pid else f"{reference:g} +- {0.05 * reference:.1g}"
            rows.append(Claim(f"beside.{label}.{volts:g}V", deviation, "1", None if pid else reference, bound))
    peaks = simulated(Case(1.0)).volts.max(), _line(Case(1.0)).max()
    return [
        *rows,
        Claim("beside.p.1V.peak", peaks[0], "V", 1.3613, "1.3613 +- 1e-4"),
        Claim("beside.p.1V.peak_eq16", peaks[1], "V", 1.3706, "1.3706 +- 1e-4"),
    ]


def _friction() -> list[Claim]:
    """LuGre 25/40 N: P loses overshoot and gains error; the paper's PID overshoots, and hunts at a small reference."""
    p, rough = (simulated(Case(1.0, lugre=lugre)).volts for lugre in (False, True))
    pid, rough_pid = (simulated(Case(1.0, True, lugre)).volts for lugre in (False, True))
    hunting = simulated(paper_dither.HUNTING)
    late = hunting.volts[hunting.t > paper_dither.LATE] / paper_dither.HUNTING.volts
    return [
        Claim("friction.p.overshoot_without", 100 * (p.max() - 1), "%", 36, "36.1 +- 0.1"),
        Claim("friction.p.overshoot", 100 * (rough.max() - 1), "%", 9.25, "9.25 +- 0.02"),
        Claim("friction.p.mean_1_to_2s", float(rough[2000:].mean()), "V", 0.9110, "0.9110 +- 1e-4"),
        Claim("friction.p.error_without", 100 * float(1 - p[2000:].mean()), "%", 6.4, "6.4 +- 0.1"),
        Claim("friction.p.error", 100 * float(1 - rough[2000:].mean()), "%", 8.9, "8.9 +- 0.05"),
        Claim("friction.pid.overshoot_without", 100 * (pid.max() - 1), "%", 1.4, "1.4 +- 0.2"),
        Claim("friction.pid.overshoot", 100 * (rough_pid.max() - 1), "%", 40, "40.2 +- 0.2"),
        Claim("friction.pid.0.2V.lowest", float(late.min()), "1", None, "<= 0.2"),
        Claim("friction.pid.0.2V.highest", float(late.max()), "1", None, ">= 1.9"),
    ]


def _draw_sizes() -> "Figure":
    picture, grid = axes_grid(2, 3, (2.6, 1.3), sharex="col")
    for column, volts in enumerate(SIZES):
        top, bottom = grid[0][column], grid[1][column]
        for pid, colour, label in ((False, BLUE, "unit P"), (True, ORANGE, "the paper's PID")):
            case = Case(volts, pid)
            run, line = simulated(case), _line(case)
            top.plot(run.t, run.volts / volts, color=colour, lw=1.4, label=f"R25, {label}")
            top.plot(run.t, line / volts, color=colour, lw=1, ls=":", label=f"eq. (16), {label}")
            bottom.plot(run.t, (run.volts - line) / volts, color=colour, lw=1)
        top.axhline(1, color=GREY, lw=0.8)
        top.set(title=f"{volts:g} V, {1e3 * volts / TRANSDUCER:g} mm/s", ylim=(0, 1.5), xlim=(0, 1.2))
        bottom.set(xlabel="time [s]")
    grid[0][0].set_ylabel("speed / reference")
    grid[1][0].set_ylabel("R25 - eq. (16)")
    legend_above(picture, grid[0][0])
    return picture


def _draw_friction() -> "Figure":
    picture, ((left, middle, right),) = axes_grid(1, 3, (3.0,))
    _compare(left, "unit P, 1 V", Case(1.0), 1.5)
    _compare(middle, "the paper's PID, 1 V", Case(1.0, True), 2.0)
    _compare(right, "the paper's PID, 0.2 V (10 mm/s)", replace(paper_dither.HUNTING, lugre=False), 6.0)
    left.set_ylabel("speed / reference")
    legend_above(picture, left)
    return picture


def _compare(axes: "Axes", title: str, case: Case, end: float) -> None:
    for lugre, colour, label in ((False, BLUE, "viscous friction only"), (True, RED, "with LuGre friction, 25/40 N")):
        run = simulated(replace(case, lugre=lugre))
        over = 100 * (run.volts.max() / case.volts - 1)
        axes.plot(run.t, run.volts / case.volts, color=colour, lw=1.2, label=label)
        y, where = 0.92 - 0.08 * lugre, axes.transAxes
        axes.text(0.97, y, f"{over:.1f} % over", color=colour, transform=where, ha="right", fontsize=8)
    axes.axhline(1, color=GREY, lw=0.8)
    axes.set(title=title, xlabel="time [s]", xlim=(0, end), ylim=(0, None))


if __name__ == "__main__":
    options = arguments(__doc__).parse_args()
    sys.exit(finish(main(), options, figures))
