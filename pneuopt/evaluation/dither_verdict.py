"""`judge_dither`: whether a dither is worth having, in numbers: the loop with and without it, and what it moves."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from math import inf, isfinite, isnan, nan, pi
from typing import TYPE_CHECKING, NamedTuple

import casadi as ca
import numpy as np

from pneuopt.control.averaging import ripple
from pneuopt.control.dither import DITHER_AMPLITUDE, DITHER_FREQUENCY, DITHER_OFFSET
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Step
from pneuopt.dynamics.hooks import Rest
from pneuopt.dynamics.system import System, names
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.requirements import METRICS
from pneuopt.evaluation.response import command_range
from pneuopt.quantities.errors import ConvergenceError, InputError, require
from pneuopt.quantities.parameters import ParameterSet

if TYPE_CHECKING:
    import pandas as pd

NEGLIGIBLE_AMPLITUDE = 1e-9  # of the amplitude is none, but averages and end values are read over the same periods
MIN_LOOSENING_FORCE = (
    0.5  # of the static friction: a force below half of it frees nothing in company of a working pressure
)


class Usefulness(Enum):
    """What a dither does to a loop."""

    USEFUL = "useful"
    USELESS = "useless"
    HARMFUL = "harmful"


class Criterion(NamedTuple):
    """A metric by which dithers are judged: what it is called, by how much it has to change, of what."""

    label: str
    min_change: float
    relative: bool


CRITERIA: Mapping[str, Criterion] = {  # the first that changes decides, where some improve and some do not
    "LimitCycleAmplitude": Criterion("limit cycle", 0.02, relative=False),  # of the step
    "SettlingTime": Criterion("settling time", 0.05, relative=True),
    "SteadyStateError": Criterion("error that stays", 0.5, relative=False),  # [%]
    "IAE": Criterion("integral of the error", 0.05, relative=True),
    "Overshoot": Criterion("overshoot", 1.0, relative=False),  # [%]
}
PRICE_METRICS = {"Ripple": "ripple", "AirUse": "air", "ValveTravel": "valve travel", "PeakControl": "largest command"}


@dataclass(frozen=True)
class DitherEffect:
    """What a dither moves, by the balance of its first harmonic with openings and friction as they are; NaN: not known.

    Attributes
    ----------
    amplitude, frequency : float
        [command's unit], [Hz]
    spool : float
        The spool's swing [half travels].
    valve_gain : float
        What the valve's lag leaves of it [1].
    force : float
        Amplitude of the force on a piston held fast at rest [N].
    speed, travel : float
        Amplitudes of a piston that moves at the reference [m/s], [m].
    drive_frequency : float
        At which the load swings on the air in the chambers [Hz].
    """

    amplitude: float
    frequency: float
    spool: float = nan
    valve_gain: float = nan
    force: float = nan
    speed: float = nan
    travel: float = nan
    drive_frequency: float = nan


@dataclass(frozen=True, eq=False)
class DitherVerdict:
    """What `judge_dither` found; printed, it is what an engineer reads.

    Attributes
    ----------
    usefulness : Usefulness
    reasons : tuple of str
        What decided, the price, and why, in sentences.
    table : DataFrame
        A row a metric of `evaluate`, columns "without" and "with": the worst over the references.
    effect : DitherEffect
    baseline : str
        What "without" is: the same gains, or a design of its own.
    unit : str
        The command's.
    """

    usefulness: Usefulness
    reasons: tuple[str, ...]
    table: "pd.DataFrame"
    effect: DitherEffect
    baseline: str
    unit: str

    def __str__(self) -> str:
        dither = f"the dither of {self.effect.amplitude:.4g} {self.unit} at {self.effect.frequency:.4g} Hz"
        head = f"{dither} is {self.usefulness.value}, against {self.baseline}"
        return "\n".join([head, *(f"  {reason}" for reason in self.reasons)])


def judge_dither(
    loop: ClosedLoop,
    references: Step | Sequence[Step],
    parameters: ParameterSet,
    *,
    without: ParameterSet | None = None,
    band: float = 0.02,
) -> DitherVerdict:
    """Certify a loop with and without its dither, and say whether it is worth having, and why.

    Better or worse is what changes by more than these: the settling time and the integral of the error by 5 %, the
    error that stays by half a percent of the step, the overshoot by one, a limit cycle by two. Where some improve and
    others do not, the first of limit cycle, settling time, error, integral, overshoot decides. A dither that swings the
    signal by more than the step is harmful, whatever the average does.

    Parameters
    ----------
    loop : ClosedLoop
    references : Step or sequence of Step
    parameters : ParameterSet
        With the dither; its amplitude is positive.
    without : ParameterSet, optional
        The design to compare with; its dither does not count. By default the same gains: what the dither does there.
        Give the gains of a tuning without dither to see whether it is needed.
    band : float
        Half width of the settling band, a fraction of the step.

    Returns
    -------
    DitherVerdict

    Raises
    ------
    InputError
        If there is no dither to judge.
    ConvergenceError
        If a simulation stops.
    """
    steps = [references] if isinstance(references, Step) else list(references)
    full = loop.parameters | parameters
    require(loop.dither is not None, "there is no dither to judge: ClosedLoop(plant, pid, Dither())")
    require(full.value(DITHER_AMPLITUDE) > 0, "there is no dither to judge: dither.amplitude is 0")
    plain = full if without is None else full | without
    plain = plain.with_bounds({DITHER_AMPLITUDE: (0.0, plain[DITHER_AMPLITUDE].upper)})
    plain = plain.with_values(
        {
            DITHER_AMPLITUDE: NEGLIGIBLE_AMPLITUDE * full.value(DITHER_AMPLITUDE),
            DITHER_FREQUENCY: full.value(DITHER_FREQUENCY),
        }
    )
    table = _compare_designs(loop, steps, plain, full, band)
    effect = dither_effect(loop, steps[0], full)
    sizes = [abs(s.size) for s in steps]
    own = float(table["with"]["Ripple"]) if isnan(effect.speed) else 2 * effect.speed
    size = _format_with_prefix(own, loop.feedback.unit)
    coarse = [f"worse: it swings {loop.feedback.name} by {size}, more than the step itself"]
    coarse = coarse if own > min(sizes) else []
    usefulness, found = _weigh_changes(table, max(sizes), loop, coarse)
    rival = "the same gains without it" if without is None else "a design of its own without it"
    return DitherVerdict(
        usefulness, (*found, *explain_effect(loop, effect, full)), table, effect, rival, loop.command.unit
    )


def dither_effect(loop: ClosedLoop, reference: Step, parameters: ParameterSet) -> DitherEffect:
    """What the dither moves: on a `PneumaticDrive` all of it, on another plant the swing of the measured signal.

    Parameters
    ----------
    loop : ClosedLoop
    reference : Step
        In whose final value the piston moves; where it starts is where it is held.
    parameters : ParameterSet
        With the dither's amplitude and frequency.
    """
    full = loop.parameters | parameters
    found = DitherEffect(full.value(DITHER_AMPLITUDE), full.value(DITHER_FREQUENCY))
    moving = _state_harmonics(loop, loop.plant, full, _try_rest(loop.plant, full, {"speed": reference.final}))
    if "speed" in moving:
        speed = abs(moving["speed"])
        found = replace(found, speed=speed, travel=speed / (2 * pi * found.frequency))
    if not {"pressure_a", "pressure_b", "speed"} <= set(names(loop.plant.states)) or "valve.span" not in full:
        return found
    rest = _try_rest(loop.plant, full, {"speed": reference.initial, **reference.start})
    held = _state_harmonics(loop, _clamp_piston(loop.plant), full, rest)
    if rest is None or not held:
        return found
    command = found.amplitude / full.value("valve.span")
    spool = abs(held["valve.spool"]) if "valve.spool" in held else min(1.0, command)
    linear = loop.plant.linearise(np.array([*rest.states.values()]), rest.inputs, full)
    row = dict(zip(linear.states, linear.A[linear.states.index("speed")], strict=True))
    force = full.value("load.mass") * abs(sum(row[n] * held[n] for n in ("pressure_a", "pressure_b")))
    kept = [linear.states.index(n) for n in ("speed", "pressure_a", "pressure_b")]
    block = linear.A[np.ix_(kept, kept)]
    block[0, 0] = 0.0  # without friction
    rate = float(np.abs(np.linalg.eigvals(block)).max())
    return replace(found, spool=spool, valve_gain=spool / command, force=float(force), drive_frequency=rate / (2 * pi))


def explain_effect(loop: ClosedLoop, effect: DitherEffect, parameters: ParameterSet) -> tuple[str, ...]:
    """Why a dither does what it does, against valve, dead zone and stiction; a sentence each.

    Parameters
    ----------
    loop : ClosedLoop
    effect : DitherEffect
    parameters : ParameterSet
    """
    p, e, told = (loop.parameters | parameters), effect, list[str]()
    told += _describe_clipping(loop, p)
    if not isnan(e.valve_gain):
        dead = p.value("valve.dead_zone")
        lag = f" at {p.value('valve.bandwidth'):.3g} Hz bandwidth" if "valve.bandwidth" in p else ""
        zone = f", {'beyond' if e.spool > dead else 'within'} its dead zone of {dead:.3g}" if dead > 0 else ""
        follows = f"the spool follows {100 * e.valve_gain:.0f} % of it{lag}"
        told.append(f"{follows} and swings by +-{e.spool:.2g} of its half travel{zone}")
    static = next((p.value(f"friction.{n}") for n in ("static", "coulomb") if f"friction.{n}" in p), nan)
    if not isnan(e.force):
        against = "" if isnan(static) else f" against a static friction of {static:.3g} N"
        weak = ": it does not loosen it" if e.force < MIN_LOOSENING_FORCE * static else ""
        told.append(f"on a piston at rest it makes +-{_format_with_prefix(e.force, 'N')}{against}{weak}")
    if not isnan(e.speed):
        told.append(
            f"a moving one swings by +-{_format_with_prefix(e.speed, 'm/s')} and +-{_format_with_prefix(e.travel, 'm')}"
        )
    if not isnan(e.drive_frequency):
        ratio = e.frequency / e.drive_frequency
        told.append(f"its {e.frequency:.3g} Hz are {ratio:.2g} times the {e.drive_frequency:.3g} Hz of load on air")
    return tuple(told)


def _compare_designs(
    loop: ClosedLoop, steps: Sequence[Step], plain: ParameterSet, full: ParameterSet, band: float
) -> "pd.DataFrame":
    """The worst over the references; a settling time that is never is infinite."""
    import pandas as pd

    columns = {}
    for name, given in {"without": plain, "with": full}.items():
        found = evaluate(loop, steps, given, band=band)
        found.loc["SettlingTime"] = found.loc["SettlingTime"].fillna(inf)
        columns[name] = found.max(axis=1)
    return pd.DataFrame(columns)


def _weigh_changes(
    table: "pd.DataFrame", size: float, loop: ClosedLoop, told: list[str]
) -> tuple[Usefulness, tuple[str, ...]]:
    """The verdict, and what it stands on, from what is told already: against it."""
    signs = [-1] * len(told)
    for metric, (words, least, relative) in CRITERIA.items():
        before, after = (float(table[c][metric]) for c in ("without", "with"))
        room = least * max(before, after) if relative else least * (size if "Limit" in metric else 1.0)
        if before == after or not (abs(after - before) > room or isfinite(before) != isfinite(after)):
            continue
        signs.append(1 if after < before else -1)
        change = (
            f"{words} {_format_metric(metric, before, loop)} without, {_format_metric(metric, after, loop)} with it"
        )
        told.append(f"{'better' if after < before else 'worse'}: {change}")
    if not signs:
        kept = ("SettlingTime", "SteadyStateError")
        figures = [f"{CRITERIA[m].label} {_format_metric(m, float(table['with'][m]), loop)}" for m in kept]
        told.append(f"nothing changes: {', '.join(figures)}")
    told.append("price: " + ", ".join(_price_clause(n, table, loop) for n in PRICE_METRICS if n in table.index))
    verdict = Usefulness.USELESS if not signs else Usefulness.USEFUL if signs[0] > 0 else Usefulness.HARMFUL
    return verdict, tuple(told)


def _price_clause(metric: str, table: "pd.DataFrame", loop: ClosedLoop) -> str:
    before, after = (_format_metric(metric, float(table[c][metric]), loop) for c in ("without", "with"))
    return f"{PRICE_METRICS[metric]} {after} (without {before})"


def _format_metric(metric: str, value: float, loop: ClosedLoop) -> str:
    if metric == "SettlingTime" and value == inf:
        return "never"
    if metric == "LimitCycleAmplitude" and value == 0:
        return "none"
    if metric in ("Ripple", "LimitCycleAmplitude"):
        return _format_with_prefix(value, loop.feedback.unit)
    return f"{value:.3g} {METRICS[metric].shown_unit(loop.command.unit, loop.feedback.unit)}".rstrip()


def _format_with_prefix(value: float, unit: str) -> str:
    """With a prefix that leaves no row of zeros.

    Examples
    --------
    >>> _format_with_prefix(0.00076, "N"), _format_with_prefix(6.4e-11, "m"), _format_with_prefix(12.1, "N")
    ('0.76 mN', '0.064 nm', '12 N')
    """
    for factor, prefix in ((1.0, ""), (1e3, "m"), (1e6, "u"), (1e9, "n")):
        if abs(value) * factor >= 0.1 or prefix == "n" or value == 0:
            break
    return f"{value * factor:.2g} {prefix}{unit}"


def _describe_clipping(loop: ClosedLoop, p: ParameterSet) -> list[str]:
    """Where offset and amplitude alone run into the command's limits, or the valve's."""
    low, high, whose = command_range(p)
    least, most = (p.value(DITHER_OFFSET) + side * p.value(DITHER_AMPLITUDE) for side in (-1, 1))
    if low <= least and most <= high:
        return []
    unit = loop.command.unit
    return [
        f"offset and amplitude alone reach {least:.3g} to {most:.3g} {unit}, and {whose} ends at {low:.3g} and "
        f"{high:.3g} {unit}: the peaks are cut"
    ]


def _try_rest(plant: System, p: ParameterSet, known: Mapping[str, float]) -> Rest | None:
    """Where the plant stands or moves so; None where it cannot."""
    if plant.rest_hook is None:
        return None
    try:
        return plant.rest_hook(p, known)
    except (InputError, ConvergenceError):
        return None


def _state_harmonics(loop: ClosedLoop, plant: System, p: ParameterSet, rest: Rest | None) -> dict[str, complex]:
    """The first harmonics about a rest; empty where none is found."""
    assert loop.dither is not None
    at = None if rest is None else {**rest.states, **rest.inputs}
    try:
        return ripple(plant, p, at=at, actuated=loop.command.name, waveform=loop.dither.waveform)
    except ConvergenceError:
        return {}


def _clamp_piston(plant: System) -> System:
    """The plant with its piston clamped: what moves it has no rate."""
    t, x, u, p = (ca.SX.sym(n, plant.ode.size1_in(k)) for k, n in enumerate("txup"))
    xdot, y = plant.ode(t, x, u, p)
    clamped = [n in ("position", "speed") or n.startswith("friction.") for n in names(plant.states)]
    rates = ca.vertcat(*(ca.SX(0) if c else xdot[k] for k, c in enumerate(clamped)))
    return replace(plant, ode=ca.Function("ode", [t, x, u, p], [rates, y], ["t", "x", "u", "p"], ["xdot", "y"]))
