"""How a command ends: the exit statuses of `pneuopt`, which scripts may rely on."""

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
