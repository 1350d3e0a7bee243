"""Gains of P32's cascade by rules: ultimate cycles of the speed's loop, and then of the position's loop around it.

A rule asks for the gain at which a proportional controller lets the loop oscillate, and for the period of that. The
loop is the linearised one, with its sampling, its delay and the encoder's filter, of the nominal plant in the steady
motions of the margins; it counts where it oscillates at the least gain. The speed's PI has

* after J. G. Ziegler & N. B. Nichols, Optimum settings for automatic controllers, Trans. ASME 64 (1942) 759-768:
  ``Kp = .45 K_u, Ti = T_u/1.2``;
* after B. D. Tyreus & W. L. Luyben, Tuning PI controllers for integrator/dead time processes, Ind. Eng. Chem. Res. 31
  (1992) 2625-2628, for more damping: ``Kp = K_u/3.2, Ti = 2.2 T_u``;

and the position's P, with the speed's loop closed, the ``.5 K_u`` of Ziegler and Nichols. The feedforward of the speed
is what the valve needs, the mean of both ways, the inverse's width the valve's dead zone. Kessler's optima, and several
equal poles, are for speed loops with real poles: the air gives this one a pair of little damping, which no PI raises.
"""

from collections.abc import Mapping

import numpy as np

from problems.shared.arrays import Array
from problems.shared.p32 import DEAD_ZONE, SPEEDS, STROKE, drive
from problems.shared.p32_margins import Margins
from problems.shared.p32_structures import STRUCTURES

# Kp over the ultimate gain, and Ti over the ultimate period.
RULES: Mapping[str, tuple[float, float]] = {"ziegler_nichols": (0.45, 1 / 1.2), "tyreus_luyben": (1 / 3.2, 2.2)}
RULED_GAINS = ("pid.Kp", "pid.Ki", "position_loop.Kp")  # what a rule gives
OUTER = 0.5  # the position's gain over the ultimate one
OMEGA = np.geomspace(1.0, 1500.0, 2000)  # [rad/s] on which the phase's crossings are sought
FILTER = 1e-3  # [s] of the encoder's speed, the default
PLAIN = {"pid.Kp": 1.0, "pid.Ki": 0.0, "position_loop.Kp": 0.0, "sensor.filter": FILTER}


def cascade_by_rule(rule: str, others: Mapping[str, float]) -> dict[str, float]:
    """Gains of the cascade by one of `RULES`; what no rule knows is given: reference and smoothing."""
    structure, (share, periods) = STRUCTURES["cascade"], RULES[rule]
    margins = Margins(structure.loop(), structure.parameters(), [{}])
    gain, omega = ultimate_cycle(margins.response(PLAIN, OMEGA))
    Kp = share * gain
    found = PLAIN | {"pid.Kp": Kp, "pid.Ki": Kp * omega / (2 * np.pi * periods)}
    alone, both = (margins.response(found | {"position_loop.Kp": K}, OMEGA) for K in (0.0, 1.0))
    found["position_loop.Kp"] = OUTER * ultimate_cycle((both - alone) / (1 + alone))[0]
    ahead = {"motion_feedforward.speed": command_per_speed(), "dead_zone_inverse.width": DEAD_ZONE}
    return {**others, **found, **ahead}


def ultimate_cycle(response: Array) -> tuple[float, float]:
    """The least gain at which one of some loops oscillates, and its frequency [rad/s]; a row of L(jw) on OMEGA each."""
    real, imag = response.real, response.imag
    row, k = np.nonzero((imag[:, :-1] * imag[:, 1:] <= 0) & (real[:, :-1] < 0))
    at = imag[row, k] / (imag[row, k] - imag[row, k + 1])
    crossing = real[row, k] + at * (real[row, k + 1] - real[row, k])
    first = int(np.argmin(crossing))
    return float(-1 / crossing[first]), float(OMEGA[k[first]] + at[first] * (OMEGA[k[first] + 1] - OMEGA[k[first]]))


def command_per_speed() -> float:
    """The valve's command per speed of a steady motion in the middle of the stroke, mean of both ways [V s/m]."""
    own, given = drive()

    def command(speed: float) -> float:
        p = own.parameters.with_values({n: given.value(n) for n in own.parameters})
        p = p.with_values({"friction.direction": float(np.sign(speed))})
        return own.rest(p, position=STROKE / 2, speed=speed).inputs["valve_voltage"]

    slow, fast = SPEEDS
    return sum(sign * (command(sign * fast) - command(sign * slow)) for sign in (1, -1)) / (2 * (fast - slow))
