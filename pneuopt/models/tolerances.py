"""The numbers that decide in `models`, each with its unit and what it decides.

Constants of physics and of standards stand beside their formulas.
"""

# Friction: what a law needs to be smooth, and what a log must show

STICKING_SPEED = 1e-6  # rounding of |v| in LuGre [m/s]: a larger one creeps visibly, a smaller one needs finer steps
MIN_SPEED_RATIO = 3.0  # fast over slow speed [1]: less shows one point of the curve, a larger bound refuses good logs
VISCOUS_SPEED_RATIO = 5.0  # speed over the Stribeck velocity [1] beyond which the static peak hides no viscous friction
MIN_FIT_SAMPLES = (
    20  # samples of a log, or below its Stribeck velocity: fewer are noise, a larger bound refuses good logs
)
MIN_DIRECTION_SHARE = 0.05  # share of the moving samples in the rarer direction [1]: fewer are accidental
MIN_REVERSALS = 2  # reversals of the motion: one alone does not show that presliding repeats
MIN_INERTIA_SHARE = 0.02  # inertia force over the friction level [1]: less is lost in the model's error
ROUNDING_START = (
    0.01  # of a valve's edges [half travels], where a fit begins: wider hides a dead zone, narrower is stiff
)

# Starts of friction from a log

STRIBECK_VELOCITIES = (0.025, 0.012, 0.05, 0.006, 0.1, 0.003)  # that are tried [m/s], most successful first
MIN_COULOMB_SHARE = 0.05  # least Coulomb level of a start as a share of the median force [1]; a search sticks at zero
# least and greatest bristle stiffness of a start [N/m]: softer bristles bend for millimetres, stiffer ones need steps
# below 1 us
BRISTLE_STIFFNESS_RANGE = (1e4, 1e6)
# unexplained share of the force over that with a longer window [1] below which the shorter one is taken: a higher ratio
# takes chance for a better balance, a lower one keeps slips flattened
MIN_BALANCE_GAIN = 0.85
# speed above which a sample shows sliding friction [m/s]: below a smaller one the drive sticks, a larger one drops the
# Stribeck curve
SLIDING_SPEED = 4e-3
SLOW_SPEED = 1e-2  # speed below which friction is near its static level and bristles still bend [m/s]
# ridge on columns of unit length, which splits what no row separates: for motion one way Coulomb friction and a
# constant force; a larger one biases the other parameters, a smaller one leaves the split to rounding
RIDGE_WEIGHT = 1e-2
# least excess of a level (static) over the one below it (Coulomb), as a fraction of that one: with less, a search
# starts without a Stribeck curve and finds none
MIN_LEVEL_EXCESS = 0.03
# travel since the last reversal within which bristles still bend, in bristle deflections: with a smaller one presliding
# counts as sliding, a larger one drops sliding samples
PRESLIDING_DEFLECTIONS = 3.0
STATIC_QUANTILE = 0.995  # quantile of the force in slow samples that counts as static friction; 1 would be an outlier
STATIC_WEIGHT = 0.003  # squared weight of that sample, in sliding samples; with more it bends the whole curve
STUCK_WEIGHT = 10.0  # the same where nothing slides: with less, presliding counts as friction that hardly holds
# spread of the steps [1], over the usual one, that the filter takes as even: above, derivatives of a log that lacks
# samples are wrong; below, every log with jitter is resampled
MAX_JITTER = 0.5
# windows of the Savitzky-Golay filter of order 3 that are tried [s]: shorter ones leave noise in the acceleration,
# longer ones flatten stick and slip of a light load
FILTER_TIMES = (0.031, 0.021, 0.015, 0.011, 0.007)

# Linear plants, their dead time, and sensors

USUAL_PADE_ORDER = 3  # of a dead time in a file: it follows the delay up to 4.6 rad of phase, with three states
# samples of all logs together in the grid search and in the refinement: fewer hide fast plants, more cost time
MAX_GRID_SAMPLES, MAX_REFINEMENT_SAMPLES = 600, 4000
# least dead time that is tried where its bound is 0, over two samples [1]: at 0 the model of a delay divides by it, and
# further below the delay line is needlessly stiff
MIN_DEAD_TIME = 0.05
MAX_STARTS = 4  # candidates that are refined and returned: fewer miss the right one, each costs a refinement
DAMPING_GRID = (0.1, 0.3, 0.7, 1.5, 4.0)  # damping ratios of the grid [1], from ringing to two separate lags

