"""The numbers that decide in `logs`: unit, what each decides, and what a smaller or larger one costs."""

# What a log may cost: bytes, columns, cells, time.
MAX_BYTES = 2**29  # size of a file [byte]: text takes six times as much memory; smaller refuses an hour at 10 kHz
MAX_COLUMNS = 4096  # more are rows and columns mistaken for each other; fewer refuse large data loggers
MAX_CELLS = 50_000_000  # samples of all channels, 400 MB: more fill a small machine; fewer refuse an hour at 1 kHz
MAX_NAME = 256  # length of a column's name [character]: a longer one is none, and makes messages that nobody can read
MAX_SECONDS = 120.0  # time for a library in its own process [s]: more looks like a hang; less refuses logs of 100 MB
MAX_HEAD_ROWS = 1000  # rows above the samples: more take seconds to look through; data loggers write a few hundred
MAX_DEPTH = 4  # structures in structures that are columns: dSPACE's have 2; in deeper ones numbers are settings
MAX_LEVELS = 8  # structures in each other that are read: more overflow a stack
MAX_EMPTY_ROWS = 10_000  # of a sheet, in a row: a single stray cell far below makes a million, which take seconds

# What counts as a sample, a row, a column.
MIN_SAMPLES = 10  # of a log, or of a part whose median says something: fewer are noise; a higher bound misses bounces
MAX_MAGNITUDE = 1e30  # of a sample in the file's unit: more is an instrument's overload (9.91e37); less refuses counts
MIN_BLOCK_ROWS = 4  # of numbers above the names that count as samples: fewer refuse metadata, more lose samples
MAX_ROWS_OUT = 0.05  # share of rows that mending may leave out: with more what is left misleads; fewer help no logger

# What the columns of a foreign log are.
VACUUM_LIMIT = 0.9e5  # [Pa]: a chamber between supply and surroundings is never below; what is, counts from ambient
CENTRES = (3.0, 7.0)  # [V]: a command of 0 to 10 V that rests between these is counted from its centre, 5 V
SHOWN_CENTRES = (4.0, 6.0)  # [V]: if it rests between these, its centre is estimated (`identify` takes no other)
COMMAND_RANGE = (-0.3, 10.5)  # [V] of such a command, with the error of its converter

# Noise of a channel.
ORDERS = (1, 2, 3, 4, 6, 8, 10)  # of differences: without high ones motion at a tenth of the rate counts as noise
BLOCK = 100  # differences of a block: shorter ones have uncertain levels, longer ones leave none that is quiet
WHITE_LAGS = 20  # [samples] at which white noise is uncorrelated: with one, motion at a quarter of the rate looks white
MAX_CORRELATION = 0.2  # of differences at these lags, above which they are motion or hum: lower blames filtered noise
MIN_VARIED_SHARE = 0.01  # of the samples where a sensor's steps change: fewer are a motion at one speed
MAX_OFF_PERIOD = 0.02  # of the changes that chance puts off a slow sensor's rows: less misses one that slips
LATTICE_TOLERANCE = 0.02  # distance from a resolution's lattice, in its steps: rounded decimals lie nearer
ROUNDING = 1e-12  # share of the largest value that is rounding of doubles: above, fine steps are missed

# Motion and rest, for all checks.
LARGE_SHARE = 0.1  # of a signal's largest value, beyond which it counts: lower counts noise, higher misses reversals
MEAN_BLOCKS = 20  # of a log whose means separate motion from noise: more have noisy means, fewer hide motion
MAX_SENSOR_LAG = 0.02  # [s] of one sensor behind another: shorter blames filters in fast motion, longer misses signs
MAX_SLOPE_NOISE_SHARE = 0.1  # of a slope's variance that is noise: higher drowns the work, lower blurs fast motion
MAX_STEPS_BETWEEN = 5.0  # usual steps between two samples of a channel that are a hole: nobody knows what was there
FAST_QUANTILE = 0.98  # of the speeds that is fast motion: higher counts jumps of a sensor as such
SHORTEST_REST = 0.05  # [s]: shorter counts a move that sticks as two, and reversals as stops; longer misses a bounce
LEAST_WAY_SHARE = 2e-3  # of a way that counts as none: lower misses soft stops, higher loses slow, short moves
STILL_STEPS = 2.0  # of the resolution, the range at rest: more takes small motion for rest, fewer flicker for motion
MIN_SPEED_CORRELATION = 0.7  # of speed and slope, to compare them: lower compares noise, higher misses short motion

