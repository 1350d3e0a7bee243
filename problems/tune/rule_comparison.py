"""Tuned PIDs beside tuning rules and a longer search: is `tune` ever worse than SIMC or AMIGO, and how near the best?

    python problems/tune/rule_comparison.py [--count N] [--jobs J] [--resume] [--json FILE] [--out DIR]

N random problems of each of three sets, each a plant with a dead time L (Pade approximant of order 3), whose PID has
Kp, Ki, Kd and Tf free and Ms up to 1.8. "lag": a first-order lag with L from a tenth to twice its time constant; after
a load step at the input the IAE or the ITAE is least. "integrator": the same. "oscillator": a second-order plant with
damping .05 to .3; after a reference step with at most 10 % overshoot the ITAE or the settling time is least.

The rules: SIMC with tau_c = L (S. Skogestad, J. Process Control 13 (2003) 291-309), and AMIGO's PI and PID (K. J.
Astrom, T. Hagglund, Revisiting the Ziegler-Nichols step response method for PID control, J. Process Control 14 (2004)
635-650). AMIGO is for monotone step responses, so not for the oscillator; SIMC's tables have real time constants only,
for the oscillator the controller is its direct synthesis, which cancels the complex pair. The filter is the shortest
of the box. The box reaches to five times the rules' largest gain, and `tune` begins at a tenth of it; "de", SciPy's
differential evolution, searches on the same simulator for ten times the CPU time that `tune` took.

Each answer has the same certificate. What it refuses counts as infinite: "certified" are `tune`'s designs that it does
not; "not_worse" those of them that no rule beats, among the rules that keep the limits; "near_de" those that are at
most 1 % above de's. "with_rule" and "de.certified" say how many had such a rival at all. The whole study is --count 10.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np

import pneuopt as po
from pneuopt.evaluation.requirements import metric_name
from pneuopt.evaluation.specification import Specification, specify
from pneuopt.plotting import BLUE, GREY, ORANGE, RED, axes_grid, legend_above
from pneuopt.tuning.tune import prepare_search, prepare_task
from problems.shared.claims import Claim, finish, frame
from problems.shared.rows import row_arguments, study_rows
from problems.speed.t32 import best_of, scipy_search

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

COUNT = 2
SENSITIVITY, OVERSHOOT = 1.8, 0.1  # what SIMC keeps: its Ms is 1.59 to 1.70, the derivative's filter adds to it
FILTERS = (0.05, 1.0)  # of the dead time: the box of Tf; a shorter filter amplifies noise, and costs steps
REACH = 5.0  # of the rules' largest gains: the box of Kp, Ki and Kd
START = 0.1  # of the rules' largest gains
TIMES = 10.0  # CPU time of differential evolution, over that of `tune`
NEAR = 1.01  # of its result
RULES = ("simc", "amigo_pi", "amigo_pid")


@dataclass(frozen=True, eq=False)
class Problem:
    """A loop with its free gains, what is asked of them, and what the rules that apply say, by name."""

    loop: po.ClosedLoop
    step: po.Step
    parameters: po.ParameterSet
    spec: Specification
    rules: dict[str, po.ParallelForm]


def main(rows: "pd.DataFrame") -> "pd.DataFrame":
    claims = []
    for kind, part in rows.groupby("kind", sort=False):
        rule, every = best_rule(part), f">= {len(part)}"
        certified = part["outcome"] == "certified"
        claims += [
            Claim(f"{kind}.certified", int(certified.sum()), f"of {len(part)}", None, every),
            Claim(
                f"{kind}.not_worse", int((certified & (part["tuned"] <= rule)).sum()), f"of {len(part)}", None, every
            ),
            Claim(
                f"{kind}.near_de",
                int((certified & (part["tuned"] <= NEAR * part["de"])).sum()),
                f"of {len(part)}",
                None,
                every,
            ),
            Claim(f"{kind}.with_rule", int(np.isfinite(rule).sum()), f"of {len(part)}"),
            Claim(f"{kind}.de.certified", int(np.isfinite(part["de"]).sum()), f"of {len(part)}"),
            Claim(f"{kind}.over_rule", worst_ratio(part["tuned"], rule)),
            Claim(f"{kind}.over_de", worst_ratio(part["tuned"], part["de"])),
            Claim(f"{kind}.cpu", float(part["cpu"].median()), "s"),
        ]
    return frame(claims)


def best_rule(rows: "pd.DataFrame") -> "pd.Series":
    """The least objective of the rules that keep the limits, by problem; inf where none does."""
    return rows[list(RULES)].min(axis=1)


def worst_ratio(ours: "pd.Series", rivals: "pd.Series") -> float:
    """The largest ratio over the problems that a rival solved; NaN where there is none."""
    return float((ours / rivals)[np.isfinite(rivals)].max())


def compared(seed: int) -> dict[str, Any]:
    """The row of one problem: the certified objective of `tune`, of each rule and of differential evolution."""
    kind = list(SETS)[seed % len(SETS)]
    given = SETS[kind](np.random.default_rng((seed, 9)))
    search = prepare_search(prepare_task(given.loop, given.step, given.parameters, given.spec), None)
    begun = time.process_time()
    found = po.tune(given.loop, given.step, given.parameters, minimise=given.spec, plants={}, throw=False)
    spent = time.process_time() - begun
    outcome = "certified" if found.status.converged else "rejected"
    row: dict[str, Any] = {"seed": seed, "kind": kind, "outcome": outcome, "status": str(found.status), "cpu": spent}
    row |= {"objective": metric_name(objective(given.spec)), "tuned": certified_objective(found, given.spec)}
    for rule in RULES:
        gains = given.rules.get(rule)
        point = None if gains is None else np.array([getattr(gains, n.split(".")[1]) for n in search.space.names])
        row[rule] = inf if point is None else certified_objective(search.certify_point(point), given.spec)
    answer = best_of(search, scipy_search({}), TIMES * spent, seed)
    return row | {"de": certified_objective(search.certify_point(answer), given.spec)}


def objective(spec: Specification) -> po.SettlingTime | po.IAE | po.ITAE:
    """The one requirement that is minimised."""
    (only,) = spec.weights
    assert isinstance(only, po.SettlingTime | po.IAE | po.ITAE)
    return only


def certified_objective(result: po.TuningResult, spec: Specification) -> float:
    """What the certificate says of the objective; inf where it refuses the design."""
    if not result.status.converged:
        return inf
    return float(np.max(result.certified.loc[metric_name(objective(spec))].to_numpy(dtype=float)))


def lag(rng: np.random.Generator) -> Problem:
    gain, time_constant = _log(rng, 0.05, 20.0), _log(rng, 0.02, 0.5)
    dead_time = time_constant * _log(rng, 0.1, 2.0)
    values = {"plant.gain": gain, "plant.time_constant": time_constant, "plant.dead_time": dead_time}
    step = _load_step(gain, 5 * time_constant + 20 * dead_time)
    rules = lag_rules(gain, time_constant, dead_time)
    return _problem(po.FirstOrder(pade_order=3), values, step, _load_specification(rng), rules)


def integrator(rng: np.random.Generator) -> Problem:
    gain, dead_time = _log(rng, 0.05, 20.0), _log(rng, 0.005, 0.5)
    values = {"plant.gain": gain, "plant.dead_time": dead_time}
    step = _load_step(gain * dead_time, 60 * dead_time)
    rules = integrator_rules(gain, dead_time)
    return _problem(po.Integrator(pade_order=3), values, step, _load_specification(rng), rules)


def oscillator(rng: np.random.Generator) -> Problem:
    gain, frequency, damping = _log(rng, 0.05, 20.0), _log(rng, 3.0, 60.0), rng.uniform(0.05, 0.3)
    dead_time = rng.uniform(0.1, 1.0) / frequency
    values = {"plant.gain": gain, "plant.natural_frequency": frequency, "plant.damping": damping}
    values["plant.dead_time"] = dead_time
    aim = po.SettlingTime() if rng.random() < 0.5 else po.ITAE()
    spec = specify(aim, [po.Overshoot(OVERSHOOT), po.MaxSensitivity(SENSITIVITY)])
    step = po.Step(gain, horizon=20 * dead_time + 10 / frequency)
    rules = oscillator_rules(gain, frequency, damping, dead_time)
    return _problem(po.SecondOrder(pade_order=3), values, step, spec, rules)


SETS: dict[str, Callable[[np.random.Generator], Problem]] = {
    "lag": lag,
    "integrator": integrator,
    "oscillator": oscillator,
}


def lag_rules(gain: float, time_constant: float, dead_time: float) -> dict[str, po.ParallelForm]:
    """The rules for ``gain exp(-L s)/(T s + 1)``."""
    T, L = time_constant, dead_time
    return {
        "simc": _ideal(T / (2 * gain * L), min(T, 8 * L), 0.0, L),
        "amigo_pi": _ideal(
            (0.15 + (0.35 - L * T / (L + T) ** 2) * T / L) / gain,
            0.35 * L + 13 * L * T**2 / (T**2 + 12 * L * T + 7 * L**2),
            0.0,
            L,
        ),
        "amigo_pid": _ideal(
            (0.2 + 0.45 * T / L) / gain, (0.4 * L + 0.8 * T) / (L + 0.1 * T) * L, 0.5 * L * T / (0.3 * L + T), L
        ),
    }


def integrator_rules(gain: float, dead_time: float) -> dict[str, po.ParallelForm]:
    """The rules for ``gain exp(-L s)/s``: those for the lag, as its time constant grows at the same gain/T."""
    L = dead_time
    return {
        "simc": _ideal(1 / (2 * gain * L), 8 * L, 0.0, L),
        "amigo_pi": _ideal(0.35 / (gain * L), 13.35 * L, 0.0, L),
        "amigo_pid": _ideal(0.45 / (gain * L), 8 * L, 0.5 * L, L),
    }


def oscillator_rules(gain: float, frequency: float, damping: float, dead_time: float) -> dict[str, po.ParallelForm]:
    """SIMC's direct synthesis for a complex pair: the loop is ``exp(-L s)/(2 L s (Tf s + 1))``."""
    Tf, Ki = FILTERS[0] * dead_time, 1 / (2 * gain * dead_time)
    Kp = Ki * (2 * damping / frequency - Tf)
    return {"simc": po.ParallelForm(Kp, Ki, Ki / frequency**2 - Kp * Tf, Tf)}


