"""The numbers that decide in `report`, all of the sliders that move a page's loop."""

RESIDUAL = 1e-6
"""Share of a state's nominal size, a second, that counts as zero: what a rest's own root searches leave is below."""
UNCHANGED_RATIO, UNCHANGED_LEAST = 1e-9, 1e-12
"""When two rests are one, as a share and in SI: below these a response cannot be told from the other."""
INDEPENDENT = 1e-9
"""Least share of the largest singular value of the residuals' slopes: below it a direction is undetermined."""
SLIDER_RANGE = 3.0
"""Ratio of a slider's ends to its value where no bounds say more: less hides what changes."""
INCLINE = 0.5
"""Share of the load's weight, either way, that a load's force is moved by: as if its axis were tilted by 30 degrees."""
SHRINKAGES = 4
"""How often the way to a slider's end is halved where the loop cannot rest there; beyond it is hardly a way."""
LOG_RANGE = 20.0
"""Ratio of a slider's ends from which it is logarithmic: else most of its way is one value."""
