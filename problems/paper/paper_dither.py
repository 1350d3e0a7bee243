"""Why 0.001 V at 1000 rad/s does nothing, and what dither on a valve really changes: part of paper_physical.py.

Per volt of command, by AD linearisation of R25: the force on a stuck piston, speed and travel of a free one, and the
volts needed for 40 N (its static friction) and for a speed of 40 mm/s (twice the Stribeck velocity, where dither on the
speed would make friction monotone). The valve has 5 V. Then by simulation: the change that the paper's chatter makes;
a lap that 1 V and 4 V open on average, which costs gain and overshoot; and hunting at 10 mm/s, which 4 V at 1000 rad/s
do not end, and 10 Hz does, for the average. Rows verdict.*: what `judge_dither` says of the paper's chatter with the
paper's PID, 1 useful, 0 useless, -1 harmful, and of 4 V at the same frequency.
"""

from dataclasses import dataclass, replace
from math import pi
from typing import TYPE_CHECKING

import numpy as np

import pneuopt as po
from pneuopt.plotting import BLUE, GREY, ORANGE, RED, axes_grid
from problems.shared.claims import VERDICT_SCORES, Claim
from problems.shared.r25 import CLIP, PAPERS_PID, TRANSDUCER, Case, averaged, lagging, linearised, simulated

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STATIC, SPEED = 40.0, 0.04  # [N], [m/s]
PAPERS, AT = 1e-3, 1000.0  # [V], [rad/s]
# Worked out apart from this package, by rad/s: |F| [N/V], |v| [mm/s/V], |y| [um/V], volts for 40 N, volts for 40 mm/s.
TABLE = {
    62.8: (12.1, 16.0, 250.0, 3.3, 2.5),
    125.7: (6.1, 4.0, 32.0, 6.6, 10.0),
    628.0: (1.21, 0.16, 0.26, 33.0, 248.0),
    1000.0: (0.76, 0.064, 0.064, 52.0, 630.0),
}
HUNTING, LATE = Case(0.2, pid=True, lugre=True, seconds=6.0), 3.0  # 10 mm/s; [s] from which it is measured


@dataclass(frozen=True)
class Moved:
    """What one volt of sine on the command moves: force on a stuck piston [N], speed [m/s] and travel [m] of a free."""

    force: float
    speed: float
    travel: float

    @property
    def row(self) -> tuple[float, ...]:
        """As in `TABLE`."""
        return self.force, 1e3 * self.speed, 1e6 * self.travel, STATIC / self.force, SPEED / self.speed


def claims() -> list[Claim]:
    return [*_table(), *_papers_chatter(), *_opened_lap(), *_hunting(), *_verdicts()]


def moved(found: po.Linearisation, omega: float, mass: float) -> Moved:
    """One volt at `omega` [rad/s]; a stuck piston's force is what the chambers would accelerate it with."""
    speed = found.states.index("speed")
    others = [k for k in range(len(found.states)) if k != speed]
    stuck = np.linalg.solve(1j * omega * np.eye(len(others)) - found.A[np.ix_(others, others)], found.B[others])
    free = np.linalg.solve(1j * omega * np.eye(len(found.A)) - found.A, found.B)[speed]
    force = mass * abs((found.A[[speed]][:, others] @ stuck).item())
    return Moved(force, abs(free.item()), abs(free.item()) / omega)


def _table() -> list[Claim]:
    columns = {"force": "N/V", "speed": "mm/sV", "travel": "um/V", "for_40N": "V", "for_40mm_s": "V"}
    rigid, slow, mass = (
        linearised(po.catalog.r25()),
        linearised(lagging(po.Viscous())),
        po.catalog.r25()[1].value("load.mass"),
    )
    rows = []
    for omega, references in TABLE.items():
        values = moved(rigid, omega, mass).row
        for (name, unit), value, reference in zip(columns.items(), values, references, strict=True):
            bound = f"{reference:g} +- {0.02 * reference:.2g}"
            rows.append(Claim(f"dither.{omega:g}.{name}", value, unit, reference, bound))
    for omega in TABLE:
        at = moved(slow, omega, mass)
        last = omega == AT
        rows.append(
            Claim(f"dither.{omega:g}.spool.force", at.force, "N/V", 0.28 if last else None, "0.28 +- 0.01" * last)
        )
        rows.append(Claim(f"dither.{omega:g}.spool.for_40N", STATIC / at.force, "V"))
        rows.append(Claim(f"dither.{omega:g}.spool.for_40mm_s", SPEED / at.speed, "V"))
    return rows


def _papers_chatter() -> list[Claim]:
    """0.001 V at 1000 rad/s on R25's step of 1 V: what its sine moves, and the change of the whole response."""
    at = moved(linearised(po.catalog.r25()), AT, po.catalog.r25()[1].value("load.mass"))
    rows = [
        Claim("chatter.force", 1e3 * PAPERS * at.force, "mN", 0.8, "0.76 +- 0.02"),
        Claim("chatter.speed", PAPERS * at.speed, "m/s", 6e-8, "6.4e-8 +- 1e-9"),
        Claim("chatter.travel", PAPERS * at.travel, "m", 6e-11, "6.4e-11 +- 1e-12"),
    ]
    for name, case in {"viscous": Case(1.0), "lugre": Case(1.0, lugre=True)}.items():
        plain, chattering = (simulated(replace(case, amplitude=a), 1e-10) for a in (0.0, PAPERS))
        change = np.abs(chattering.volts - plain.volts)
        late = float(change[plain.t > 1].max())
        rows.append(Claim(f"chatter.{name}.change", float(change.max()), "V", None, "<= 3e-5"))
        rows.append(Claim(f"chatter.{name}.change_speed", float(change.max()) / TRANSDUCER, "m/s", None, "<= 1.5e-6"))
        rows.append(Claim(f"chatter.{name}.change_late", late, "V", 1.3e-6, "<= 1.35e-6"))
    return rows


