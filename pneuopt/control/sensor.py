"""`SensorLag` and `Encoder`: sensors through which the controller sees the measured signal."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import inf
from typing import Any

import casadi as ca

from pneuopt.control.tolerances import SHORTEST_TIME
from pneuopt.dynamics.system import Symbols
from pneuopt.quantities.errors import ModelError, check_names, require
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity
from pneuopt.quantities.units import difference_unit, unit_ratio

Signals = dict[str, ca.SX]
"""Symbolic values by name."""
REFERENCE_SPEED, REFERENCE_ACCELERATION = "reference_speed", "reference_acceleration"
"""The loop's inputs with the rates of the motion that its reference describes; a loop has those that it uses."""


@dataclass(frozen=True)
class SensedSignal:
    """The signal that a sensor reads, and the controller's sample time."""

    measured: Quantity  # the plant's output that the controller wants
    outputs: Mapping[str, Quantity]  # all of the plant's
    sample_time: float | None  # [s], None of a continuous controller
    order: int | None = 1  # as a derivative of the axis's position: 0 itself, 1 its speed; None of any other
    cascade: bool = False  # whether it is the speed of a cascade's inner controller, whose reference is a position

    @property
    def speed_unit(self) -> str:
        """Unit of the speed of the motion that the reference describes; the measured one of any other signal."""
        unit = difference_unit(self.measured.unit)
        return unit_ratio(unit, "s") if self.order == 0 else unit

    @property
    def speed_input(self) -> tuple[str, ...]:
        """The loop's input with the reference's speed; none where the reference is that speed."""
        return (REFERENCE_SPEED,) if self.order == 0 or self.cascade else ()

    @property
    def error_unit(self) -> str:
        """Unit of the error of the signal that the loop is judged by: in a cascade the position's."""
        unit = difference_unit(self.measured.unit)
        return unit_ratio(f"{unit}*s", "1") if self.cascade else unit

    @property
    def h(self) -> float:
        """The sample time [s], 0 of a continuous controller."""
        return self.sample_time or 0.0


@dataclass(frozen=True)
class SensorLag:
    """A sensor of first order: ``d(reading)/dt = (signal - reading)/lag``; the controller sees the reading.

    What an `Encoder` shows of a speed, without its steps: take its filter time and half a sample.

    Parameters
    ----------
    lag : float
        Default of the parameter "sensor.lag" [s].
    """

    lag: float

    def __post_init__(self) -> None:
        require(
            SHORTEST_TIME <= self.lag < inf,
            f"SensorLag: lag must be at least {SHORTEST_TIME:g} s, got {self.lag:g} s; "
            "without a lag leave the sensor out",
        )

    def check(self, _on: SensedSignal) -> None:
        """It fits any signal."""

    def parameters(self, _on: SensedSignal) -> ParameterSet:
        """The lag [s]."""
        return ParameterSet(
            {
                "lag": Parameter(
                    self.lag, "s", lower=SHORTEST_TIME, meaning="lag with which the controller sees the signal"
                )
            }
        )

    def states(self, on: SensedSignal) -> tuple[Quantity, ...]:
        """The reading."""
        return (replace(on.measured, name="reading"),)

    def start(self, y: Mapping[str, float], on: SensedSignal, _p: Mapping[str, float]) -> list[float]:
        """The reading is the truth."""
        return [y[on.measured.name]]

    def rates(self, x: Symbols, y: Symbols, on: SensedSignal, p: Symbols) -> dict[str, ca.SX]:
        """Time derivatives of the states; y are the plant's outputs."""
        return {"reading": (y[on.measured.name] - x["reading"]) / p["lag"]}

    def update(
        self, x: Symbols, _y: Symbols, _on: SensedSignal, _p: Symbols, _elapsed: ca.SX | float
    ) -> dict[str, ca.SX]:
        """The states after a sample: as before."""
        return dict(x)

    def time_constant(self, _on: SensedSignal, p: Mapping[str, Any]) -> Any:
        """Of the loop linearised [s]."""
        return p["lag"]

    def reading_resolution(self, _on: SensedSignal, _p: Mapping[str, float]) -> float:
        """What one count changes the reading by: nothing, it has no counts."""
        return 0.0


