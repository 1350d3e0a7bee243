"""The numbers that decide in `export`, each with its unit and what it decides."""

# Names and texts

MAX_IDENTIFIER = 40  # [character] Rockwell's controllers cut longer names (1756-PM012, "Tag names"), C99 takes 63
UNNAMED_CONSTANTS = (0.5, 1.0, 2.0)  # [s] sample times that are found in many formulas, where their name would mislead
SELECT = -1  # the operation "where a condition holds, this, else that", which CasADi has in four parts

# Numbers of languages and blocks

LARGEST_LITERAL = 1e38  # for infinity: from 3.4E38 on some refuse an LREAL's literal that is no REAL (matiec, issue 12)
SMALLEST_LITERAL = 1e-37  # for what is nearer to zero: below 1.2E-38 they refuse it, and zero would divide by zero
TIME_GRAIN = 1e-3  # [s] in which IEC 61131-3's TIME counts on most controllers: times of a block are rounded to it
USUAL_UPDATE = 0.01  # [s] where the update times of Rockwell's PID begin that are usual

# The exported test

RUN_TOLERANCE = 1e-12  # of the largest output: what sums in another order may differ by after that many
