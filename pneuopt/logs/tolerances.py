"""The numbers that decide in `logs`, each with its unit and what it decides."""


# Columns

MIN_SAMPLES = 10
"""The fewest samples of a log: with fewer its noise level is a guess; a larger bound refuses logs that are enough."""
MAX_MAGNITUDE = 1e30
"""Magnitude of a sample in the file's unit [1]: more is the 9.91e37 by which instruments say overload; a smaller bound
refuses counts."""
MAX_NAME_PARTS = 8
"""Words of a column's name that are compared with channels [1]: each costs a search; no channel has more than three."""

# Doctor

LARGE_SHARE = 0.1
"""Share of a signal's largest value [1] beyond which its sign counts: lower counts noise, higher misses reversals."""
VIEW_STROKES = 1.0
"""Strokes to either side of an instant that a figure shows: with fewer a wrong sign looks like a lag, more blur it."""
MIN_VIEW_SAMPLES = 25
"""Samples to either side of an instant that its figure shows: fewer look like noise."""
MIN_RESIDUAL_FACTOR = 2.0
"""Residual with the stated value over that with the log's own [1]: lower blames values for what no model has, higher
leaves wrong ones to the fit, which ends in a misfit."""
MAX_UNEXPLAINED = 0.15
"""Residual of the balance over the spread of the force [1] up to which it says something: higher lets a balance speak
that holds for nothing, lower skips noisy forces."""
MIN_CONTRADICTION = 0.1
"""Residual with the stated value over the spread of the force [1] that is worth a word: lower blames a light mass whose
force the sensors' lags hide, and a right one that sticks and slips, as its friction falls while it speeds up (6 % of
the force); higher passes wrong ones in slow motion."""
MAX_MASS_FACTOR = 1.5
"""Factor [1] by which a stated mass may be off: lower blames what lags of sensors do, higher passes a lost carriage."""
MIN_OFFSET_SHARE = 0.2
"""Offset over friction [1] that is worth a word: lower speaks of every sensor, higher passes what moves estimates."""
MAX_ATMOSPHERE_ERROR = 0.2
"""Share [1] by which an offset may miss one atmosphere on the difference of a piston's areas: lower forgets gauge
pressures on a log with noise, higher blames their unit for another force."""
MAX_NOISE_SHARE = 2e-3
"""Share of the accelerations' variance [1] that noise may have: higher makes masses small, lower blurs fast motion."""
MIN_HATS = 30
"""Windows each way [1] that a balance needs: fewer fit any mass."""
MAX_PHASE_STEP = 0.25
"""Phase of the motion from sample to sample [rad]: higher leaves lags of a part of a sample, which look like a mass."""
LAG_STEPS = 20
"""Lags each way that are tried: fewer leave a lag of milliseconds, which looks like a mass under viscous friction."""
MAX_HATS = 2000
"""Windows that are used of a log [1]: more cost time and say the same."""
MOST_MOTION = 0.5
"""Share of a log in motion [1] below which it is one of moves and dwells: higher notes every log that pauses."""
LEAST_SPEED, LEAST_WAY = 0.01, 0.002
"""Speed and way over the log's largest [1] of a move: lower counts flicker, higher loses slow, short ones."""
NOISE_WIDTHS, LOWER_QUARTILE = 4.0, 0.3186
"""Standard deviations of noise beyond which a speed is motion [1], fewer find moves in noise; and how many of them the
lower quartile of noise alone is."""
FAST_PERCENTILE, LARGEST_NOISE = 98, 0.1
"""Percentile of the speeds that is fast motion, and share of it [1] that noise may have: a higher percentile takes two
jumps of a sensor for moves, a larger share motion of all speeds for noise."""
SHORTEST_DWELL = 0.05
"""Rest [s] during which a move goes on: a shorter one counts a move that sticks on its way as two."""
MIN_STOP_FORCE_RATIO = 2.5
"""Push at rest at an end over what holds or moves the body elsewhere [1]: lower takes static friction for a stop,
higher misses stops under a weak push."""
MIN_STOP_TIME = 0.05
"""Time [s] of pushing against a stop: shorter takes a reversal for one, longer misses a bounce."""
MIN_STOP_SAMPLES = 10
"""Samples of the same: fewer take noise for a stop, more miss stops in logs of 100 Hz."""
STOP_WIDTH = 6.0
"""Noise [1] within which positions at a stop lie: lower cuts a stop in pieces, higher takes slow reversals for one."""
STOP_SHARE = 2e-3
"""Share of the way [1] by which a stop gives in: lower misses soft stops, higher takes slow reversals for them."""
STATED_STOP_SHARE = 0.05
"""Share of the way [1] by which a stated stop may be off: lower blames a sensor's zero, higher a wrong stroke."""
MIN_JUMP_NOISE = 30.0
"""Jump over the noise [1]: lower takes outliers and steps of an encoder for jumps, higher misses small ones."""
MIN_JUMP_SPEED_RATIO = 5.0
"""Speed of a jump over that of the motion around it, and of most of the log [1]: lower takes short strokes in coarse
logs for jumps, higher misses jumps of fast motion."""
MIN_JUMP_ACCELERATION = 500.0
"""Acceleration [m/s^2] that a jump needs at least, to start and to stop within a sample: short-stroke cylinders reach
less, higher misses jumps in logs of 100 Hz."""
NEIGHBOURS = 3
"""Samples beside a jump that show the motion around it: with fewer an outlier is one, more miss short ones."""
USUAL_SPEED_QUANTILE = 0.98
"""Share of a log's samples [1] that move no faster than its usual speed: higher counts the jumps among them."""
MEAN_BLOCKS = 20
"""Blocks of a log whose means separate motion from noise: with more their means are noisy, with fewer hide motion."""
MAX_SENSOR_LAG = 0.02
"""Time [s] by which one sensor may come later than another: shorter takes a filter's lag in fast motion for a wrong
sign, longer misses wrong signs of motion at a few hertz."""
MAX_SLOPE_NOISE_SHARE = 0.1
"""Share of a slope's variance [1] that noise may have: higher drowns the work in it, lower blurs fast motion."""
MIN_PRESSURE_RATIO = 0.3
"""Lowest pressure over the atmosphere [1] that counts as absolute: no chamber is exhausted further. A lower bound
lets gauge readings pass, a higher one refuses sensors with an offset."""
MAX_PRESSURE = 1e7
"""Pressure [Pa] that no pneumatic drive has, 100 bar; lower blames blow moulding, higher misses units."""
CLIPPED_SHARE = 0.02
"""Share of samples at the largest value [1] that looks clipped: lower blames rest, higher misses short clipping."""
MAX_NET_TRAVEL_SHARE = 0.3
"""Net travel over path [1] up to which a log counts as one that returns: higher blames lifts, lower skips most logs."""
MIN_WORK_SHARE = -0.2
"""Work over the integral of the absolute power [1] below which the sign is wrong: nearer to zero, noise is blamed."""
ROD_AREA_RATIOS = (0.7, 0.75, 0.8, 0.85, 0.9, 0.95, 1.0)
"""Areas of the rod's side over the other's [1]: one of these is near for real cylinders; more hide wrong signs."""
SPEED_SLOPE_RATIOS = (0.5, 2.0)
"""Speed over the position's slope [1] that passes: wider lets wrong units pass, inches for centimetres say; narrower
refuses filtered speeds of fast motion."""
MIN_SPEED_CORRELATION = 0.7
"""Correlation [1] of speed and slope from which they are compared: lower compares noise, higher misses short motion."""
MAX_COMMAND_LAG = 0.1
"""Time [s] within which a drive's speed follows its valve: longer finds chance correlations, shorter misses drives."""
WRONG_SIGN_CORRELATIONS = (-0.6, 0.3)
"""The sign is wrong if the least correlation of command and speed is below the first, the largest below the second."""
RECIPROCATING_TRAVEL_RATIO = 1.9
"""Travel over range [1]: at 2 a piston has come back, so it is commanded; a lower bound blames overshoot."""
MAX_WHITE_LAG = 20
"""Lags [samples] that white noise leaves uncorrelated: with one, motion at a quarter of the rate looks white."""
STILL_STEPS = 2.0
"""Range at rest in steps of the resolution [1]: more takes small motion for rest, fewer flicker for motion."""
MAX_PISTON_SPEED = 50.0
"""Speed [m/s] that no piston or linear servo has; lower blames fast ones, higher misses slow ones in mm."""
MIN_SPLINE = 4
"""Samples of a channel through which a cubic spline runs."""
MAX_STEPS_BETWEEN = 5.0
"""Time between two samples of a channel over its usual one [1] from which it is a hole: nobody knows what was there."""

