"""What a friction law declares so that an identification starts from logs without a guess (see `starts.friction`)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from pneuopt.quantities.arrays import Array


@dataclass(frozen=True, eq=False)
class FrictionSamples:
    """What a log shows of friction; arrays of shape (n,), parameters and inputs by the law's own names.

    Attributes
    ----------
    speed : ndarray
        Filtered [m/s].
    side : ndarray
        The sign of the speed, smooth over the law's `smoothing`; where the drive is about to give way, the side to
        which it is pulled.
    level_speed : ndarray
        The speed at which a level is to be read [m/s]: zero where the drive is about to give way.
    inputs : mapping of str to ndarray
    values : mapping of str to float
        The law's parameters as given; of the scanned ones the value that is tried.
    """

    speed: Array
    side: Array
    level_speed: Array
    inputs: Mapping[str, Array]
    values: Mapping[str, float]


@dataclass(frozen=True)
class Bristles:
    """How internal deflections start: their stiffness is the slope of the force while they only bend.

    Parameters
    ----------
    stiffness, level : str
        Parameters: that slope [N/m], and the sliding force [N] well below which they only bend.
    range : tuple of float
        Stiffnesses that a start may have [N/m]; softer ones bend for millimetres, stiffer ones need steps below 1 us.
    deflections : callable
        ``(force, speed, values)``: the friction force [N], the speed [m/s] and the law's parameters to its states.
    """

    stiffness: str
    level: str
    range: tuple[float, float]
    deflections: Callable[[Array, Array, Mapping[str, float]], dict[str, Array]]


@dataclass(frozen=True)
class FrictionStart:
    """A law as a regression on logs sees it: ``force = sum(column * parameter)`` once the scanned parameters are given.

    Parameters
    ----------
    columns : callable
        From `FrictionSamples` to what multiplies each parameter, by name.
    unknowns : tuple of str
        The parameters that logs are asked for where nothing else is said.
    floors : mapping of str to float
        The least value that the regression may find, over the median force [1]; it keeps friction from pushing.
    above : mapping of str to str
        Parameters whose column multiplies what they exceed another one by: static friction above Coulomb's.
    scanned : mapping of str to tuple of float
        Parameters on which the force does not depend linearly, and the values to try, the most promising first.
    bristles : Bristles, optional
        Of a law with internal states.
    """

    columns: Callable[[FrictionSamples], dict[str, Array]]
    unknowns: tuple[str, ...]
    floors: Mapping[str, float] = field(default_factory=dict)
    above: Mapping[str, str] = field(default_factory=dict)
    scanned: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    bristles: Bristles | None = None
