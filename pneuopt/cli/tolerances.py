"""The numbers that decide in `cli`, each with its unit and what it decides."""

SAMPLE_TIMES = (1e-4, 0.02)
"""A controller's sample times [s]: a log with another step was not written by the controller."""
PATIENCE = 1.7
"""Time that a command may take to end [s]: more looks like a hang; less throws away what it was about to write."""
RETURN = 0.02
"""Time until a lost interruption comes again [s]: less may meet the same destructor; more delays the end."""
SECONDS_A_LINE = 5.0
"""Time between two lines of progress [s] where there is no terminal: less fills a record, more looks like a hang."""
MAX_MAP_AXES = 2
"""Axes up to which a study has a map: of more no figure can be read."""
