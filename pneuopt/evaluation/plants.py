"""`monte_carlo` and `expected_plants`: plants within what a fit leaves open and what hardware varies by.

A parameter that a fit has estimated is drawn from the fit's covariance, by Student's t where few degrees of freedom
tell it; one that the fit gave no interval is drawn from as far as errors of its model may reach. `monte_carlo` draws
the others as stated. Of `expected_plants`, which a design has not seen, those named in `TOLERANCES` vary by the usual
tolerance of such hardware, and each tuned gain by `GAIN_TOLERANCE`.
"""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from pneuopt.evaluation.scenarios import (
    NO_SCENARIOS,
    AxisNames,
    Factor,
    SampleSpreads,
    Sampling,
    Scenarios,
    ScenarioValues,
    Seed,
    draws,
    further,
    generator,
    samples,
    tolerances,
)
from pneuopt.evaluation.tolerances import GAIN_TOLERANCE, PLANT_COUNT
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.quantities.report import Line, Report, Tone
from pneuopt.quantities.results import Shown

if TYPE_CHECKING:
    import pandas as pd


def monte_carlo(
    parameters: ParameterSet,
    count: int,
    *,
    covariance: "pd.DataFrame | None" = None,
    estimates: "pd.DataFrame | None" = None,
    spreads: SampleSpreads = MappingProxyType({}),
    seed: Seed = 0,
    sampling: Sampling = Sampling.RANDOM,
) -> ScenarioValues:
    """Draw plants: what a fit has estimated from its covariance, other parameters from stated distributions.

    Parameters
    ----------
    parameters : ParameterSet
        The nominal values, and the bounds within which every draw lies.
    count : int
    covariance, estimates : DataFrame, optional
        `IdentificationResult.covariance`, and `.estimates`: with these the draws are as wide as the confidence
        intervals (Student's t), and a parameter without an interval is drawn from as far as its `bias` reaches.
    spreads : mapping, optional
        As for `samples`; a parameter in it is drawn by it, whatever the fit estimates.
    seed : int or tuple
        Plants of `samples` or `draws` are independent of these for the same seed, too.
    sampling : Sampling
        How the draws of `spreads` fill their box; those of the fit are independent.

    Returns
    -------
    dict of str to dict of str to float
        "sample 1" and so on.

    Raises
    ------
    InputError
        As from `samples` and `draws`, or if nothing varies.

    Examples
    --------
    >>> import pandas as pd
    >>> from pneuopt.quantities.parameters import Parameter
    >>> rig = ParameterSet({"friction.coulomb": Parameter(40.0, "N", 0.0), "load.mass": Parameter(5.0, "kg")})
    >>> variance = pd.DataFrame([[4.0]], ["friction.coulomb"], ["friction.coulomb"])
    >>> plants = monte_carlo(rig, 500, covariance=variance, spreads={"load.mass": 0.1})
    >>> len(plants), sorted(plants["sample 1"])
    (500, ['friction.coulomb', 'load.mass'])
    """
    require(count >= 1, f"count must be at least 1, got {count}")
    own_seed = further(seed, "monte_carlo")
    stated = samples(parameters, spreads, count, seed=own_seed, sampling=sampling) if spreads else {}
    own = {n for values in stated.values() for n in values}
    estimated, ranges = select_estimates(parameters, covariance, own), select_ranges(parameters, estimates, own)
    nothing = "nothing varies: state how a parameter spreads, or give a fit that has estimated one of this loop"
    require(bool(own or ranges) or estimated is not None, nothing)
    dof = degrees_of_freedom(estimates)
    fitted = {} if estimated is None else draws(parameters, estimated, count, seed=own_seed, dof=dof)
    wide = draw_in_ranges(parameters, ranges, count, own_seed)
    parts = zip(*(list(part.values()) or [{}] * count for part in (fitted, stated)), wide, strict=True)
    return {f"sample {k}": {**a, **b, **c} for k, (a, b, c) in enumerate(parts, 1)}


def select_estimates(
    parameters: ParameterSet, covariance: "pd.DataFrame | None", others: Collection[str]
) -> "pd.DataFrame | None":
    """The part of a covariance that the plants are drawn from: what is identified, without the others."""
    if covariance is None:
        return None
    spread = dict(zip(map(str, covariance.index), np.diag(covariance.to_numpy(dtype=float)).tolist(), strict=True))
    names = [n for n, v in spread.items() if n in parameters and n not in others and v > 0]
    return covariance.loc[names, names] if names else None


def degrees_of_freedom(estimates: "pd.DataFrame | None") -> dict[str, float]:
    """The degrees of freedom of each estimate's variance, where a fit has them."""
    if estimates is None or "dof" not in estimates:
        return {}
    return {str(n): float(v) for n, v in estimates["dof"].items() if math.isfinite(v) and v > 0}


