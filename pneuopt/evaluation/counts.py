"""`describe_counts`: a settling band that a controller cannot see, because its sensor reads in coarser counts."""

from math import ceil, floor, log10

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Reference
from pneuopt.control.sensor import Encoder
from pneuopt.evaluation.band import Band, Tolerance, band_share
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.units import write_value

# Relative excess of half a count over the band's half width that counts as none: below, rounding refuses a band of just
# half a count; above, a band that is too narrow passes.
COUNT_TOLERANCE = 1e-9


def describe_counts(loop: ClosedLoop, parameters: ParameterSet, reference: Reference, band: Band) -> str | None:
    """Sentence for a settling band narrower than half of what one count changes the reading by; None for others.

    A position inside half a count of the reference reads as the reference, inside the band or outside, so that nothing
    holds it in a narrower band. Of a speed only the instants are that coarse: over many samples the counts add up.

    Parameters
    ----------
    loop : ClosedLoop
    parameters : ParameterSet
        Every parameter of the loop.
    reference : Reference
    band : float or Tolerance
        Half width, a fraction of the step or in the measured unit.
    """
    count, size, unit = loop.sensor_resolution(parameters), abs(reference.nominal_size), loop.feedback.unit
    half = band_share(band, reference) * size
    if count / 2 <= half * (1 + COUNT_TOLERANCE):
        return None
    told = f"the settling band of +-{write_value(half, unit, 3)} is narrower than half"
    change, wider = write_value(count, unit, 3), _wider_band(count / 2, size, band, unit)
    if sees_speed(loop):
        remedy = "a finer encoder or a longer filter of the sensor"
        return f"{told} the {change} by which one count changes the reading; {wider}{remedy}"
    ripple = loop.dither_period(parameters) is not None
    tells = "tells inside from outside only by its dither's ripple" if ripple else "cannot tell inside from outside"
    remedy = "a larger step or a finer encoder"
    return f"{told} the encoder's count of {change}, the controller {tells}; {wider}{remedy}"


def _wider_band(half: float, size: float, band: Band, measured: str) -> str:
    """The words that name a wide enough band, rounded up to three digits; none where none is within the step."""
    measures = isinstance(band, Tolerance)
    least, most = (half, size) if measures else (half / size, 1.0)
    unit = 10.0 ** (floor(log10(least)) - 2)
    rounded = ceil(least / unit * (1 - COUNT_TOLERANCE)) * unit
    shown = write_value(rounded, measured, 3) if measures else f"{rounded:.3g}"
    return f"take band = {shown} or more, " if rounded < most else "take "


def sees_speed(loop: ClosedLoop) -> bool:
    """Whether the controller sees a speed that an encoder differentiates."""
    return isinstance(loop.sensor, Encoder) and loop.feedback.name != loop.sensor.position