def _opened_lap() -> list[Claim]:
    """The mean after 1.5 s and the peak of unit P at 1 V, without friction."""
    rows = []
    for volts, mean, peak in ((0.0, 0.9364, 1.3613), (1.0, 0.9277, None), (4.0, 0.887, 1.235)):
        run = simulated(Case(1.0, amplitude=volts))
        late = float(run.volts[run.t > 1.5].mean())
        rows.append(Claim(f"lap.{volts:g}V.mean", late, "V", mean, f"{mean:g} +- 5e-4"))
        bound = f"{peak:g} +- 1e-3" if peak else ""
        rows.append(Claim(f"lap.{volts:g}V.peak", float(run.volts.max()), "V", peak, bound))
    return rows


def _hunting() -> list[Claim]:
    """The paper's PID at 10 mm/s under LuGre friction: deviation of the speed from 3 s on, as a share of the reference.

    The average is that over one period of the dither; the ripple is what is left, peak to peak.
    """
    rows = []
    kinds = {"none": (0.0, AT, ">= 0.5"), "4V_1000": (4.0, AT, ">= 0.3"), "0.6V_10Hz": (0.6, 20 * pi, "<= 0.01")}
    for name, (amplitude, frequency, bound) in kinds.items():
        run = simulated(replace(HUNTING, amplitude=amplitude, frequency=frequency))
        speed = run.volts / TRANSDUCER
        smooth = averaged(run.t, speed, 2 * pi / frequency)
        late, target = (run.t > LATE) & (run.t < run.t[-1] - 2 * pi / frequency), HUNTING.volts / TRANSDUCER
        rows.append(Claim(f"hunting.{name}.deviation", float(smooth[late].std()) / target, "1", None, bound))
        slow, ripple = frequency != AT, 1e3 * float(np.ptp((speed - smooth)[late]))
        rows.append(Claim(f"hunting.{name}.ripple", ripple, "mm/s", 19 if slow else None, "19 +- 1.5" * slow))
    return rows


def _verdicts() -> list[Claim]:
    """On the paper's step of 1 V under LuGre friction, the same gains with and without."""
    drive, p = po.catalog.r25(lugre=True)
    loop = po.ClosedLoop(drive.system(), po.PID(), po.Dither(AT / (2 * pi)), measured="speed")
    gains = {f"pid.{n}": v if n == "Tf" else TRANSDUCER * v for n, v in PAPERS_PID.items()}
    given = (loop.parameters | p).with_values({**gains, "pid.lower": -CLIP, "pid.upper": CLIP})
    rows = []
    for name, volts in {"paper": PAPERS, "4V": 4.0}.items():
        found = po.judge_dither(loop, po.Step(1 / TRANSDUCER), given.with_values({"dither.amplitude": volts}))
        bound = "0 +- 0" if name == "paper" else ""
        rows.append(Claim(f"verdict.{name}", VERDICT_SCORES[found.usefulness.name], "1", None, bound))
        rows.append(Claim(f"verdict.{name}.force", found.effect.force, "N", STATIC))
        before, after = (float(found.table[c]["Overshoot"]) for c in ("without", "with"))
        rows.append(Claim(f"verdict.{name}.overshoot", after, "%", before))
    return rows


def figure() -> "Figure":
    picture, ((amount, needed),) = axes_grid(1, 2, (3.6,))
    omega, mass = np.geomspace(10, 3000, 200), po.catalog.r25()[1].value("load.mass")
    for given, style, label in ((po.catalog.r25(), "-", "rigid spool"), (lagging(po.Viscous()), "--", "100 Hz spool")):
        found = linearised(given)
        rows = np.array([moved(found, w, mass).row for w in omega])
        curves = ((0, 3, BLUE, "force on a stuck piston [N/V]", "40 N"), (1, 4, ORANGE, "speed [mm/s/V]", "40 mm/s"))
        for one, volts, colour, what, goal in curves:
            amount.loglog(omega, rows[:, one], style, color=colour, label=what if style == "-" else None)
            needed.loglog(omega, rows[:, volts], style, color=colour, label=f"for {goal}" if style == "-" else None)
        amount.plot([], [], style, color=GREY, label=label)
    _mark(amount, needed)
    return picture


def _mark(amount: "Axes", needed: "Axes") -> None:
    needed.axhline(CLIP, color=GREY, lw=1)
    needed.text(11, 1.15 * CLIP, "all that the valve has, 5 V", fontsize=8, color=GREY)
    needed.plot([AT], [PAPERS], "o", color=RED)
    needed.annotate("the paper's 0.001 V", (AT, PAPERS), (-8, 8), textcoords="offset points", ha="right", color=RED)
    needed.set(xlabel="frequency [rad/s]", ylabel="amplitude needed [V]", ylim=(3e-4, 1e5))
    for axes in (amount, needed):
        axes.legend(frameon=False, fontsize=8, loc="lower left" if axes is amount else "upper left")
        axes.axvline(AT, color=RED, lw=0.8, ls=":")
    amount.set(xlabel="frequency [rad/s]", ylabel="moved by one volt")