def select_ranges(
    parameters: ParameterSet, estimates: "pd.DataFrame | None", others: Collection[str]
) -> dict[str, tuple[float, float]]:
    """As far as errors of the model may reach, within the bounds, where a fit has no interval, without the others."""
    if estimates is None or "bias" not in estimates:
        return {}
    wide = estimates["bias"][estimates["stderr"].isna() & (estimates["bias"] > 0)]
    bounds = dict(zip(map(str, wide.index), wide.tolist(), strict=True))
    return {n: _ends(parameters[n], bound) for n, bound in bounds.items() if n in parameters and n not in others}


def _ends(p: Parameter, width: float) -> tuple[float, float]:
    """Both ends of a parameter within its bounds that is known to +-width, by its logarithm where it is searched so."""
    low, high = (p.value * np.exp(s * width / p.value) if p.log else p.value + s * width for s in (-1, 1))
    return float(max(low, p.lower)), float(min(high, p.upper))


def draw_in_ranges(
    parameters: ParameterSet, ranges: Mapping[str, tuple[float, float]], count: int, seed: Seed
) -> list[dict[str, float]]:
    """Values anywhere in each range, by their logarithm where the parameter is searched by it."""

    def draw(name: str, low: float, high: float) -> list[float]:
        share = generator(seed, "ranges", name).random(count)
        drawn = low * (high / low) ** share if parameters[name].log else low + share * (high - low)
        return [float(v) for v in drawn]

    columns = {n: draw(n, *ends) for n, ends in ranges.items()}
    return [{n: values[k] for n, values in columns.items()} for k in range(count)]


# By what share of its value a parameter differs from plant to plant where no fit has estimated it. Parameters on one
# line vary together. Larger shares find fault with every design, smaller ones with none.
TOLERANCES: Mapping[tuple[str, ...], float] = {
    ("load.mass",): 0.05,  # a moving mass from drawings, without hoses, cables and what is clamped on
    ("load.inertia",): 0.05,  # likewise
    ("supply.pressure",): 0.05,  # droop and hysteresis of a regulator: 0.3 bar at 6 bar(g)
    # Friction of one seal from run to run (problems/identify/seal_friction.py), and as it warms up.
    ("friction.coulomb", "friction.static"): 0.1,
    ("friction.viscous",): 0.1,
    ("plant.gain",): 0.05,  # of a transfer function: as for mass and supply, on which it depends
    ("plant.time_constant",): 0.05,
    ("plant.natural_frequency",): 0.05,
    ("plant.damping",): 0.1,  # friction's share in it
    ("plant.dead_time",): 0.05,
}
GAIN_PREFIXES = ("pid.", "feedforward.")


@dataclass(frozen=True, eq=False)
class CorrelatedParameters:
    """Parameters that vary together from plant to plant, on their own."""

    names: tuple[str, ...]
    share: float  # by which fraction of the value they vary, either way
    low: Mapping[str, float | Factor]  # the scenario in which they are at their low end, and nothing else differs
    high: Mapping[str, float | Factor]
    is_gain: bool = False  # of the controller

    @property
    def label(self) -> str:
        """Names and tolerance, "load.mass +-5 %"."""
        return f"{' and '.join(self.names)} +-{100 * self.share:.2g} %"


