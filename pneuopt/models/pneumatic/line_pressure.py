"""Check that a log's pressures are those of the chambers, and not of a line before them, by the chambers' mass balance.

A sensor at the valve reads the chamber's pressure plus what the line drops, which grows with the flow: it leads the
chamber. The flow is the valve's in the mass balance itself, so that a drop is tried by taking it off the readings, the
flow from the corrected pressures again. A sensor's lag has the opposite sign; a valve that is faster than stated, or a
command that is logged late, looks alike.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from pneuopt.dynamics.hooks import Log
from pneuopt.models.pneumatic.cylinder import volumes
from pneuopt.models.pneumatic.following import PRESSURE_NAMES
from pneuopt.models.pneumatic.pressure_zero import (
    MAX_UNQUESTIONED_SHARE,
    MIN_RESIDUAL_RATIO,
    is_informative,
    most_active_part,
    trial_shapes,
)
from pneuopt.models.pneumatic.starts import PneumaticLog
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import without_prefix

LEADS = (2e-3, 4e-3, 6e-3, 9e-3, 13e-3, 20e-3, 30e-3, 45e-3)
"""Times [s] by which a line's drop leads that are tried: shorter ones are a sensor's, longer ones no hose has."""
PASSES = 3
"""Times that the flow is found anew from the corrected pressures: with fewer a large drop is half found."""
MAX_WORSE_LEADS = 2
"""Leads in a row that are worse than the best at which no longer one is tried: residuals rise from the best lead on (28
drives of problems/identify/random_plants.py, without a line); fewer trust one residual, more take time."""
MAX_LINE_RESIDUAL_SHARE = 0.25
"""Share of a pressure's squared rates that a drop may leave [1]: with more, the model does not fit anyhow."""


@dataclass(frozen=True, eq=False)
class LinePressureCheck:
    """Log warning hook of a pneumatic drive, for logs with pressures, motion and command.

    Parameters
    ----------
    prepare : callable
        Prepares logs as the start hook does, `PneumaticStarts.prepare_logs`.
    """

    prepare: Callable[[Mapping[str, Log]], Mapping[str, PneumaticLog]]

    def __call__(self, logs: Mapping[str, Log]) -> Sequence[str]:
        """Return a sentence for each log whose chambers' equations hold better behind a line's drop."""
        active = {name: most_active_part(log) for name, log in logs.items() if is_informative(log)}
        return [sentence for name, log in active.items() if (sentence := self._examine(name, log))]

    def _examine(self, name: str, log: Log) -> str:
        given = min((self._balance(log, shape) for shape in trial_shapes(log)), key=lambda found: found.residual)
        if given.residual < MAX_UNQUESTIONED_SHARE * given.total:
            return ""
        lead, best = self._best_lead(log, given)
        if best.residual > min(given.residual / MIN_RESIDUAL_RATIO**2, MAX_LINE_RESIDUAL_SHARE * best.total):
            return ""
        drop = lead * max(float(np.quantile(np.abs(flow), 0.999)) for flow in best.flows)
        ratio = np.sqrt(given.residual / best.residual)
        found = f"{name}: the pressures lead the chambers by {1e3 * lead:.2g} ms, as before a line that drops up to "
        found += f"{drop / 1e5:.2g} bar (their mass balance then leaves {ratio:.1f} times smaller residuals)"
        return f"{found}: put the sensors at the cylinder, or leave them out; else raise valve.bandwidth"

    def _best_lead(self, log: Log, given: "Balance") -> tuple[float, "Balance"]:
        """The lead of least residual, and its balance; 0 and the given one where none is better."""
        lead, best, worse = 0.0, given, 0
        for tried in LEADS:
            found = self._behind_line(log, given, tried)
            is_better = found.residual < best.residual
            lead, best, worse = (tried, found, 0) if is_better else (lead, best, worse + 1)
            if worse == MAX_WORSE_LEADS:
                break
        return lead, best

    def _behind_line(self, log: Log, given: "Balance", lead: float) -> "Balance":
        """The balance of the pressures behind a line that leads so much, with its own flow."""
        found, flows = given, given.flows
        for _ in range(PASSES):
            behind = {n: log.measured[n] - lead * flow for n, flow in zip(given.channels, flows, strict=True)}
            if min(float(np.nanmin(p)) for p in behind.values()) <= 0:
                return given
            found = self._balance(log._replace(measured=log.measured.with_columns(behind)), given.shape)
            flows = [(old + new) / 2 for old, new in zip(flows, found.flows, strict=True)]
        return found

    def _balance(self, log: Log, shape: Mapping[str, float]) -> "Balance":
        run = self.prepare({"": log})[""]
        columns, rates = run.valve_columns(shape)
        geometry: Any = without_prefix({n: p.value for n, p in log.parameters.items()}, "cylinder")
        position: Any = run.known_states["position"]
        size: dict[str, Any] = dict(zip(PRESSURE_NAMES, volumes(position, geometry), strict=True))
        residual, flows = 0.0, []
        for k, channel in enumerate(run.logged_pressures):
            model = columns[:, k] @ np.linalg.lstsq(columns[:, k], rates[:, k])[0]
            residual += float(np.sum((rates[:, k] - model) ** 2))
            flows.append(np.asarray(model * size[channel] / float(np.mean(size[channel]))))
        return Balance(shape, run.logged_pressures, residual, float(np.sum(rates**2)), flows)


class Balance(NamedTuple):
    """What the chambers' mass balance leaves of the pressures' rates.

    Attributes
    ----------
    shape : mapping of str to float
        Of the valve.
    channels : tuple of str
        The logged pressures.
    residual, total : float
        Squared residuals and squared rates, summed [Pa^2/s^2].
    flows : list of ndarray
        The valve's flow into each chamber, as the rate of its pressure at its mean volume [Pa/s].
    """

    shape: Mapping[str, float]
    channels: tuple[str, ...]
    residual: float
    total: float
    flows: list[Array]
