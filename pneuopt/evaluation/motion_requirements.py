"""Requirements on a positioning axis in the units of its user: how far beyond the end, off the path, and under a load.

Each is a length where a position is controlled. With `SettlingTime` of a `Tolerance`, `AirUse` and `EnergyUse` they say
what a move takes.
"""

from typing import final

import numpy as np

from pneuopt.evaluation.metric import AtMost, Metric, Source
from pneuopt.evaluation.step_record import StepRecord, ValuesAndSlopes, overshoot_rows, trapezoidal_weights

PUSH = "load.force"
"""The disturbance against which a loop is stiff."""
FOLLOWING_METRICS = frozenset({"FollowingError", "FollowingErrorRMS"})
"""What needs the reference at every instant."""
LEAST_ROOT = 1e-300  # keeps the derivative of a root finite where nothing is off: 0/0 otherwise


def overshoot_distance_rows(record: StepRecord) -> ValuesAndSlopes:
    """The distance beyond the reference's end; under a disturbance alone on either side."""
    values, slopes = overshoot_rows(record)
    return abs(record.size) * values, abs(record.size) * slopes


def following_error_rows(record: StepRecord) -> ValuesAndSlopes:
    """The distance from the reference at that instant, a row each side."""
    error, slopes = _following_error(record)
    return np.concatenate([error, -error], axis=1), np.concatenate([slopes, -slopes], axis=1)


def following_rms_rows(record: StepRecord) -> ValuesAndSlopes:
    """The root of the mean square of the distance from the reference."""
    (error, slopes), weights = _following_error(record), trapezoidal_weights(record.nodes)
    weights = weights / weights.sum()
    root = np.sqrt(np.einsum("k,mk->m", weights, error**2))
    by_unknown = np.einsum("mk,mkn->mn", weights * error, slopes) / np.maximum(root, LEAST_ROOT)[:, None]
    return root[:, None], by_unknown[:, None]


def compliance_rows(record: StepRecord) -> ValuesAndSlopes:
    """The distance from the reference, either side, over the force that pushes; zero where none does."""
    error, slopes = record.error
    share = abs(record.size / record.push) if record.push else 0.0
    return share * np.concatenate([error, -error], axis=1), share * np.concatenate([slopes, -slopes], axis=1)


def _following_error(record: StepRecord) -> ValuesAndSlopes:
    """Signal less reference at the nodes [measured unit]."""
    error, slopes = record.error
    wanted = 0.0 if record.wanted is None else record.wanted
    return record.size * (error - wanted), record.size * slopes


@final
class OvershootDistance(AtMost):
    """How far the response passes the reference's end [measured unit]; under a disturbance alone, either side.

    Parameters
    ----------
    max : float, optional
        [measured unit]
    """

    metric = Metric(
        "OvershootDistance",
        "{measured}",
        Source.RESPONSE,
        floor=0.0,
        resolution=1e-8,
        slope=overshoot_distance_rows,
        positions=True,
    )


@final
class FollowingError(AtMost):
    """Largest distance from the reference at any instant [measured unit]; of a step it is the step at least.

    Parameters
    ----------
    max : float, optional
        [measured unit]
    """

    metric = Metric(
        "FollowingError",
        "{measured}",
        Source.RESPONSE,
        resolution=1e-8,
        slope=following_error_rows,
        positions=True,
    )


@final
class FollowingErrorRMS(AtMost):
    """Root of the mean square distance from the reference, from its beginning to the horizon [measured unit].

    Parameters
    ----------
    max : float, optional
        [measured unit]
    """

    metric = Metric(
        "FollowingErrorRMS", "{measured}", Source.RESPONSE, resolution=1e-8, slope=following_rms_rows, positions=True
    )


@final
class Compliance(AtMost):
    """Largest deviation over the load force that steps, as ``Step(0.0, ..., disturbance={"load.force": 50.0})`` has it.

    Its reciprocal is the dynamic stiffness. References without that disturbance have none: 0.

    Parameters
    ----------
    max : float, optional
        [measured unit/N]
    """

    metric = Metric(
        "Compliance", "{measured}/N", Source.RESPONSE, resolution=1e-10, slope=compliance_rows, positions=True
    )
