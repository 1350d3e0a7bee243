"""Air consumption of a response, in normal litres."""

from pneuopt.evaluation.step_record import StepRecord, ValuesAndSlopes

ANR_DENSITY = 1.185  # density of air in the standard state of ISO 8778 (ANR: 100 kPa, 20 degC, 65 % humidity) [kg/m^3]
LITRES_PER_CUBIC_METRE = 1e3
AIR_CHANNEL = "air"  # the meter's channel with the mass flow drawn from the supply [kg/s]


def air_rows(record: StepRecord) -> ValuesAndSlopes:
    """Volume of the air that is drawn from the step to the end of the record [l(ANR)].

    Examples
    --------
    A gram a second for two seconds:

    >>> import numpy as np
    >>> from pneuopt.evaluation.meter import meter_record
    >>> run = meter_record(np.array([0.0, 1.0, 2.0]), {"air": np.full((1, 3), 1e-3)}, 0.0)
    >>> round(air_rows(run)[0].item(), 4)
    1.6878
    """
    mass, slopes = record.integrate_meter(AIR_CHANNEL)
    factor = LITRES_PER_CUBIC_METRE / ANR_DENSITY
    return factor * mass, factor * slopes
