"""The numbers that decide in `studies`, each with its unit and what it decides."""

# Batch

# plants that a core runs before they are read: fewer fill no lanes; the responses of more leave its cache, for fresh
# pages, and 16 take two fifths longer
CHUNK_A_CORE = 8
# plants, beside those with an extreme value, whose fastest mode is sought: fewer may miss a stiff one, on which RK4 is
# then unstable; each more costs an eigenvalue problem a plant and state
MAX_PROBED = 64
RATE_MARGIN = 1.2  # factor on the fastest mode found [1]: the plants that are not probed may be faster by that much
SAME_START = 1e-9  # share of nominal sizes [1] by which starts differ by rounding: at 0 each plant's is computed anew

# Bootstrap

# share of a channel's range [1] by which a simulated log may leave the fitted one: with more its motion is another than
# the log's, with less the log falls into short parts, each with a start of its own, which tell less
MAX_WANDER = 0.1
MIN_ROWS = 50  # rows of a part of a log: a shorter one hardly tells more than its own start
# chance [1] of so few intervals that hold the value, if each did so 95 times in 100, below which they are told: with a
# larger one good intervals are told too often, with a smaller one twenty draws tell nothing
MIN_CHANCE = 0.01
SIGNIFICANT = 3.0  # deviations [1] of a mean from the value from which it is a bias, and no chance

# Executors

TRIES = 2  # runs of a case whose process dies [1]: a second one tells a case that kills from a machine that went away
MAX_PROCESSES = 60  # at once: Windows cannot wait for more than 63, and each takes memory for CasADi and the model
LIMIT_SHARE = 0.25  # of a case's time limit that a chunk shall take [1]: one that takes all of it is cut up
# workers [1] of an executor that does not say how many it has, or of a cluster that may grow: more make chunks so small
# that each costs more to send than to compute, fewer leave workers idle
UNKNOWN_WORKERS = 64
CONNECT_SECONDS = 10.0  # patience with a scheduler [s]: shorter gives up on a slow net, longer looks like a hang

# Journal

REWRITE_SECONDS = 5.0  # least time between two Parquet files [s]: less writes without end, more is lost with a kill
REWRITE_SHARE = 0.05  # most of the time that may go into writing them [1]
# time between two waits for the disk [s]: only what came since is lost where the machine itself loses power; a wait a
# case slows quick cases down; a process that is killed loses nothing
SYNC_SECONDS = 1.0

# Neighbours

# ratio to the best neighbour from which a cell breaks with it: a smaller one computes cells again on a steep slope, a
# larger one leaves local optima in the table
BREAK_RATIO = 3.0

# Sensitivity

MAX_LOST = 0.1  # share of points [1] without a figure, beyond which its indices would tell of other plants
# part of a standard deviation by which a response is moved along its sensitivity [1]: with a larger one a figure that
# bends is off, with a smaller one its digits are lost in the difference; and the same for the state before the step,
# which is found by iteration, to fewer digits
SIDE, START_SIDE = 1e-4, 1e-3

# Sweep

MAX_TABLE_BYTES = 2**28  # of cases, 256 MiB: more fill the memory; less refuses a million cases of ten parameters
