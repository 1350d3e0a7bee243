"""`Mark`: how far an estimate can be trusted, and the notes that stand beside one."""

from enum import StrEnum

AT_BOUND_NOTE, UNIDENTIFIABLE_NOTE = "at its bound", "unidentifiable"


class Mark(StrEnum):
    """How far an estimate and its interval can be trusted.

    Attributes
    ----------
    EXACT
        The residuals look like noise; the interval is that of white residuals.
    WIDENED
        The residuals exceed the noise, are correlated, or differ from log to log; the interval counts that.
    BIAS_POSSIBLE
        The model misses a part of the motion, or the estimate is at its bound; no interval holds the error of that. Or
        most of the interval is what a factor of ten in an unidentifiable parameter does, to first order.
    UNIDENTIFIABLE
        The logs do not determine the parameter.
    """

    EXACT = "exact"
    WIDENED = "widened"
    BIAS_POSSIBLE = "bias possible"
    UNIDENTIFIABLE = "unidentifiable"
