"""How much air a response draws from the supply, in normal litres."""

from pneuopt.evaluation.step_record import StepRecord, ValuesAndSlopes

ANR_DENSITY = 1.185  # [kg/m^3] of air as normal litres count it: ISO 8778 (ANR), 100 kPa, 20 degC, 65 %
LITRES_PER_CUBIC_METRE = 1e3  # in a cubic metre
AIR_CHANNEL = "air"  # of a meter: mass flow from the supply [kg/s]


def air_rows(record: StepRecord) -> ValuesAndSlopes:
    """The volume of the air drawn from the step to the end [l(ANR)].

    Examples
    --------
    A gram a second for two seconds:

    >>> import numpy as np
    >>> from pneuopt.evaluation.meter import metered_record
    >>> run = metered_record(np.array([0.0, 1.0, 2.0]), {"air": np.full((1, 3), 1e-3)}, 0.0)
    >>> round(air_rows(run)[0].item(), 4)
    1.6878
    """
    mass, slopes = record.metered_integral(AIR_CHANNEL)
    factor = LITRES_PER_CUBIC_METRE / ANR_DENSITY
    return factor * mass, factor * slopes
