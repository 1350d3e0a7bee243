"""`SettlingBand`: whether a signal is in its band, and since when; `Band`: its half width as users state it."""

from dataclasses import dataclass
from math import inf, nan
from typing import TypeAlias

import numpy as np

from pneuopt.control.reference import Reference
from pneuopt.evaluation.crossings import pick_samples
from pneuopt.evaluation.dither_mean import TAIL_SHARE
from pneuopt.quantities.arrays import Array, Mask
from pneuopt.quantities.errors import require
from pneuopt.quantities.units import write_value

# Share of a band's half width by which a signal on its edge may lie outside by rounding, and still be in it. At 0 the
# units decide whether a signal that ends on the edge has settled; far above, designs that leave the band have.
EDGE_ROUNDING = 1e-9
# Ratio of the time in the band at the record's end to any stay in it before, from which a response that came in late
# counts as settled. With a lower one slow hunting settles whenever it is inside; with a higher one a stroke that ends
# early makes creep of every response that once touched the band's edge.
MIN_STAY_RATIO = 2.0


@dataclass(frozen=True, eq=False)
class SettlingBand:
    """The one answer to "is it in the band": a signal is, up to and on the edge; NaN is not.

    Parameters
    ----------
    centre, half_width : float or ndarray, shape (m,)
        [unit of the signal]

    Examples
    --------
    >>> SettlingBand(0.2, 0.004).contains(np.array([0.19, 0.196, 0.2, 0.204, 0.20401, np.nan])).tolist()
    [False, True, True, True, False, False]
    """

    centre: float | Array
    half_width: float | Array

    def contains(self, y: Array) -> Mask:
        """Which values are in the band, shape (n,) or (m, n) as y."""
        centre, reach = (np.expand_dims(a, -1) for a in (self.centre, self.half_width))
        return np.asarray(np.abs(y - centre) <= (1 + EDGE_ROUNDING) * reach)

    def settling_times(self, t: Array, y: Array) -> Array:
        """Instants from which responses stay in the band, linear between samples, shape (m,) [s].

        NaN where one ends outside, or comes in for good only in the record's last share, where it may just pass.
        The instants t, shape (n,), begin at the step; y has the shape (m, n).
        """
        outside = ~self.contains(y)
        k = len(t) - 1 - np.argmax(outside[:, ::-1], axis=1)
        after = np.minimum(k + 1, len(t) - 1)
        last, following = pick_samples(y, k), pick_samples(y, after)
        edge = self.centre + self.half_width * np.sign(last - self.centre)
        with np.errstate(all="ignore"):
            settled = t[k] + (t[after] - t[k]) * (edge - last) / (following - last)
        settled = np.where(outside[:, -1] | ~(settled <= (1 - TAIL_SHARE) * t[-1]), nan, settled)
        return np.where(outside.any(axis=1), settled, 0.0)


def entry_for_good(t: Array, inside: Mask) -> float:
    """Last instant outside the band of a response that was continued [s]; inf where it may leave the band again.

    It may where it came in at the record's very end, or has been inside for hardly longer than ever before.
    """
    outside, end = np.flatnonzero(~inside), float(t[-1])
    last = float(t[outside[-1]]) if len(outside) else 0.0
    late = last > end / 2 and end - last < MIN_STAY_RATIO * longest_stay(t, inside)
    return inf if late or last > (1 - TAIL_SHARE) * end else last


def longest_stay(t: Array, inside: Mask) -> float:
    """The longest time in the band before it is left for the last time [s]; 0 where it never is."""
    padded = np.concatenate([[False], inside, [False]])
    enters, leaves = np.flatnonzero(~padded[:-1] & padded[1:]), np.flatnonzero(padded[:-1] & ~padded[1:])
    ended = leaves < len(t)
    return float(np.max(t[leaves[ended]] - t[enters[ended]], initial=0.0))


@dataclass(frozen=True)
class Tolerance:
    """A settling band as wide for every reference: the accuracy that a positioning task asks for.

    Parameters
    ----------
    half_width : float
        [measured unit]

    Raises
    ------
    InputError
        If it is not positive and finite.
    """

    half_width: float

    def __post_init__(self) -> None:
        require(0 < self.half_width < inf, f"Tolerance: half_width must be positive and finite, got {self.half_width}")

    def __mul__(self, factor: float) -> "Tolerance":
        return Tolerance(self.half_width * factor)


Band: TypeAlias = float | Tolerance


def band_unit(band: Band, reference: Reference) -> float:
    """Ratio of what a band's number counts to the reference's size: 1 of a fraction."""
    return 1 / abs(reference.nominal_size) if isinstance(band, Tolerance) else 1.0


def band_number(band: Band) -> float:
    """The number of a band: a fraction, or the half width of a tolerance [measured unit]."""
    return band.half_width if isinstance(band, Tolerance) else band


def band_share(band: Band, reference: Reference) -> float:
    """Half width of a band as a fraction of the reference's size.

    Raises
    ------
    InputError
        If it is no fraction between 0 and 1, so that the response would begin settled or never settle.

    Examples
    --------
    >>> from pneuopt.control.reference import Step
    >>> band_share(0.02, Step(0.2)), band_share(Tolerance(1e-3), Step(0.2))
    (0.02, 0.005)
    """
    if not isinstance(band, Tolerance):
        require(0 < band < 1, f"band is a fraction between 0 and 1, got {band:g}; 2 % is 0.02")
        return band
    size = abs(reference.nominal_size)
    told = f"reference {reference.label}: its size of {size:g} lies within the tolerance of +-{band.half_width:g}"
    require(band.half_width < size, f"{told}; narrow the tolerance, or leave the reference out")
    return band.half_width / size


def describe_band(band: Band, unit: str) -> str:
    """Write a band with its unit.

    Parameters
    ----------
    band : Band
    unit : str
        The measured one.

    Examples
    --------
    >>> describe_band(0.02, "m"), describe_band(Tolerance(1e-4), "m")
    ('2 % of the step', '0.1 mm')
    """
    return write_value(band.half_width, unit, 3) if isinstance(band, Tolerance) else f"{100 * band:g} % of the step"
