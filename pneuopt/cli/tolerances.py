"""The numbers that decide in `cli`, each with its unit and what it decides."""


# Init

SAMPLE_TIMES = (1e-4, 0.02)  # [s]: a controller's; a log with another step was not written by the controller
WIDTH = 80  # characters of a line on the screen

# Run

SHOWN_REASON = 160
"""Length of an unforeseen error's words on the screen [character]: more fills it; the file has them all."""
PATIENCE = 1.7
"""Time that a command may take to end [s]: more looks like a hang; less throws away what it was about to write."""
RETURN = 0.02
"""Time until a lost interruption comes again [s]: less may meet the same destructor; more delays the end."""
EXIT_SUCCESS = 0
EXIT_FAILURE = 1
"""Not converged, not certified, or a model that misses the logs so far that no interval holds; in a study a case failed
or never settles."""
EXIT_BAD_INPUT = 2
"""Something that the user gave cannot be used. Typer ends with the same number where an option is wrong."""
EXIT_UNFORESEEN = 70
"""An error that nobody foresaw, sysexits' EX_SOFTWARE: one line names a file with the details."""
EXIT_OUTPUT_LOST = 74
"""What stands on the screen could not be written, sysexits' EX_IOERR; the files that were asked for are."""
EXIT_INTERRUPTED = 130
"""Ctrl-C: 128 + the number of SIGINT, as shells have it; SIGTERM gives 143."""

# Shared

SECONDS_A_LINE = 5.0
"""Time between two lines of progress [s] where there is no terminal: less fills a record, more looks like a hang."""

# Study

MAX_MAP_AXES = 2
"""Axes up to which a study has a map: of more no figure can be read."""
MAX_CASE_ROWS, MAX_FAILURE_REASONS = 40, 5
"""Rows and reasons that a study shows: more scroll the verdict away."""
MAX_GAIN_COLUMNS = 6
"""Gains that a front shows: more do not fit a terminal of 80 columns."""