# Foreign

MAX_DEPTH = 4
"""Structures in structures [1]: dSPACE's have 2; more depth finds numbers that are settings."""
MAX_LEVELS = 8
"""Structures in each other [1]: more overflow a stack; MATLAB's own logs have four."""
HEAD_BYTES = 128
"""Length of the file's head [byte]; its last two say the order of bytes."""
MATRIX, COMPRESSED = 14, 15
MAX_SHEET_ROWS = 2**20
"""Rows of a sheet [1]: Excel's own bound."""
MAX_EMPTY_ROWS = 10_000
"""Empty rows one after another [1]: a single stray cell far below makes a million, which take seconds."""
MAX_DAYS = 2958466
"""Days of a date [1]: Excel's last, in the year 9999; more overflow as seconds."""

# Guess

VACUUM_LIMIT = 0.9e5  # [Pa]: a chamber between supply and surroundings is never below; what is, counts from ambient
CENTRES = (3.0, 7.0)  # [V]: a command of 0 to 10 V that rests between these is counted from its centre, 5 V
SHOWN_CENTRES = (4.0, 6.0)
"""[V]: where a command of 0 to 10 V that rests between these is logged as it is, its valve's centre is estimated: wider
leaves a command to `identify` that it does not take for one about 5 V, narrower rounds a centre to 5 V that is not."""
RANGE = (-0.3, 10.5)  # [V] of such a command, with the error of its converter