def _ideal(K: float, Ti: float, Td: float, dead_time: float) -> po.ParallelForm:
    return po.ParallelForm(K, K / Ti, K * Td, FILTERS[0] * dead_time)


def _load_step(scale: float, horizon: float) -> po.Step:
    """A volt at the plant's input; errors are fractions of what it does there."""
    return po.Step(0.0, horizon=horizon, disturbance={"valve_voltage": 1.0}, scale=scale)


def _load_specification(rng: np.random.Generator) -> Specification:
    return specify(po.IAE() if rng.random() < 0.5 else po.ITAE(), [po.MaxSensitivity(SENSITIVITY)])


def _problem(
    plant: Any, values: dict[str, float], step: po.Step, spec: Specification, rules: dict[str, po.ParallelForm]
) -> Problem:
    loop = po.ClosedLoop(plant.system(), po.PID(limits=False))
    largest = {f"pid.{n}": max(getattr(r, n) for r in rules.values()) for n in ("Kp", "Ki", "Kd")}
    ranges = {n: (0.0, REACH * value) for n, value in largest.items()}
    ranges["pid.Tf"] = (FILTERS[0] * values["plant.dead_time"], FILTERS[1] * values["plant.dead_time"])
    start = {n: START * value for n, value in largest.items()} | {"pid.Tf": ranges["pid.Tf"][0] * 2}
    given = loop.parameters.fixed("*").with_values(values | start).with_bounds(ranges).freed(*ranges)
    return Problem(loop, step, given, spec, rules)


