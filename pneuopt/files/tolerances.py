"""The numbers that decide in `files`, each with its unit and what it decides."""


# Certificate

CHECKSUM_DIGITS = 12
"""Significant digits of a number in the checksum: fewer miss an edit, more depend on the last bit of a conversion."""
MAX_CHANGES = 8
"""Changes that are told one by one, at most: more bury the first; a fit of other logs changes every estimate."""

# Drive

COVARIANCE_ROUNDING = 1e-8
"""Asymmetry of a covariance, over the deviations of its row and column [1]: a file that was rounded by hand; more
is another matrix."""

# First files

SWEEP = (0.8, 1.0, 1.2)  # of a first study's parameter, times its value: near enough that one design may hold
DIGITS = 6
SAMPLES_A_DITHER_PERIOD = 5  # of a slow controller, for which the usual dither would be too fast
COMMENT_WIDTH = 108  # characters of a line of comment

# Keys

SHARED_BY = 3  # requirements that have the same key: one row stands for all
COMMENT_COLUMN, MAX_WIDTH = 44, 110  # characters: a comment begins there, or above its key where the line is too long

# Loop

MAX_CASES = 20_000
"""Plants or cells that a file may ask for [1]: more take days and gigabytes; fewer refuse a map of 100 by 100."""
MAX_OPTION = 1_000_000
"""A whole number among a method's options [1]: a thousand times more fill the memory; fewer refuse a long search."""
SAMPLE_TIME = 1e-3
"""Of a first controller, and of usual values that count in samples [s]: a common one; longer ones slow a loop down."""

# Study

DEFAULT_POINTS = 9  # designs of a front: each is a tuning, so more take long; fewer hide the bend

# Tuned

SAME_GAINS = 1e-8  # relative: a file holds nine digits of a gain
