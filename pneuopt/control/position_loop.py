"""`PositionLoop`: the outer loop of a cascade, which gives the PID the speed that it shall follow."""

from dataclasses import dataclass
from typing import Any, ClassVar

from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.quantities.unit_algebra import difference_unit, unit_ratio

POSITION_GAIN = 10.0  # [1/s] default: a small one creeps in, one near the speed loop's own bandwidth swings


@dataclass(frozen=True)
class PositionLoop:
    """``v_r = Kp (r - y) + weight reference_speed``: the reference of the speed that the PID then controls.

    r and y are the position wanted and the position measured. With a weight of 1 a motion at constant speed is followed
    without an error, with 0 it trails by its speed over Kp. It has no integral: that of a PI of the speed lets no error
    rest, and two integrals in series swing. It is proportional, so there is nothing to start, and nothing to wind up
    beside the PID's integral.

    K. J. Åström and T. Hägglund, Advanced PID Control, ISA 2006, section 12.4 (cascade control).
    """

    section: ClassVar[str] = "position_loop"

    def parameters(self, position_unit: str, speed_unit: str) -> ParameterSet:
        """The gain [1/s] and the weight of the reference's speed [1].

        Examples
        --------
        >>> [(n, p.value, p.unit) for n, p in PositionLoop().parameters("m", "m/s").items()]
        [('Kp', 10.0, '1/s'), ('weight', 1.0, '1')]
        """
        gain = unit_ratio(speed_unit, difference_unit(position_unit))
        return ParameterSet(
            {
                "Kp": Parameter(POSITION_GAIN, gain, lower=0.0, meaning="speed per error of the position"),
                "weight": Parameter(1.0, "1", lower=0.0, meaning="weight of the reference's speed"),
            }
        )

    def set_point(self, reference: Any, speed: Any, position: Any, p: Any) -> Any:
        """The PID's reference v_r, from the reference, its speed, the position measured and the own parameters."""
        return p["Kp"] * (reference - position) + p["weight"] * speed