def _log(rng: np.random.Generator, low: float, high: float) -> float:
    return float(low * (high / low) ** rng.random())


def figure(rows: "pd.DataFrame") -> "Figure":
    """Each problem's tuned objective over the best rule's and over differential evolution's."""
    from matplotlib.ticker import MaxNLocator

    picture, ((left, right),) = axes_grid(1, 2, (3.4,), width=9.0)
    rivals = {"best rule": best_rule(rows), "differential evolution": rows["de"]}
    for axes, (name, rival) in zip((left, right), rivals.items(), strict=True):
        for (kind, part), colour in zip(rows.groupby("kind", sort=False), (BLUE, ORANGE, RED), strict=False):
            ratio = (part["tuned"] / rival[part.index]).to_numpy(dtype=float)
            axes.plot(np.flatnonzero(ratio < inf), ratio[ratio < inf], "o", ms=4, color=colour, label=str(kind))
        axes.axhline(1.0, color=GREY, lw=0.8, ls="--")
        axes.set(xlabel="problem of its kind", ylabel="tuned over rival", title=name)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    top = max(axes.get_ylim()[1] for axes in (left, right))
    for axes in (left, right):
        axes.set_ylim(0, max(top, 1.1))
    legend_above(picture, left)
    return picture


if __name__ == "__main__":
    options = row_arguments(__doc__, COUNT).parse_args()
    rows = study_rows(compared, range(len(SETS) * options.count), options, "rule_comparison")
    sys.exit(finish(main(rows), options, lambda: {"rule_comparison": figure(rows)}))