# Mending

MAX_ROWS_OUT = 0.05
"""Share of the rows [1] that may be left out: with more the log is two recordings, or its time too coarse, and what is
left misleads; with fewer a logger that stutters is not mended."""
MAX_ROWS_LISTED = 8
"""Rows that a change lists [1]: more fill the screen, fewer leave short lists open."""

# Noise

ORDERS = (
    1,
    2,
    3,
    4,
    6,
    8,
    10,
)  # of the differences; without the high ones motion at a tenth of the rate counts as noise
# Differences of a block; shorter blocks have uncertain levels, longer ones leave none that is quiet.
BLOCK = 100
MIN_BLOCKS = 4  # with fewer a quarter of them is none
QUIET_QUARTILE = -0.674  # of a normal variable: a quarter of the blocks need to be quiet
MAD_SPREAD = 1.17  # standard deviation of the median absolute deviation of n normal numbers, over itself, times sqrt(n)
# Correlation [1] of differences at this many lags beyond their length, above which they are motion or hum: noise has
# none, and a sine of any frequency nearly 1; lower, filtered noise counts as motion.
MAX_CORRELATION, WHITE_LAGS = 0.2, 20
# Distance of a value from the lattice of a resolution, in its steps [1]: rounded decimals lie nearer, noise farther.
LATTICE_TOLERANCE = 0.02
ROUNDING = 1e-12  # share of the largest value [1] that is rounding of doubles; above, fine steps are missed

# Read log

STAMP_BYTES = 20_000
"""Bytes of a log in which its first time stamp is looked for: longer heads are none of a log."""

# Table

MAX_BYTES = 2**29
"""Size of a log's file [byte], 512 MiB: text takes six times as much memory; smaller refuses an hour at 10 kHz."""
MAX_COLUMNS = 4096
"""Columns of a log [1]: more are rows and columns mistaken for each other; fewer refuse large data loggers."""
MAX_CELLS = 50_000_000
"""Samples of all channels [1], 400 MB: more fill the memory of a small machine; fewer refuse an hour at 1 kHz."""
MAX_NAME = 256
"""Length of a column's name [character]: longer ones are no names, and make messages that nobody can read."""
MAX_SECONDS = 120.0
"""Time for a library [s] in a process of its own: more looks like a hang; less refuses logs of 100 MB."""

# Text

MAX_HEAD_ROWS = 1000
"""Rows above the samples [1]: more take seconds to look through; data loggers write up to a few hundred."""
MIN_BLOCK_ROWS = 4
"""Rows above the names that begin with a number [1] and count as samples: fewer refuse metadata, more lose samples."""
DAY = 86400 * 10**9  # ns
