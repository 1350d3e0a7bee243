"""The numbers that decide in `files`, each with its unit and what it decides."""

CHECKSUM_DIGITS = 12
"""Significant digits of a number in the checksum: fewer miss an edit, more depend on the last bit of a conversion."""
COVARIANCE_ROUNDING = 1e-8
"""Asymmetry of a covariance, over the deviations of its row and column [1]: a file that was rounded by hand; more
is another matrix."""
FILE_DIGITS = 9
"""Significant digits of a value in fit.toml and tuned.toml: fewer change what was certified, more hide the figure."""
MAX_CASES = 20_000
"""Plants or cells that a file may ask for [1]: more take days and gigabytes; fewer refuse a map of 100 by 100."""
SAMPLE_TIME = 1e-3
"""Of a first controller, and of usual values that count in samples [s]: a common one; longer ones slow a loop down."""
