"""`Band`: the half width of a settling band, a fraction of the step, or a `Tolerance` in the measured unit."""

from dataclasses import dataclass
from math import inf
from typing import TypeAlias

from pneuopt.control.reference import Reference
from pneuopt.quantities.errors import require
from pneuopt.quantities.units import write_value


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
        If a tolerance is as wide as the step, so that where it begins counts as settled.

    Examples
    --------
    >>> from pneuopt.control.reference import Step
    >>> band_share(0.02, Step(0.2)), band_share(Tolerance(1e-3), Step(0.2))
    (0.02, 0.005)
    """
    if not isinstance(band, Tolerance):
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
