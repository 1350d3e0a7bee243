"""The numbers that decide in `dynamics`, each with its unit and what it decides."""


# Dead time

MAX_PADE_ORDER = 5  # of a dead time in a file; the greatest order whose stability limit with RK4 is known
# Of a dead time in tuning and certificates, whatever a file's: with order 2 a search claims .046 s where it is .12.
# What order 12 lacks is 1e-5 of an overshoot behind a lag as long as the dead time, 1 % of a load's IAE behind one a
# twentieth as long, and a ripple of 1 % of a kicked command before it arrives; claim and certificate have one order.
SIMULATED_PADE_ORDER = 12

# Compiled/compiler

COMPILE_TIMEOUT = 300  # [s]; below, large models on slow machines fall back to the VM; above, a hung compiler blocks
# Age [s] since its last use at which a library is deleted, half a year. Below, models of last month are compiled anew;
# above, those of old versions stay for nothing.
LARGEST_AGE = 180 * 24 * 3600.0
# Size [bytes] of all libraries above which those that were not used for longest are deleted, some thousand models.
# Below, studies of many models compile them again and again; above, it is much for a cache folder.
LARGEST_SIZE = 200 * 2**20
# Time [s] after which a use is noted again, and a folder in which nothing is compiled any more is deleted, a day.
# Below, libraries are written to at each use; above, the order of their use is lost.
NOTICE_TIME = 24 * 3600.0

# Compiled/rollout

# steps of a lane that run to their end in the main thread [1]: more delay Ctrl-C (at 10 us a step by .2 s), fewer make
# short runs wait for a thread (30 us)
BRIEF_STEPS = 20_000
# integration steps of all segments [1] up to which a run is not shared out to threads: lower waits for threads (.3 ms)
# that save less, higher leaves cores idle
UNSHARED_STEPS = 1000
CHECK_SECONDS = 0.1  # between two checks of a long run [s]: longer overruns a CPU budget, shorter takes time itself

# Compiled/self check

# Largest relative distance of machine code from the VM, and of derivatives from differences. Below, roundings count as
# errors (1e-13, and 1e-8 of differences); above, a wrong term of a model may hide.
LARGEST_DISTANCE, LARGEST_DERIVATIVE_ERROR = 1e-9, 1e-5

# Compiled/vm

# Operations, segments times those of the model, that a thread is started for, half a millisecond. Fewer, and starting
# it (50 us) takes the time that it saves; more leave cores idle.
OPERATIONS_A_THREAD = 100_000
# Segments for each thread of CasADi's machine from which arrays are faster. Fewer, and NumPy's calls take longer than
# the arithmetic in them; more leave half of the speed.
ARRAY_SEGMENTS = 120
# Steps of a sample that are written as one Function. More take longer to write; a call of each takes 4 us.
FOLDED_STEPS = 100
# Segments that run at once without machine code. Fewer waste time in calls; more do not fit the processor's cache.
BLOCK_SEGMENTS = 1000

# Integrators

# |lambda h| of a search's steps, dimensionless. RK4 is unstable above 2.78, and rates change within a search; below, a
# stiff plant takes more steps than it needs.
RK4_MAX_H_LAMBDA = 2.0
# |lambda h| of the rates that stay explicit, dimensionless: the method is stable for more, but of second order; higher
# leaves the estimates to the finer steps that follow, lower costs time
PARTITIONED_MAX_H_LAMBDA = 0.15
# h times the largest growth rate of the implicit state by its own, dimensionless: above 3.4 (one over `DIAGONAL`) a
# stage has several solutions, near it its sensitivities are too large; lower costs time
PARTITIONED_MAX_H_GROWTH = 2.0
# iterations for a stage's state: fewer show in the outputs where friction turns its sign, more cost
# time (6 move no output of random_rig.py in problems/shared by a hundredth of the noise, against 45)
SOLVER_ITERATIONS = 7
# the least slope of a stage's equation that is reckoned with [1], by which its solution is enclosed: at
# `PARTITIONED_MAX_H_GROWTH` it is 0.41; lower makes the first enclosure wide, higher may leave out the solution
MIN_SLOPE = 0.25

# Simulate

# Steps of a tight simulation, and the time that one takes, a pneumatic drive's with a compiler: 3e6 are five minutes.
# A smaller budget refuses what users mean; with a larger one a mistyped sample time runs for hours without a word.
MAX_STEPS, SECONDS_A_STEP = 3e6, 1e-4

# Smooth

MAX_INTERNAL_STEPS = 200_000  # LSODA steps between two instants; below, stiff plants stop early; above, it hangs long
# [s] between two checks of the validity limits. Above, a short contact with an end stop is missed; below, simulation is
# slower.
LIMIT_CHECK_PERIOD = 1e-3
ROUNDING_STEP = 8  # units in the last place of the time by which instants are one: LSODA refuses such a step

# Stick slip

MAX_EVENTS = 100_000  # events of a run; below, long runs are refused; above, a chattering loop runs for hours
ROOT_PROBES_PER_STEP = 4  # points of a step at which a root is sought; fewer miss short motions, more cost time
