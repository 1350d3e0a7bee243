"""Twelve plants of Astrom and Hagglund's test batch: does `tune` find the best PI and PIDF, and keep limits exactly?

    python problems/tune/test_batch.py [--plants NAME ...] [--json FILE] [--out DIR]

A load of one at the plant's input; the least IAE with MaxSensitivity and MaxComplementarySensitivity of at most M
= 1.4, 1.6 and 2.0. PI: Kp (1 + 1/(Ti s)); PIDF: Kp (1 + 1/(Ti s) + Td s/(Td s/10 + 1)). The plants are those of K. J.
Astrom, T. Hagglund, Revisiting the Ziegler-Nichols step response method for PID control, J. Process Control 14 (2004)
635-650: lags, right-half-plane zeros, an integrator, an oscillator, and dead times.

The optimum is found by code that shares nothing with pneuopt: frequency responses with the dead time as it is, the
load's response by the inverse Fourier transform, and SciPy's SLSQP from several starts in the logarithms of the gains.
The tuned gains are judged by the same code. Rows *.excess: how far the IAE lies above the optimum; *.room: how far the
larger of Ms and Mt stays below M, where the optimum reaches M; *.above: by how much it exceeds M; *.certified: whether
`tune` certifies its design.
"""

import sys
import time
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, minimize

import pneuopt as po
from problems.shared.arrays import Array
from problems.shared.claims import Claim, arguments, finish, frame

if TYPE_CHECKING:
    import pandas as pd

SENSITIVITIES = (1.4, 1.6, 2.0)
FILTER_RATIO = 10.0  # N of the derivative's filter
PADE_ORDER = 5  # of the plant's dead time, as a file may have it; `tune` has its own, the optimum none
ROOM = 2e-4  # of a limit: as near as four digits of the gains come, 1e-4 but for three of 72
EXCESS = 0.1  # [%] of the IAE over the optimum
# with lags of a twentieth of the dead time the simulated IAE has the approximant's ripple, and so another optimum
RIPPLED, RIPPLED_EXCESS = "late_fast_lags", 0.15
PERIODS = 150.0  # of 1/w180 that a response is simulated for
FREQUENCIES, SAMPLES, RECORDS = 2000, 2**14, 2.0  # of the own code; the record is so many horizons long
DECADES = (-3.5, 2.5)  # about w180, over which peaks are sought


@dataclass(frozen=True)
class Plant:
    """``gain * numerator/denominator * exp(-s late)``, polynomials with the highest power first."""

    name: str
    numerator: tuple[float, ...]
    denominator: tuple[float, ...]
    late: float = 0.0

    def response(self, w: Array) -> NDArray[np.complex128]:
        """P(jw)."""
        s = 1j * w
        return np.asarray(np.polyval(self.numerator, s) / np.polyval(self.denominator, s) * np.exp(-s * self.late))

    @cached_property
    def ultimate(self) -> tuple[float, float]:
        """Frequency at which the phase is -180 degrees [rad/s], and the gain 1/|P| there."""
        w = np.geomspace(1e-3, 1e5, 200_000)
        phase = np.unwrap(np.angle(self.response(w)))
        phase -= 2 * np.pi * np.round((phase[0] + np.pi / 4) / (2 * np.pi))
        k = int(np.argmax(phase < -np.pi))
        at = brentq(lambda each: float(np.angle(-self.response(np.array([each])))[0]), w[k - 1], w[k])
        return float(at), float(1 / np.abs(self.response(np.array([at])))[0])


def _lags(*constants: float) -> tuple[float, ...]:
    found: Array = np.ones(1)
    for constant in constants:
        found = np.asarray(np.polymul(found, [constant, 1.0]), dtype=float)
    return tuple(found.tolist())


PLANTS = (
    Plant("three_lags", (1.0,), _lags(1, 1, 1)),
    Plant("four_lags", (1.0,), _lags(1, 1, 1, 1)),
    Plant("spread_lags", (1.0,), _lags(1, 0.1, 0.01, 0.001)),
    Plant("halved_lags", (1.0,), _lags(1, 0.5, 0.25, 0.125)),
    Plant("zero_1", (-1.0, 1.0), _lags(1, 1, 1)),
    Plant("zero_2", (-2.0, 1.0), _lags(1, 1, 1)),
    Plant("integrator", (1.0,), (*_lags(1, 1), 0.0)),
    Plant("oscillator", (9.0,), tuple(np.polymul([1.0, 1.0], [1.0, 2.0, 9.0]).tolist())),
    Plant("late_lag", (1.0,), _lags(1), 1.0),
    Plant("late_slow_lag", (1.0,), _lags(8), 1.0),
    Plant("late_fast_lags", (1.0,), _lags(0.05, 0.05), 1.0),
    Plant("late_integrator", (1.0,), (*_lags(1), 0.0), 1.0),
)


