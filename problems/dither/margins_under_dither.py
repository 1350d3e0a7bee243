"""Margins under dither: what injected sines measure in the full model, beside linearisations with and without ripple.

    python problems/dither/margins_under_dither.py [--json FILE] [--out DIR]

The 32 mm cylinder of the benchmark T32 (dead zone 3 %, LuGre friction) slides steadily at 50 to 200 mm/s under a PID
and a dither of some 1000 rad/s. Sines of 1 mV are injected into the valve's command, one frequency a run, each with its
mirror image, and correlated over 32 dither periods with what the valve gets: |S| by frequency, in the nonlinear model.

Rows <case>.injected: the largest |S| so measured. Rows <case>.averaged: that of the linearisation averaged over the
ripple, at the same frequencies, held to the injected one within 3 %. Rows <case>.plain: that of the linearisation about
the mean state without ripple, which is too high where the ripple opens the valve's dead zone.
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import pi
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np

import pneuopt as po
from pneuopt.control.loop import add_disturbances
from pneuopt.dynamics.compiled.rollout import Rollout
from pneuopt.plotting import BLUE, GREY, ORANGE, axes_grid, legend_above
from problems.shared.arrays import Array
from problems.shared.claims import Claim, arguments, finish, frame

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

PERIODS, STEPS, SUBSTEPS = 32, 80, 8  # dither periods of a record; RK4 steps a period, a sample
RECORDS = 4  # of which the last counts, the others settle
SIZE, TOLERANCE = 1e-3, 0.03  # [V], of the injected peak
HARMONICS = (1, 2, 3, 4, 5, 6, 7, 8, 10, 12, 14)  # of the record's own frequency, some 5 Hz
HARDWARE = {"pid.Tf": 0.002, "pid.lower": -5.0, "pid.upper": 5.0, "dither.offset": -0.3}
CONTINUOUS = po.Dither(1000 / (2 * pi))


@dataclass(frozen=True)
class Case:
    """A loop, the speed at which it slides [m/s], its dither's amplitude [V], its Kp, Ki and Kd."""

    speed: float
    amplitude: float
    gains: tuple[float, float, float]
    sample_time: float | None = None
    dither: po.Dither = CONTINUOUS


CASES = {
    "slow": Case(0.05, 1.0, (8.0, 50.0, 0.1)),
    "edge": Case(0.1, 1.6, (28.0, 260.0, 0.3)),
    "fast": Case(0.2, 1.6, (28.0, 260.0, 0.3)),
    "triangle": Case(0.1, 2.0, (28.0, 260.0, 0.3), dither=replace(CONTINUOUS, waveform=po.Waveform.TRIANGLE)),
    "sampled": Case(0.1, 1.6, (16.0, 160.0, 0.2), sample_time=5e-4, dither=po.Dither(160.0)),
}


@dataclass(frozen=True)
class Measured:
    """Sensitivities at the frequencies [rad/s]: injected, averaged over the ripple, without the ripple."""

    omega: Array
    injected: Array
    averaged: Array
    plain: Array


def run(cases: Mapping[str, Case] = CASES) -> dict[str, Measured]:
    return {name: measure(case) for name, case in cases.items()}


def measure(case: Case) -> Measured:
    loop, p = built(case)
    record = PERIODS / p.value("dither.frequency")
    h = case.sample_time or record / PERIODS / STEPS
    n = round(record / h)
    disturbed = add_disturbances(loop, [po.Step(0.0, initial=case.speed, disturbance={loop.command.name: 1.0})])
    t = h * np.arange(RECORDS * n + 1)
    lanes = [(0, 0)] + [(k, side) for k in HARMONICS for side in (1, -1)]
    d = np.array([side * SIZE * np.sin(2 * pi * k / record * t) for k, side in lanes])
    u = np.stack([np.full_like(d, case.speed), d], axis=2)
    x0 = np.tile(loop.initial(p, reference=case.speed, start={"position": 0.05}), (len(lanes), 1))
    steps = np.tile(np.append(np.full(RECORDS * n, h), 0.0), (len(lanes), 1))
    found = Rollout(disturbed.discrete().pieces).run(
        x0, u, disturbed.parameter_vector(p), np.tile(t, (len(lanes), 1)), steps,
        substeps=SUBSTEPS if case.sample_time else 1, states=True,
    )  # fmt: skip
    assert found.x is not None
    last, control = slice(-n - 1, -1), found.y[:, :, -1]
    mean = found.x[0, last, : len(loop.plant.states)].mean(axis=0)
    at = {loop.command.name: float(control[0, last].mean())}
    omega, sensitivity = 2 * pi * np.array(HARMONICS) / record, np.empty(len(HARMONICS), dtype=complex)
    for i, w in enumerate(omega):
        wave = np.exp(-1j * w * t[last])
        answer = (control[1 + 2 * i, last] - control[2 + 2 * i, last]) / 2
        sensitivity[i] = 1 + (answer @ wave) / (d[1 + 2 * i, last] @ wave)
    quiet = p.with_values({"dither.amplitude": 0.0})
    linear = (1 / (1 + po.frequency_response(po.open_loop(loop, q, mean, at), omega)) for q in (p, quiet))
    return Measured(omega, np.abs(sensitivity), *(np.abs(s) for s in linear))


def built(case: Case) -> tuple[po.ClosedLoop, po.ParameterSet]:
    drive, hardware = po.catalog.t32()
    loop = po.ClosedLoop(drive.system(), po.PID(case.sample_time), case.dither)
    gains = dict(zip(("pid.Kp", "pid.Ki", "pid.Kd"), case.gains, strict=True))
    return loop, loop.complete(hardware).with_values({**HARDWARE, **gains, "dither.amplitude": case.amplitude})


def main(measured: Mapping[str, Measured] | None = None) -> "pd.DataFrame":
    claims = []
    for name, found in (measured or run()).items():
        peak = float(found.injected.max())
        claims += [
            Claim(f"{name}.injected", peak),
            Claim(f"{name}.averaged", float(found.averaged.max()), "1", peak, f"{peak:.4g} +- {TOLERANCE * peak:.3g}"),
            Claim(f"{name}.plain", float(found.plain.max()), "1", peak),
        ]
    return frame(claims)


def figure(measured: Mapping[str, Measured]) -> "Figure":
    picture, axes = axes_grid(1, len(measured), [2.6], width=14.0)
    for (name, found), ax in zip(measured.items(), axes[0], strict=True):
        ax.plot(found.omega, found.plain, color=GREY, label="about the mean state")
        ax.plot(found.omega, found.averaged, color=BLUE, label="averaged over the ripple")
        ax.plot(found.omega, found.injected, "o", color=ORANGE, label="injected sines")
        ax.set(title=name, xlabel="frequency [rad/s]", ylabel="|S|")
    legend_above(picture, axes[0][0])
    return picture


if __name__ == "__main__":
    options, job = arguments(__doc__).parse_args(), run()
    sys.exit(finish(main(job), options, lambda: {"margins_under_dither": figure(job)}))