# Balance of forces.
MIN_RESIDUAL_FACTOR = 2.0  # residual with the stated value over that with the log's own: lower blames what no model has
MAX_UNEXPLAINED = 0.15  # residual over the force's spread, for a balance that holds: lower skips noisy forces
MIN_CONTRADICTION = 0.1  # the same with a stated value that is wrong: lower blames stick-slip (6 % of the force)
MAX_MASS_FACTOR = 1.5  # by which a stated mass may be off: lower blames lags of sensors, higher passes a lost carriage
MIN_OFFSET_SHARE = 0.2  # of friction, an offset worth a word: lower speaks of every sensor
MAX_ATMOSPHERE_ERROR = 0.2  # by which an offset may miss an atmosphere on the rod's area: lower forgets gauge
MAX_NOISE_SHARE = 2e-3  # of the accelerations' variance: higher makes masses small, lower blurs fast motion
MIN_HATS = 30  # windows each way that a balance needs: fewer fit any mass
MAX_REGRESSION_ROWS = 2000  # windows or samples of a log in a regression: more cost time and say the same
MAX_PHASE_STEP = 0.25  # of the motion from sample to sample [rad]: higher leaves lags, which look like a mass
LAG_STEPS = 20  # lags each way that are tried: fewer leave a lag of milliseconds, which looks like a mass

# Moves, stops, jumps.
# share of the stroke by which a position sensor's zero may be off: lower blames usual mounting, higher misses a wrong
# unit or stroke
MAX_POSITION_ZERO_ERROR = 0.05
MOST_MOTION = 0.5  # share of a log in motion below which it is one of moves and dwells: higher notes logs that pause
LEAST_SPEED = 0.01  # over the log's fast motion, of a move: lower counts flicker
NOISE_WIDTHS = 4.0  # standard deviations of noise beyond which a speed is motion: fewer find moves in noise
MIN_STOP_FORCE_RATIO = 2.5  # push at a stop over that elsewhere: lower takes static friction for a stop
STOP_WIDTH = 6.0  # of the noise, positions at a stop: lower cuts a stop in pieces, higher takes slow reversals for one
MIN_JUMP_NOISE = 30.0  # jump over noise: lower takes outliers and steps of an encoder for jumps
MIN_JUMP_SPEED_RATIO = 5.0  # speed of a jump over that around it and over fast motion: lower blames coarse logs
MIN_JUMP_ACCELERATION = 500.0  # [m/s^2] to start and stop within a sample: short-stroke cylinders reach less
NEIGHBOURS = 3  # samples beside a jump that show the motion around it: with fewer an outlier is one

# Sensors, signs, units.
MIN_PRESSURE_RATIO = 0.3  # of the atmosphere: no chamber is exhausted further; a lower bound lets gauge readings pass
MAX_PRESSURE = 1e7  # [Pa] that no pneumatic drive has: lower blames blow moulding, higher misses units
CLIPPED_SHARE = 0.02  # of samples at the largest value: lower blames rest, higher misses short clipping
MAX_NET_TRAVEL_SHARE = 0.3  # of the path, for a log that returns: higher blames lifts, lower skips most logs
MIN_WORK_SHARE = -0.2  # work over the absolute power's integral, of a wrong sign: nearer to zero, noise is blamed
ROD_AREA_RATIOS = (0.7, 0.75, 0.8, 0.85, 0.9, 0.95, 1.0)  # rod's side over the other: one is near for real cylinders
SPEED_SLOPE_RATIOS = (0.5, 2.0)  # speed over slope: wider passes inches for centimetres, narrower refuses filters
MAX_COMMAND_LAG = 0.1  # [s] within which speed follows the valve: longer finds chance correlations
WRONG_SIGN_CORRELATIONS = (-0.6, 0.3)  # least and largest correlation of command and speed below which a sign is wrong
RECIPROCATING_TRAVEL_RATIO = 1.9  # travel over range: at 2 a piston has come back; a lower bound blames overshoot
MAX_PISTON_SPEED = 50.0  # [m/s] that no piston or linear servo has: lower blames fast ones, higher misses mm
