"""The numbers that decide in `experiments`, each with its unit and what it decides."""


# Design

REACHED_ROOM = (
    0.02  # share of a limit's width [1] within which it counts as active: less misses what a sample just missed
)
SHOWN_BLOCKS = 8  # of a run [1], in its summary: more fill a screen, and a controller plays the file
USEFUL_RATIO = 1.5  # times that a target's interval shrinks [1], below which the run is hardly worth its time
LARGEST = 6
"""Power of the sum that stands for the largest [1]: with a higher one a search sees the worst alone, and is slow."""
STATE_RIDGE = 1e-6  # information about a node's state that is always there, in nominal sizes: only keeps it invertible
SINGULAR = 1e-13
"""Share of the largest information about a start state [1] below which it is rounding: more keeps what is none."""
UNINFORMED = 1e-12  # the same of the parameters [1]: less takes rounding for knowledge

# Next experiment

MAX_SAMPLES = 1_000_000  # of a run: more take minutes a candidate
MAX_WRONG = 0.5  # relative standard deviation [1] of a draw: wider ones are other plants than the one in hand

# Outlook

SLACK = 1e-3
"""Share of a limit that counts as kept: a design that was tuned lies on its limits."""

# Search

LEVEL_SHARE = 0.15
"""Share of a block [1] in which the excitation moves smoothly to its level: less knocks the axis, more wastes time."""
CHIRP_RATIO = 4.0  # of a chirp's last to its first frequency: less is a sine, more hurries past each
AMPLITUDES = 10  # amplitudes of the library: fewer miss the edge of sticking, which the refinement finds again
FREQUENCIES = 8  # frequencies of the library: as for the amplitudes
LEAST_AMPLITUDE = 3e-4
"""Share of the range [1] of the smallest wave: smaller ones drown in noise, and presliding motion needs this one."""
ONE_BLOCK, ALL_BLOCKS, FRESH_BLOCK, COPIED_BLOCK = 0.6, 0.75, 0.9, 0.95
"""Shares [1], each up to the next, of the kinds of change of a run; the rest moves blocks. The first kind refines, the
others lead out of where it ends."""
ALL_BLOCKS_SPREAD = 0.15
"""By how much less blocks move that move together [1]: as far as one alone, hardly any change is for the better."""
CYCLES_A_SAMPLE = 0.08  # of the highest frequency [1]: a faster wave has corners that the controller cannot play
BATCH_SAMPLES = 400_000  # samples simulated at once: more take memory (100 bytes a sample and signal), fewer lanes
MIN_SUBSTEPS = 8  # integration steps a sample: fewer miss how a bristle lets go
BLOCKS = 8  # of the shortest run: more are refined longer, fewer make poorer mixtures
MOST_REPEATS = 4  # times that the shortest run fits into the duration: more make runs without slow motions
BEGIN_SHARE = 0.08  # of the time [1] for each of the lengths a search begins with: less tells them apart wrongly
PART_SHARE = 0.6  # of the time left [1] for a part of the run: more leaves none to mend what its repetition spoils
MIN_BLOCK_SAMPLES = 50  # of a block: shorter ones hold no slow motion
VARIATIONS = 12  # of a block at once, in SIMD lanes: more are better and take longer
SPREADS = (0.5, 0.2, 0.08)
"""Of a change [1], in turn: the largest leave an optimum that is not the best, the smallest find its bottom."""
ROUNDS_A_SPREAD = 3  # changes of each of them, over the number of blocks: fewer do not find what they can
QUIET_CYCLES = 2  # cycles over all spreads without a gain of `MIN_GAIN`, after which a search has ended
QUIET_ROUNDS = 2  # exchanges of each block of the start: a third one changes none
MIN_GAIN = 0.01  # of the criterion [1] over a cycle: less is not worth the time
VAGUE = 10.0
"""Relative standard deviation [1] of what nothing tells, which keeps covariances finite: less passes for knowledge."""
