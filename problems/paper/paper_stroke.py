"""Is mid stroke the worst position, as the paper says after its reference 5? Part of paper_physical.py.

Rows stroke.*: over R25's stroke the air spring is softest in the middle: natural frequency 9.29 rad/s there and 11.15
rad/s at 10 and 90 %, by AD linearisation and from equations (3), (4), (9) to (11) alone. So a drive answers slowest
there. But for the paper's own loops it is the best position, not the worst: the gain at high frequency, b0 w0^2, grows
towards the ends faster than the damping. So under unit feedback the phase margin falls from 28.5 deg to 25.4 deg at 10
and 90 % and the overshoot grows from 37 to 41 %, and with the PID of Table 2, row 1#, on half the loop gain a step
takes 0.60 s to 2 % there, against 0.35 s at mid stroke. Gains found at mid stroke are not on the safe side of the
others.
"""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from scipy import optimize

import pneuopt as po
from pneuopt.plotting import BLUE, GREY, ORANGE, axes_grid
from problems.shared.claims import Claim
from problems.shared.paper2015 import operating_point, third_order
from problems.shared.r25 import CLIP, HALF_TRAVEL, PAPERS_PID, TRANSDUCER, UNIT_FEEDBACK, linearised

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PLACES = (0.1, 0.5, 0.9)  # of the stroke
SMALL = 0.1  # [V] of a step that stays with the linear model
ACCURACY = {"frequency": 5e-3, "phase_margin": 0.05, "overshoot": 0.2, "settling": 5e-3}
UNITS = {"frequency": "rad/s", "phase_margin": "deg", "overshoot": "%", "settling": "s"}
FOUND = {
    0.1: {"frequency": 11.15, "phase_margin": 25.35, "overshoot": 41.0, "settling": 0.600},
    0.5: {"frequency": 9.292, "phase_margin": 28.54, "overshoot": 37.05, "settling": 0.348},
    0.9: {"frequency": 11.15, "phase_margin": 25.35, "overshoot": 41.0, "settling": 0.598},
}
HALVED = {n: v if n == "Tf" else v / 2 for n, v in PAPERS_PID.items()}


def claims() -> list[Claim]:
    rows = []
    for place in PLACES:
        values = {
            "frequency": frequency(place),
            "phase_margin": phase_margin(place),
            "overshoot": stepped(place, UNIT_FEEDBACK)["Overshoot"],
            "settling": stepped(place, HALVED)["SettlingTime"],
        }
        for name, value in values.items():
            expected = FOUND[place][name]
            bound = f"{expected:g} +- {ACCURACY[name]:g}"
            rows.append(Claim(f"stroke.{100 * place:.0f}.{name}", value, UNITS[name], expected, bound))
    apart = max(abs(frequency(place) / chain_frequency(place) - 1) for place in PLACES)
    slowest = float(optimize.minimize_scalar(frequency, bounds=(0.1, 0.9), options={"xatol": 1e-4}).x)
    return [
        *rows,
        Claim("stroke.chain_apart", apart, "1", None, "<= 1e-6"),
        Claim("stroke.slowest", 100 * slowest, "%", 50, "50 +- 0.1"),
    ]


def at(place: float) -> tuple[po.PneumaticDrive, po.ParameterSet]:
    """R25 at rest at a share of its stroke."""
    drive, p = po.catalog.r25()
    return drive, p.with_values({"cylinder.start": place * p.value("cylinder.stroke")})


def frequency(place: float) -> float:
    """The natural frequency of the piston on its air springs [rad/s]: the pair's, of the drive linearised by AD."""
    return pair_frequency(np.linalg.eigvals(linearised(at(place)).A))


def chain_frequency(place: float) -> float:
    """The same from the paper's equations in the operating point's symbols."""
    return pair_frequency(np.roots(third_order(operating_point(*at(place), half_travel=HALF_TRAVEL))[1]))


def pair_frequency(poles: ArrayLike) -> float:
    """The magnitude of the complex pair among three poles."""
    values = np.asarray(poles, dtype=complex)
    return float(np.abs(values[np.argmax(values.imag)]))


def looped(place: float, gains: dict[str, float]) -> tuple[po.ClosedLoop, po.ParameterSet]:
    """The paper's loop about the drive at a place."""
    drive, p = at(place)
    loop = po.ClosedLoop(drive.system(), po.PID(), measured="speed")
    scaled = {f"pid.{n}": v if n == "Tf" else TRANSDUCER * v for n, v in gains.items()}
    return loop, (loop.parameters | p).with_values({**scaled, "pid.lower": -CLIP, "pid.upper": CLIP})


def phase_margin(place: float) -> float:
    """Of unit feedback [deg]."""
    return po.margins(po.open_loop(*looped(place, UNIT_FEEDBACK))).phase_margin


def stepped(place: float, gains: dict[str, float]) -> dict[str, float]:
    """The metrics of a small step of the nonlinear loop from there."""
    loop, p = looped(place, gains)
    size = SMALL / TRANSDUCER
    run = po.simulate(loop, po.Step(size, horizon=2.0).trajectory(1e-3), p)
    return po.step_metrics(run.t, run["speed"], size, 0.0)


def figure() -> "Figure":
    picture, ((left, right),) = axes_grid(1, 2, (3.0,))
    places = np.linspace(0.02, 0.98, 49)
    left.plot(100 * places, [frequency(k) for k in places], color=BLUE)
    right.plot(100 * places, [phase_margin(k) for k in places], color=ORANGE)
    for axes, function, digits, unit in ((left, frequency, 2, ""), (right, phase_margin, 1, "°")):
        for place in PLACES:
            value = function(place)
            axes.plot([100 * place], [value], "o", color=GREY, ms=5)
            side = (6, 4) if place < 0.9 else (-6, 4)
            axes.annotate(
                f"{value:.{digits}f}{unit}",
                (100 * place, value),
                side if place != 0.5 else (0, 9 if axes is left else -14),
                textcoords="offset points",
                ha="center" if place == 0.5 else "left" if place < 0.5 else "right",
                fontsize=8,
            )
        axes.set(xlabel="piston's place [% of the stroke]", xlim=(0, 100))
    left.set(ylabel="natural frequency [rad/s]", title="The drive answers slowest at mid stroke")
    right.set(ylabel="phase margin, unit feedback [deg]", title="The paper's loop has most margin there")
    return picture
