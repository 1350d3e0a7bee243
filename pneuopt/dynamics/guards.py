"""Which hardware a plant refuses (`HardwareCheckHook`), and where its model ends (`ValidityLimit`, `Contact`)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from pneuopt.quantities.parameters import ParameterSet, Quantity
from pneuopt.quantities.units import write_value


class HardwareCheckHook(Protocol):
    """What a model knows about hardware that cannot exist."""

    def __call__(self, parameters: ParameterSet, start: Mapping[str, float] | None = None) -> None:
        """Raise `InputError` for an impossible number, or for a start (by state) where the plant cannot be."""
        ...


@dataclass(frozen=True)
class ValidityLimit:
    """A value of a state beyond which a response is no longer what the model is meant for: an end stop, a vacuum.

    Attributes
    ----------
    state : str
    limit : callable
        From the plant's parameters, all of them, to the value [the state's unit].
    side : int
        1 where the state normally lies below the limit, -1 above.
    event : str
        What happens there, "the piston reached the front end stop".
    meaning : str
        What the response is from there on, "the response is the stop's".
    """

    state: str
    limit: Callable[[ParameterSet], float]
    side: int
    event: str
    meaning: str


@dataclass(frozen=True)
class Contact:
    """A guard that a response has run into; printed, it is the sentence that a user reads.

    Attributes
    ----------
    t : float
        When, for the first time [s].
    value, rate : float
        The state there and its rate [its unit, and that over s].
    state : Quantity
    validity_limit : Guard
    """

    t: float
    value: float
    rate: float
    state: Quantity
    validity_limit: ValidityLimit

    def __str__(self) -> str:
        where = f"{self.state.name} {write_value(self.value, self.state.unit, 4)}"
        speed = f" with {self.rate:.3g} m/s" if self.state.unit == "m" else ""
        limit = self.validity_limit
        return f"{limit.event} ({where}) at t = {self.t:.4g} s{speed}; from there {limit.meaning}"