@dataclass(frozen=True, eq=False)
class OwnLoop:
    """A plant under Kp, Ti and, with a derivative, Td, by numpy and SciPy alone."""

    plant: Plant
    derivative: bool

    @cached_property
    def _grid(self) -> tuple[Array, NDArray[np.complex128]]:
        """Frequencies for peaks, and P there."""
        at = self.plant.ultimate[0]
        w = at * np.logspace(*DECADES, FREQUENCIES)
        if self.plant.late:
            w = np.union1d(w, np.linspace(0.0, 40.0 / self.plant.late, 800)[1:])
        return w, self.plant.response(w)

    @cached_property
    def _fourier(self) -> tuple[Array, NDArray[np.complex128]]:
        """The frequencies of the transform but zero, and P there."""
        record = RECORDS * PERIODS / self.plant.ultimate[0]
        w: Array = np.asarray(2 * np.pi / record * np.arange(1, SAMPLES // 2 + 1), dtype=float)
        return w, self.plant.response(w)

    def controller(self, gains: Array, w: Array) -> NDArray[np.complex128]:
        """C(jw)."""
        s, Td = 1j * w, float(gains[2]) if self.derivative else 0.0
        return np.asarray(gains[0] * (1 + 1 / (gains[1] * s) + Td * s / (Td * s / FILTER_RATIO + 1)))

    def peaks(self, gains: Array) -> tuple[float, float]:
        """Ms and Mt, infinite of an unstable loop; on a grid, then on finer ones about its highest point."""
        w, P = self._grid
        L = P * self.controller(gains, w)
        if not self._is_stable(L):
            return np.inf, np.inf
        return self._peak(gains, np.abs(1 / (1 + L)), False), self._peak(gains, np.abs(L / (1 + L)), True)

    def _peak(self, gains: Array, sizes: Array, complementary: bool) -> float:
        w, k = self._grid[0], int(np.argmax(sizes))
        low, high, best = w[max(0, k - 1)], w[min(len(w) - 1, k + 1)], float(sizes[k])
        for _ in range(3):
            near = np.linspace(low, high, 21)
            L = self.plant.response(near) * self.controller(gains, near)
            found = np.abs((L if complementary else 1.0) / (1 + L))
            k = int(np.argmax(found))
            best, low, high = max(best, float(found[k])), near[max(0, k - 1)], near[min(20, k + 1)]
        return best

    def _is_stable(self, L: NDArray[np.complex128]) -> bool:
        """Nyquist's count; from the grid's lowest frequency a plant's and the controller's integrals turn to zero."""
        poles = 1 + int(abs(self.plant.denominator[-1]) < 1e-12)  # at zero, the controller's among them
        turned = np.unwrap(np.angle(1 + L))
        return bool(abs(turned[-1] - turned[0] - poles * np.pi / 2) < np.pi / 2)

    def iae(self, gains: Array) -> float:
        """The integral of the absolute error after a load of one at the plant's input."""
        w, P = self._fourier
        signal = P / (1 + P * self.controller(gains, w)) / (1j * w)
        spectrum = np.concatenate([[gains[1] / gains[0]], signal])  # at zero it is 1/Ki
        return float(np.abs(np.fft.irfft(spectrum, SAMPLES)).sum())

    def optimum(self, most: float, rng: np.random.Generator, starts: int = 5) -> tuple[Array, float]:
        """Gains and IAE of the best design that SLSQP finds from several starts."""
        w, ultimate = self.plant.ultimate
        centre = np.array([0.3 * ultimate, 4.0 / w, 1.0 / w][: 2 + self.derivative])
        best, least = centre, np.inf
        for _ in range(starts):
            z = np.log(centre) + rng.normal(0.0, 0.7, len(centre))
            while not np.isfinite(self.peaks(np.exp(z))[0]):
                z[:2] += (-0.3, 0.1)
            options: Any = {
                "method": "SLSQP",
                "constraints": {"type": "ineq", "fun": lambda z: most - np.minimum(self.peaks(np.exp(z)), 10.0)},
                "bounds": [(v - 4, v + 4) for v in np.log(centre)],
                "options": {"maxiter": 80, "ftol": 1e-9},
            }

            def cost(z: Array) -> float:
                return float(np.log(self.iae(np.exp(z))))

            found = minimize(cost, z, **options)
            gains = np.exp(found.x)
            value = self.iae(gains)
            if max(self.peaks(gains)) <= most * (1 + 1e-6) and value < least:
                best, least = gains, value
        return best, least


def system(plant: Plant) -> po.System:
    """The plant as pneuopt has it, in the controllable canonical form."""
    bottom = np.array(plant.denominator) / plant.denominator[0]
    n = len(bottom) - 1
    top = np.zeros(n)
    top[n - len(plant.numerator) :] = np.array(plant.numerator) / plant.denominator[0]
    states = [po.Quantity(f"x{k}", "1") for k in range(n)]

    def rates(_t, x, u, _p):  # type: ignore[no-untyped-def]
        z = [x[f"x{k}"] for k in range(n)]
        moved = {f"x{k}": z[k + 1] for k in range(n - 1)}
        moved[f"x{n - 1}"] = u["load"] - sum(bottom[n - k] * z[k] for k in range(n))
        return moved, {"output": sum(top[n - 1 - k] * z[k] for k in range(n))}

    found = po.define(states, [po.Quantity("load", "1")], [po.Quantity("output", "1")], po.ParameterSet({}), rates)
    return po.add_dead_time(found, PADE_ORDER) if plant.late else found


def tuned(plant: Plant, derivative: bool, most: float) -> po.TuningResult:
    """The design that `tune` hands out; the gains may be anything about the ultimate ones."""
    loop = po.ClosedLoop(system(plant), po.PID(limits=False, form=po.Form.STANDARD))
    w, ultimate = plant.ultimate
    bounds = {"pid.Kp": (0.01 * ultimate, 3 * ultimate), "pid.Ti": (0.3 / w, 40 / w), "pid.Td": (0.05 / w, 3 / w)}
    bounds = {n: v for n, v in bounds.items() if derivative or n != "pid.Td"}
    given = {"pid.Kp": 0.1 * ultimate, "pid.Ti": 10 / w, "pid.Td": 0.2 / w if derivative else 0.0}
    late = {"dead_time": plant.late} if plant.late else {}
    parameters = (
        loop.parameters.with_values({**given, **late, "pid.N": FILTER_RATIO}).with_bounds(bounds).freed(*bounds)
    )
    step = po.Step(0.0, horizon=PERIODS / w, disturbance={"load": 1.0}, scale=1.0)
    limits = [po.MaxSensitivity(most), po.MaxComplementarySensitivity(most)]
    return po.tune(loop, step, parameters, minimise=po.IAE(), subject_to=limits, plants={}, throw=False)


def main(plants: "tuple[Plant, ...]" = PLANTS) -> "pd.DataFrame":
    claims, spent, rng = [], list[float](), np.random.default_rng(0)
    for plant in plants:
        allowed = RIPPLED_EXCESS if plant.name == RIPPLED else EXCESS
        for derivative in (False, True):
            own, kind = OwnLoop(plant, derivative), "PIDF" if derivative else "PI"
            for most in SENSITIVITIES:
                name = f"{plant.name}.{kind}.{most:g}"
                best, least = own.optimum(most, rng)
                begun = time.process_time()
                found = tuned(plant, derivative, most)
                spent.append(time.process_time() - begun)
                gains = np.array([found.parameters.value(f"pid.{n}") for n in ("Kp", "Ti", "Td")[: len(best)]])
                room, is_active = most - max(own.peaks(gains)), most - max(own.peaks(best)) <= ROOM
                claims += [
                    Claim(f"{name}.certified", int(found.status.converged), "1", None, ">= 1"),
                    Claim(f"{name}.IAE", own.iae(gains), "s", least),
                    Claim(f"{name}.excess", 100 * (own.iae(gains) / least - 1), "%", None, f"<= {allowed:g}"),
                    Claim(f"{name}.room", room, "1", None, f"<= {ROOM:g}" if is_active else ""),
                    Claim(f"{name}.above", max(0.0, -room), "1", None, "<= 1e-8"),
                ]
                print(name, gains, best, f"{claims[-3].value:.4f} % {room:.2e} {spent[-1]:.2f} s", file=sys.stderr)
    excess = [claim.value for claim in claims if claim.name.endswith(".excess")]
    claims += [
        Claim("all.certified", sum(int(c.value) for c in claims if c.name.endswith(".certified")), "1", len(spent)),
        Claim("all.worst_excess", max(excess), "%"),
        Claim("all.median_cpu", float(np.median(spent)), "s"),
    ]
    return frame(claims)


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("--plants", nargs="+", choices=[p.name for p in PLANTS], default=[p.name for p in PLANTS])
    options = parser.parse_args()
    sys.exit(finish(main(tuple(p for p in PLANTS if p.name in options.plants)), options))