# Pneumatic drives: where the model is smooth, and where it ends

# rounding of the end stops' onset [m], within which a cover pushes before it is reached: with a larger one it shortens
# the stroke, with a smaller one impacts need finer steps
STOP_ROUNDING = 1e-4
MIN_CHAMBER_PRESSURE = 1e3  # absolute pressure [Pa] below which the models are not valid
MAX_COMPRESSION_RATIO = 20.0  # largest chamber pressure over supply pressure [1] that is searched in steady motion
# chamber pressure over ambient pressure [1] below which a chamber counts as empty: lip seals let air in well above it;
# a larger ratio warns of chambers that just exhaust
EMPTY_CHAMBER_RATIO = 0.5
MAX_STOP_TRAVEL = 0.01  # share of the stroke by which a piston that presses on a stop may be outside

# Starts of pneumatic drives

# largest step [s]: a chamber of a few cm^3 at the end of its stroke has a time constant of 1e-4 s, which a larger step
# makes unstable; smaller ones cost time in proportion
MAX_INTEGRATION_STEP = 5e-5
# usual steps [1] of a log that the air is followed over from sample to sample: more cost a hole of seconds thousands of
# integration steps at every sample, fewer cut short a log that lost some samples
MAX_USUAL_STEPS = 20
# values of the valve's shape that are tried where they are free [1], and shifts of its centre [half travels]
VALVE_SHAPE_GRID = {
    "valve.critical_ratio": (0.15, 0.3, 0.45),
    "valve.dead_zone": (0.0, 0.02, 0.05, 0.1, 0.2),
    "valve.centre": (-0.02, 0.0, 0.02),
}
# leaks [1], and conductances over `PneumaticLog.min_conductance` [1], that are tried where no pressure is logged
LEAK_GRID, CONDUCTANCE_FACTORS = (0.003, 0.01, 0.03, 0.1), (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
MIN_LEAK = 1e-4  # least leak of a start [1]: at zero the search would begin on a bound
# first steps of the refinement, factors on conductance and leak, differences of the others [1, centre V]; refinements,
# each with half the step of the last
REFINEMENT_STEPS = {
    "valve.conductance": 1.4,
    "valve.leak": 1.8,
    "valve.critical_ratio": 0.08,
    "valve.dead_zone": 0.02,
    "valve.centre": 0.1,
}
GRID_REFINEMENTS = 5

# Checks of a log's pressures

LEADS = (2e-3, 4e-3, 6e-3, 9e-3, 13e-3, 20e-3, 30e-3, 45e-3)
"""Times [s] by which a line's drop leads that are tried: shorter ones are a sensor's, longer ones no hose has."""
PASSES = 3  # times that the flow is found anew from the corrected pressures: with fewer a large drop is half found
MAX_WORSE_LEADS = 2
"""Leads in a row that are worse than the best at which no longer one is tried: residuals rise from the best lead on (28
drives of problems/identify/random_plants.py, without a line); fewer trust one residual, more take time."""
# ratio of residuals by which a drop or another zero point must be better to be advised: a smaller one warns of right
# pressures, a larger one misses wrong ones (tests/models/pneumatic/test_logs.py)
MIN_RESIDUAL_RATIO = 1.5
# share of a pressure's squared rates that a zero point may leave without a check of others: a wrong one leaves 0.03 or
# more (tests/models/pneumatic/test_logs.py), a smaller share checks right ones at the cost of time
MAX_UNQUESTIONED_SHARE = 0.02
MAX_RESIDUAL_SHARE = 0.2  # largest such share that an advised zero point may leave: with more, the model does not fit
MAX_LINE_RESIDUAL_SHARE = 0.25  # the same of a line's drop
MIN_LOG_DURATION = 1.0  # duration from which a log is checked alone as well [s]; shorter ones hold too little motion