@dataclass(frozen=True, eq=False, repr=False)
class ExpectedPlants(Shown):
    """Plants that a model may stand for, and what they differ by.

    Attributes
    ----------
    scenarios : mapping of str to mapping
        "plant 1" and so on.
    axes : tuple of CorrelatedParameters
        What varies, without the parameters of the scenarios that a tuning knows already.
    from_fit : tuple of str
        Parameters that are drawn from a fit's covariance, or within its bounds of the bias.
    known : tuple of str
        Parameters that vary as the tuning's own scenarios have them.
    vetting : mapping of str to mapping
        As many others of the same kind, drawn from a stream of their own: by them `tune` chooses among designs, so that
        `scenarios` can judge the one that is chosen. Empty: no choice.
    """

    scenarios: Scenarios
    axes: tuple[CorrelatedParameters, ...]
    from_fit: tuple[str, ...] = ()
    known: tuple[str, ...] = ()
    vetting: Scenarios = field(default_factory=dict)

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences on what varies and by how much, one a source."""
        stated = [a for a in self.axes if not a.is_gain and not set(a.names) & set(self.from_fit)]
        gains = [a for a in self.axes if a.is_gain]
        fitted = [a.label for a in self.axes if set(a.names) & set(self.from_fit)]
        parts = (
            ("as the fit leaves them", fitted),
            ("assumed tolerances", [a.label for a in stated]),
            ("of the controller", [f"each gain +-{100 * a.share:.2g} %" for a in gains[:1]]),
            ("as the scenarios have them", list(self.known)),
        )
        return tuple(f"{lead}: {', '.join(labels)}" for lead, labels in parts if labels)

    def summary(self) -> Report:
        """The number of plants, and their differences."""
        count = len(self.scenarios)
        lead = Line(f"{count} plant{'s' if count != 1 else ''} that the model may stand for", Tone.HEADING)
        return Report((lead, *(Line(sentence, indent=2) for sentence in self.sentences)))


def expected_plants(
    parameters: ParameterSet,
    covariance: "pd.DataFrame | None" = None,
    *,
    estimates: "pd.DataFrame | None" = None,
    scenarios: Scenarios = NO_SCENARIOS,
    count: int = PLANT_COUNT,
    seed: Seed = 0,
) -> ExpectedPlants:
    """Draw the plants that a model may stand for.

    Parameters
    ----------
    parameters : ParameterSet
        Of plant and controller, as for `tune`: what is free counts as tuned.
    covariance : DataFrame, optional
        `IdentificationResult.covariance`, which also says which parameters the logs have identified.
    estimates : DataFrame, optional
        `IdentificationResult.estimates`: with its degrees of freedom the draws are as wide as the confidence intervals,
        and a parameter without an interval is drawn from as far as its `bias` reaches.
    scenarios : mapping of str to mapping, optional
        Plants that the design is meant for, the search's own or others from the same boxes: plant k differs from the
        model as the k-th of them does, over and above what else varies, and those for vetting as the next `count` do;
        after the last one comes the first.
    count : int
    seed : int or tuple
        No search has seen these plants, whatever seed its own were drawn with.

    Returns
    -------
    ExpectedPlants

    Examples
    --------
    >>> from pneuopt.quantities.parameters import Parameter
    >>> rig = ParameterSet({"load.mass": Parameter(5.0, "kg"), "pid.Kp": Parameter(2.0, "V*s/m", 0.1, 9.0, free=True)})
    >>> plants = expected_plants(rig, count=20)
    >>> len(plants.scenarios), plants.sentences
    (20, ('assumed tolerances: load.mass +-5 %', 'of the controller: each gain +-1 %'))
    """
    require(count >= 1, f"count must be at least 1, got {count}")
    known = {n for values in scenarios.values() for n in values}
    others = {*known, *parameters.free_names}
    estimated, dof = select_estimates(parameters, covariance, others), degrees_of_freedom(estimates)
    ranges = select_ranges(parameters, estimates, others)
    from_fit = (*(map(str, estimated.index) if estimated is not None else ()), *ranges)
    shares = _usual_tolerances(parameters, {*known, *from_fit})
    own = list(scenarios.values()) or [{}]

    def draw(name: str, seed: Seed, first: int) -> Scenarios:
        varied = tolerances(parameters, shares, count, seed=seed) if shares else {}
        drawn = {} if estimated is None else draws(parameters, estimated, count, seed=seed, dof=dof)
        parts = zip(*((list(part.values()) or [{}] * count) for part in (varied, drawn)), strict=True)
        wide = draw_in_ranges(parameters, ranges, count, seed)
        others = (own[(first + k) % len(own)] for k in range(count))
        rows = enumerate(zip(parts, wide, others, strict=True), 1)
        return {f"{name} {k}": {**a, **b, **c, **d} for k, ((a, b), c, d) in rows}

    axes = list[CorrelatedParameters]()
    for names, share in shares.items():
        low, high = ({n: Factor(1 + side * share) for n in names} for side in (-1, 1))
        axes.append(CorrelatedParameters(tuple(names), share, low, high, names[0].startswith(GAIN_PREFIXES)))
    if estimated is not None:
        from scipy.stats import t

        deviations = dict(zip(map(str, estimated.index), np.sqrt(np.diag(estimated)).tolist(), strict=True))
        for n, deviation in deviations.items():
            p, width = parameters[n], float(t.ppf(0.975, dof.get(n, math.inf))) * deviation  # half an interval of 95 %
            least, most = _ends(p, width)
            share = width / abs(p.value) if p.value else 0.0
            axes.append(CorrelatedParameters((n,), share, {n: least}, {n: most}))
    for n, (least, most) in ranges.items():
        value = abs(parameters.value(n))
        axes.append(CorrelatedParameters((n,), (most - least) / 2 / value if value else 0.0, {n: least}, {n: most}))
    if not axes and not known:
        return ExpectedPlants({}, ())
    plants = draw("plant", further(seed, "expected_plants"), 0)
    vetting = draw("vetting plant", further(seed, "vetting"), count)
    return ExpectedPlants(plants, tuple(axes), from_fit, tuple(sorted(known)), vetting)


def _usual_tolerances(parameters: ParameterSet, others: Collection[str]) -> dict[AxisNames, float]:
    """By which share the parameters vary that neither a fit nor a scenario speaks of; a value of 0 has no share."""
    gains = [n for n in parameters.free_names if n.startswith(GAIN_PREFIXES)]
    rows = [*TOLERANCES.items(), *(((n,), GAIN_TOLERANCE) for n in gains)]
    found: dict[AxisNames, float] = {}
    for names, share in rows:
        own = tuple(n for n in names if n in parameters and n not in others and parameters.value(n) != 0)
        found |= {own: share} if own else {}
    return found
