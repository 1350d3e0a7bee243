"""Declarations of a friction law from which an identification starts without a guess (see `models.starts.friction`)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from pneuopt.quantities.arrays import Array


@dataclass(frozen=True, eq=False)
class FrictionSamples:
    """Samples of a log for a friction law; arrays of shape (n,), parameters and inputs by the law's names.

    Attributes
    ----------
    speed : ndarray
        Filtered speed [m/s].
    side : ndarray
        The sign of the speed, smooth over the law's `smoothing`; just before break-away, the sign of the force that
        pulls.
    level_speed : ndarray
        The speed at which the friction level applies [m/s]: zero just before break-away.
    values : mapping of str to float
        The law's parameters as given; for a scanned one, the value that is tried.
    """

    speed: Array
    side: Array
    level_speed: Array
    inputs: Mapping[str, Array]
    values: Mapping[str, float]


@dataclass(frozen=True)
class Bristles:
    """Start of bristle deflections: their stiffness is the slope of the force over travel in presliding.

    Parameters
    ----------
    stiffness, level : str
        Names of the parameters for that slope [N/m] and for the sliding force [N], well below which bristles only bend.
    range : tuple of float
        Least and greatest stiffness of a start [N/m]: softer bristles bend for millimetres, stiffer ones need
        integration steps below 1 us.
    deflections : callable
        ``(force, speed, values)`` returns the law's states from the friction force [N], the speed [m/s] and the
        law's parameters.
    """

    stiffness: str
    level: str
    range: tuple[float, float]
    deflections: Callable[[Array, Array, Mapping[str, float]], dict[str, Array]]


@dataclass(frozen=True)
class FrictionStart:
    """A friction law as a linear regression: ``force = sum(column * parameter)`` at given scanned parameters.

    Parameters
    ----------
    columns : callable
        Maps `FrictionSamples` to the regression column of each parameter, by name.
    unknowns : tuple of str
        Parameters that are estimated unless the user frees others.
    floors : mapping of str to float
        Least value in the regression as a share of the median force [1], which keeps friction from driving the load.
    above : mapping of str to str
        Parameters whose column multiplies their excess over another parameter: static friction over Coulomb friction.
    scanned : mapping of str to tuple of float
        Parameters on which the force does not depend linearly, with the values to try, the most promising first.
    bristles : Bristles, optional
        For a law with internal states.
    """

    columns: Callable[[FrictionSamples], dict[str, Array]]
    unknowns: tuple[str, ...]
    floors: Mapping[str, float] = field(default_factory=dict)
    above: Mapping[str, str] = field(default_factory=dict)
    scanned: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    bristles: Bristles | None = None
