"""The numbers that decide in `report`, each with its unit and what it decides."""


# Fit page

MIN_CORRELATED = 2
"""Estimates with a standard deviation from which their correlation is drawn: of one there is none."""

# Live

RESIDUAL = 1e-6
"""Share of a state's nominal size, a second, that counts as zero: what a rest's own root searches leave is below."""
UNCHANGED_RATIO, UNCHANGED_LEAST = 1e-9, 1e-12
"""When two rests are one, as a share and in SI: below these a response cannot be told from the other."""
INDEPENDENT = 1e-9
"""Least share of the largest singular value of the residuals' slopes: below it a direction is undetermined."""
RANGE = 3.0
"""A slider goes from a third to three times its value where no bounds say more: less hides what changes."""
INCLINE = 0.5
"""Share of the load's weight, either way, that a load's force is moved by: as if its axis were tilted by 30 degrees."""
SHRINKAGES = 4
"""How often the way to a slider's end is halved where the loop cannot rest there; beyond it is hardly a way."""
LOG_RANGE = 20.0
"""Ratio of a slider's ends from which it is logarithmic: else most of its way is one value."""

# Page

GAIN_DIGITS = 6
"""Significant digits of converted gains: fewer change the loop that was certified, more are of no controller."""

# Tuning page

MOST_NAMES = 3
"""Logs that a title names: more make it longer than a line."""