@dataclass(frozen=True)
class Encoder:
    """A position in whole counts, read once a sample; of it a speed is the difference, then a first-order low-pass.

    ``q = resolution floor(position/resolution + 1/2)``, and where the controller wants the speed, h its sample time and
    the suffix _ the sample before::

        reading = reading_ + h/(h + filter) ((q - q_)/h - reading_)

    A controller of the position gets q itself. One count is a speed of resolution/h, 10 mm/s for 10 um at 1 ms, which
    the filter divides by ``1 + filter/h``; it begins with the true speed. The loop linearised about the moving
    reference, whose margins count, has a lag of filter + h/2, half a sample being the difference's; the steps, which
    are noise there, it has not.

    Parameters
    ----------
    resolution : float
        Default of the parameter "sensor.resolution" [the position's unit]; 0: a position without steps, no parameter.
    filter : float
        Default of the parameter "sensor.filter", the low-pass's time constant [s]; 0 is none.
    position : str
        The output that it counts.
    """

    resolution: float = 0.0
    filter: float = 5e-3
    position: str = "position"

    def __post_init__(self) -> None:
        for name, unit in (("resolution", ""), ("filter", " s")):
            value = getattr(self, name)
            require(0 <= value < inf, f"Encoder: {name} must not be negative, got {value:g}{unit}; 0 is none")

    def check(self, on: SensedSignal) -> None:
        """Refuse a continuous controller, a plant without a position, and what no difference of it gives."""
        told = "an Encoder is read once a sample: give the PID a sample_time, or take SensorLag(filter + half a sample)"
        require(on.sample_time is not None, told, ModelError)
        check_names("output", [self.position], on.outputs, "Encoder: position")
        unit, measured = on.outputs[self.position].unit, on.measured
        require(
            not self.differentiates(on) or unit_ratio(unit, "s") == unit_ratio(measured.unit, "1"),
            f"Encoder: the difference of {self.position!r} [{unit}] is not {measured.name!r} [{measured.unit}]",
            ModelError,
        )

    def differentiates(self, on: SensedSignal) -> bool:
        """Whether the controller wants the speed, and not the position itself."""
        return on.measured.name != self.position

    def parameters(self, on: SensedSignal) -> ParameterSet:
        """The filter's time constant [s] where there is a speed, and the resolution [the position's unit]."""
        found = (
            {"filter": Parameter(self.filter, "s", lower=0.0, meaning="time constant of the encoder's low-pass")}
            if self.differentiates(on)
            else {}
        )
        if self.resolution:
            unit = on.outputs[self.position].unit
            found["resolution"] = Parameter(
                self.resolution, unit, lower=1e-9 * self.resolution, meaning="one count of the encoder"
            )
        return ParameterSet(found)

    def states(self, on: SensedSignal) -> tuple[Quantity, ...]:
        """The reading, and for a speed the count before."""
        reading = replace(on.measured, name="reading")
        return (reading, replace(on.outputs[self.position], name="count"))[: 1 + self.differentiates(on)]

    def start(self, y: Mapping[str, float], on: SensedSignal, p: Mapping[str, float]) -> list[float]:
        """The speed is the truth, and the count before fits it."""
        now = float(self._quantise(y[self.position], p))
        speed = y[on.measured.name]
        return [speed, now - on.h * speed] if self.differentiates(on) else [now]

    def rates(self, x: Symbols, _y: Symbols, _on: SensedSignal, _p: Symbols) -> dict[str, ca.SX]:
        """Nothing moves between two samples."""
        return {n: ca.SX(0) for n in x}

    def update(self, x: Symbols, y: Symbols, on: SensedSignal, p: Symbols, elapsed: ca.SX | float) -> dict[str, ca.SX]:
        """The states after a sample; y are the plant's outputs, `elapsed` is the time since the last good one [s]."""
        now = self._quantise(y[self.position], p)
        if not self.differentiates(on):
            return {"reading": now}
        step = elapsed / (elapsed + p["filter"]) * ((now - x["count"]) / elapsed - x["reading"])
        return {"reading": x["reading"] + step, "count": now}

    def rest(self, y: Symbols, on: SensedSignal, p: Symbols) -> dict[str, ca.SX]:
        """The states of a body that has stood still: all that a position alone says of a speed."""
        return {"reading": ca.SX(0), "count": self._quantise(y[self.position], p)} if self.differentiates(on) else {}

    def time_constant(self, on: SensedSignal, p: Mapping[str, Any]) -> Any:
        """Of the loop linearised [s]; half a sample of it is the difference's."""
        return p["filter"] + 0.5 * on.h if self.differentiates(on) else 0.0

    def reading_resolution(self, on: SensedSignal, p: Mapping[str, float]) -> float:
        """What one count changes the reading by [measured unit]; 0 without counts."""
        if not self.resolution:
            return 0.0
        return p["resolution"] / (on.h + p["filter"]) if self.differentiates(on) else p["resolution"]

    def _quantise(self, position: Any, p: Mapping[str, Any]) -> Any:
        return p["resolution"] * ca.floor(position / p["resolution"] + 0.5) if self.resolution else position
