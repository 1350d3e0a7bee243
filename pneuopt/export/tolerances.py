"""The numbers that decide in `export`, each with its unit and what it decides."""


# Blocks

SHEET_WIDTH = 116  # [character] of the sheet's sentences
RANGE_MARGIN = 1.0  # travels of the references that the process value's range goes beyond them, at either end

# Fmu

ZIP_DATE = (1980, 1, 1, 0, 0, 0)  # of the files in an FMU: the same model makes the same bytes

# Identifiers

MAX_IDENTIFIER = 40
"""Length of a name [character]: Rockwell's controllers cut longer ones (1756-PM012, "Tag names"), C99 takes 63."""

# Languages

RUN_SAMPLES = 200
"""Of a test's run: fewer than some 50 pass no limit and no pulse, many more make a long file."""
RUN_TOLERANCE = 1e-12
"""Of the largest output: what sums in another order may differ by, after a run of `RUN_SAMPLES`."""
DROPOUT, GAP, LONGEST_GAP = 60, 100, 30  # samples: while the measured signal rises, and after
RISE = 25.0  # samples in which the measured signal follows: fewer hide the integral, more hide the approach
LARGEST_LITERAL = 1e38
"""In place of infinity: some compilers refuse an LREAL's literal that is no REAL (matiec, issue 12), from 3.4E38 on."""
SMALLEST_LITERAL = 1e-37
"""In place of what is nearer to zero: below 1.2E-38 those compilers refuse it, and zero would divide by zero."""

# Makers

PLAIN_WEIGHT = 0.5  # [1] of the set-point weights 0 and 1 a block takes the nearer one
MINUTE = 60.0  # [s], the unit of times of PIDE
USUAL_UPDATE = 0.01  # [s], where the update times of PID begin that are usual
OPEN_END = 1e38  # an end of the output that is never reached, where the other end is a limit
TIME_GRAIN = 1e-3
"""What IEC 61131-3's TIME counts in on most controllers [s]: times of a block are rounded to it."""
OPEN_LIMIT = 1e38  # what the block is delivered with: no limit

# Program

UNNAMED_CONSTANTS = (0.5, 1.0, 2.0)  # sample times [s] that are found in many formulas, where their name would mislead

# Writer

MAX_INLINE = 70
"""Length of an expression that stands within another [character]: a longer one gets a name of its own; below some 40
each operation has a line, above some 100 lines are too long to read."""
SELECT = -1  # the operation "where a condition holds, this, else that", which CasADi has in four parts
MAX_BLOCK_NAME = 40
"""Length of a block's name [character]: some controllers cut longer ones."""
MAX_COMMENT = 200
"""Length of a text that comes from a file [character]: longer ones fill the header with another's words."""
