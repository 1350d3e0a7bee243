"""The numbers that decide in `experiments`: each with its unit, and what it decides."""

# Design

REACHED_ROOM = 0.02  # [1] of a limit's width, within which it counts as active
LARGEST = 6  # [1] power of the sum that stands for the largest: with a higher one a search sees the worst alone
STATE_RIDGE = 1e-6  # [nominal sizes] information about a node's state that is always there, to keep it invertible
SINGULAR = 1e-13  # [1] of the largest information about a start state, below which it is rounding
UNINFORMED = 1e-12  # [1] the same of the parameters

# Next experiment

MAX_SAMPLES = 1_000_000  # of a run: more take minutes a candidate
MAX_WRONG = 0.5  # [1] relative standard deviation of a draw: wider ones are other plants than the one in hand

# Outlook

SLACK = 1e-3  # [1] of a limit, that counts as kept: a design that was tuned lies on its limits

# Search

CHIRP_RATIO = 4.0  # [1] of a chirp's last to its first frequency
LEAST_AMPLITUDE = 3e-4  # [1] of the range, of the smallest wave: presliding motion needs it, smaller drowns in noise
# [1] shares of the kinds of change of a run, each up to the next: one block, all, an exchanged or copied one; else two
# change places. The first kind refines, the others lead out of where it ends
CHANGES = (0.6, 0.75, 0.9, 0.95)
ALL_BLOCKS_SPREAD = 0.15  # [1] by which blocks that move together move less than one alone
CYCLES_A_SAMPLE = 0.08  # [1] of the highest frequency: a faster wave has corners that the controller cannot play
MIN_SUBSTEPS = 8  # integration steps a sample: fewer miss how a bristle lets go
BLOCKS = 8  # of the shortest run
MOST_REPEATS = 4  # times that the shortest run fits into the duration
BEGIN_SHARE = 0.08  # [1] of the time, for each of the lengths a search begins with
PART_SHARE = 0.6  # [1] of the time left, for a part of the run; the rest mends what its repetition spoils
MIN_BLOCK_SAMPLES = 50  # of a block: shorter ones hold no slow motion
SPREADS = (0.5, 0.2, 0.08)  # [1] of a change, in turn: the largest leave a poor optimum, the smallest find its bottom
ROUNDS_A_SPREAD = 3  # changes of each of them, over the number of blocks
QUIET_CYCLES, MIN_GAIN = 2, 0.01  # cycles over all spreads without such a gain [1], after which a search has ended
QUIET_ROUNDS = 2  # exchanges of each block of the start: a third one changes none
VAGUE = 10.0  # [1] relative standard deviation of what nothing tells, which keeps covariances finite
