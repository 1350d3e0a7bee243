"""`BlockForm`: what is known of a maker's PID block; `Design`: the numbers of a controller that such a block takes."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from pneuopt.control.pid import ParallelForm
from pneuopt.quantities.errors import require
from pneuopt.quantities.units import write_value

BEHIND_OFFSET = "Behind the block: offset"
BEHIND_FACTOR = "Behind the block: factor"
"""Settings of what the user's own program does with a block's output: ``wire = offset + factor output``."""
PLAIN_WEIGHT = 0.5  # [1] of the set-point weights 0 and 1 a block takes the nearer one


@dataclass(frozen=True)
class Design:
    """The numbers of a tuned controller that a block takes, in SI units.

    Parameters
    ----------
    gains : ParallelForm
    b, c : float
    Tt : float
        Of back-calculation [s]; nan where the design has another anti-windup or none.
    low, high : float
        Ends of the output on the wire [the command's unit]; infinite for none.
    centre : float
        On the wire while the command is zero.
    sample_time : float
    measured, measured_unit, command_unit : str
    pv_low, pv_high : float
        The range of the process value that the block counts on [the measured unit].
    start : float
        The process value where the references begin [the measured unit].
    is_added_to : bool
        Whether a feedforward or a dither is added to what the block computes, before the limits.
    goes : str
        Where the output goes.
    zero : str
        What the command zero is.
    reach : str
        What the range of the process value holds.
    """

    gains: ParallelForm
    b: float
    c: float
    Tt: float
    low: float
    high: float
    centre: float
    sample_time: float
    measured: str
    measured_unit: str
    command_unit: str
    pv_low: float = -0.5
    pv_high: float = 0.5
    start: float = 0.0
    is_added_to: bool = False
    goes: str = "on the wire"
    zero: str = "the centre"
    reach: str = "the references and as far again"

    @property
    def span(self) -> float:
        """Of the output [the command's unit]; infinite without limits."""
        return self.high - self.low

    @property
    def pv_span(self) -> float:
        """Of the process value [the measured unit]."""
        return self.pv_high - self.pv_low

    @property
    def rest(self) -> float:
        """The centre as a part of the output's span [%]."""
        return 100.0 * (self.centre - self.low) / self.span

    @property
    def limits(self) -> tuple[float, float]:
        """Of the command about the centre."""
        return self.low - self.centre, self.high - self.centre

    @property
    def integrates(self) -> bool:
        """Whether there is an integral at all."""
        return self.gains.Ki != 0

    @property
    def sum_words(self) -> str:
        """Behind a setting that the sum of the surroundings is added to in the program; "" without one."""
        return "; with the sum above" if self.is_added_to else ""

    @property
    def is_open(self) -> bool:
        """Whether a block that is added to behind its limits leaves them open: without an integral none needs them."""
        return self.is_added_to and not self.integrates

    @property
    def differentiates(self) -> bool:
        """Whether there is a derivative at all."""
        return self.gains.Kd != 0


class Setting(NamedTuple):
    """A field of a block: its name, its value as it is typed in, and by what formula or why."""

    name: str
    value: str
    formula: str


@dataclass(frozen=True)
class BlockForm:
    """What is known of a block.

    Attributes
    ----------
    title, formula : str
    sources : tuple of str
    settings : callable
        From a `Design`; raises `InputError` for gains that the block cannot have.
    states : callable
        What the output is at rest, at a fault and while the block is stopped, from a `Design`.
    manual : str
        How it is held in manual at the centre.
    added : callable, optional
        Where a signal in the command's unit is added before the limits, from a `Design`; None: the block has no such
        input.
    weights : callable
        The set-point weights b and c that the block has in place of a design's own.
    has_filter : bool
        Whether its derivative has a filter of first order that can be set.
    clamps : bool
        Whether its integral is clamped at a limit, or may be taken to be.
    time_grain : float
        What its times are rounded to [s]; 0 for nothing.
    """

    title: str
    formula: str
    sources: tuple[str, ...]
    settings: Callable[[Design], list[Setting]]
    states: Callable[[Design], list[str]]
    manual: str
    added: Callable[[Design], str] | None = None
    weights: Callable[[Design], tuple[float, float]] = lambda d: (d.b, d.c)
    has_filter: bool = True
    clamps: bool = True
    time_grain: float = 0.0

    @property
    def maker(self) -> str:
        """The first word of the title."""
        return self.title.partition(" ")[0]

    @property
    def is_inferred(self) -> bool:
        """Whether its formula is read from the parameters' descriptions, and not from the maker's own text."""
        return any(source.startswith("INFERRED: the pages draw") for source in self.sources)


def number(value: float) -> str:
    """A number as it is typed in."""
    return f"{value:.9g}"


def flag(value: bool) -> str:
    """TRUE or FALSE, as IEC 61131-3 writes it."""
    return str(value).upper()


def nearest_weight(value: float) -> float:
    """Of the weights 0 and 1 the nearer one."""
    return 0.0 if value < PLAIN_WEIGHT else 1.0


def wire(value: float, design: Design) -> str:
    """An output in its unit."""
    return write_value(value, design.command_unit)


def check_limits(design: Design, block: str) -> None:
    """Refuse a design without limits where the block counts its output in percent of them."""
    told = f"{block} counts its output in percent of the command's range, and this design has no limits"
    remedy = "state limits under [pid] of tuning.toml and tune again, or use --to st"
    require(math.isfinite(design.span), f"{told}; {remedy}")


def standard_times(design: Design, block: str) -> tuple[float, float]:
    """Ti, infinite for no integral, and Td [s] of a block whose gain multiplies all its terms.

    Raises
    ------
    InputError
        If Kp = 0 while another gain is not.
    """
    Kp, Ki, Kd = design.gains.Kp, design.gains.Ki, design.gains.Kd
    told = f"{block} multiplies its integral and its derivative by its gain"
    given = f"this design has Kp = 0, Ki = {Ki:g}, Kd = {Kd:g}"
    require(Kp != 0 or Ki == Kd == 0, f"{told}, and {given}: it cannot have them; use --to st")
    return Kp / Ki if Ki else math.inf, Kd / Kp if Kp else 0.0


def direction(design: Design, block: str) -> float:
    """1, or -1 of a design whose gains are negative; refuses gains of both signs."""
    Kp, Ki, Kd = design.gains.Kp, design.gains.Ki, design.gains.Kd
    signs = {math.copysign(1.0, g) for g in (Kp, Ki, Kd) if g}
    told = f"{block} has one sign for all its gains, and this design has Kp = {Kp:g}, Ki = {Ki:g}, Kd = {Kd:g}"
    require(len(signs) < 2, f"{told}; use --to st")
    return signs.pop() if signs else 1.0
