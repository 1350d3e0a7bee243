"""`EnergyUse`: the energy that a drive draws from its supply or motor while it follows a step."""

from typing import final

from pneuopt.evaluation.metric import AtMost, Metric, Source
from pneuopt.evaluation.step_record import StepRecord, ValuesAndSlopes

POWER_CHANNEL = "power"  # the meter's channel with the power drawn from the plant's source [W]


def energy_rows(record: StepRecord) -> ValuesAndSlopes:
    """Integral of the power from the step to the end of the record [J]."""
    return record.integrate_meter(POWER_CHANNEL)


@final
class EnergyUse(AtMost):
    """Energy that the plant draws from its source, from the step to the end of the horizon [J].

    Which power counts is what the plant's meter shows. Of a pneumatic drive it is the air power: the work that the air
    drawn could do in an isothermal expansion from supply to ambient pressure. An ideal gas of mass m with p V = m R T
    does ``integral of p dV = m R T ln(p_s/p_o)`` on that way, which is p_s V ln(p_s/p_o) for its volume V at the
    supply's state, both pressures absolute; at ambient temperature it is the exergy of the compressed air. A compressor
    takes more by its own losses. Of an axis pushed by a force it is the motor's mechanical power where the motor
    drives, ``max(F v, 0)``: braking power goes into the brake resistor and counts nothing, as in drives that cannot
    feed back.

    Parameters
    ----------
    max : float, optional
        [J]

    References
    ----------
    M. J. Moran, H. N. Shapiro: Fundamentals of Engineering Thermodynamics, Wiley: work of an ideal gas at constant
    temperature, and flow exergy.
    """

    metric = Metric("EnergyUse", "J", Source.METER, slope=energy_rows, channels=(POWER_CHANNEL,))
