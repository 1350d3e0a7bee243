"""The numbers that decide in `identification`: each with its unit, what it decides, and what was measured of it."""

# Several subjects

LEVEL = 0.95  # [1] of confidence, of intervals and of tests whose rejection only asks for more work
CLEAR_DEVIATIONS = 4.0  # [1] standard deviations beyond which a difference or a residual is not chance: 1 in 16 000
MODEL_ERROR_LEVEL = 2.0  # [1] residuals over the noise from which most of their power is an error of the model
MOVING_SPEED_SHARE = 0.05  # [1] of the largest speed, below which a sample counts as standing still
REFIT_STAGES = 3  # last stages of a method that a refit runs, near its answer
SIGNIFICANT_FALL = 10.8  # [variances] fall of squared residuals that counts: chance exceeds it once in a thousand
MIN_WINDOW_SAMPLES = 20  # measured samples of the shortest window: of fewer its start state takes most

# Checkup

TRIAL_SECONDS = 5.0  # [CPU s] that the trial fit of a check may take

# Compare logs

MIN_RELATIVE_DIFFERENCE = 0.02  # [1] that a disagreement must exceed, too: an interval does not hold a model's bias

# Examination

MIN_FORCE_SHARE = 1e-3  # [1] force of a signal over the largest one's, from which it counts
MIN_STOP_FORCE = 10.0  # [N] by which a model's end stop pushes back 1 mm beyond a limit; a spring takes less

# Forecast

START_SHARE = 0.1  # [1] of the time of a log, to which the start of its forecast is fitted
FORECAST_STARTS = 4  # evenly spread, from which a fit forecasts each of its own logs
FORECAST_LEVELS = 5  # of time since the start, each twice as long as the one before, with an error each

FORECAST_LANES = 16  # runs at once, at most
ENDLESS = 1e12  # [noise deviations, or the unit] at which a run counts that has left the model's range

# Explanations of a misfit: what is tried of each

MIN_EXPLAINING_SECONDS = 2.0  # [CPU s] that all of them may take where the fit took less
DEAD_TIME_SAMPLES = (1, 2, 4, 8, 16, 32, 64, 128)  # [samples]
BACKLASH_SHARES = (0.0025, 0.005, 0.01, 0.02, 0.04, 0.08, 0.16)  # [1] of an input's range
STRIBECK_SHARES = (0.3, 0.1, 0.03)  # [1] Stribeck velocity over the root mean square of the speed
TURN_SHARE = 0.01  # [1] of that speed, over which friction turns round; and of typical forces, where friction starts
REFINED_AMOUNTS = 3  # further amounts, at the lowest points of parabolas

# Free run

# [1] error of a prediction over the motion, beyond which it is useless: fits of right models left up to .11, those of
# problems/identify/mismatch.py up to .16, with a valve's centre that was not found .6, a dead time of a third of the
# motion's horizon .29
MAX_PREDICTION_SHARE = 0.25

# Identifiability; standard deviations are over the value, or per e-fold of a logarithm

HARMLESS_DEVIATION = 0.01  # [1] up to which a combination of parameters does no harm
MAX_LINEAR_DEVIATION = 0.15  # [1] beyond which a log parameter's interval is profiled: the likelihood is no parabola
MAX_RELATIVE_DEVIATION = 0.3  # [1] beyond which a number is only rough
MAX_EXPECTED_DEVIATION = 1.0  # [1] before a fit, beyond which a parameter is unidentifiable
UNIDENTIFIABLE_DEVIATION = 10 / 3  # [1] after a fit: a factor of ten about the value is then as good as the logs
MAX_INFLATION = 30.0  # [1] times better known if the others were known, beyond which parameters act alike
MIN_COMBINATION_SHARE = 0.3  # [1] of a weak combination's largest part, from which a parameter takes part
INFORMATION_ROUNDING = 1e-9  # [1] root of information over the largest, below which it is rounding
MAX_PRIOR_VARIANCE_SHARE = 0.1  # [1] of an estimate's variance from priors, beyond which it does not rest on the logs
MAX_PRIOR_DEVIATION = 0.1  # [1] up to which such an estimate is identified all the same

# Logged loop

SAMPLE_TIME_TOLERANCE = 1e-3  # [sample times] of a log's time about the controller's: rounded, not another moment

# Losses

MAX_REFITS = 12  # with new weights
ESTIMATE_CHANGE_TOLERANCE = 0.05  # [standard deviations] that an estimate may still move from refit to refit
NOISE_CHANGE_TOLERANCE = 0.02  # [1] relative change of a noise level from refit to refit, likewise
MIN_WEIGHT = 1e-8  # [1] of a sample: zero would divide its noise by zero

# Misfit

TIME_BLOCKS = 24  # of time at the finest level, halved twice (problems/identify/interval_coverage.py)
MIN_TIME_DOF, MIN_LOG_DOF = 3.0, 1.3  # degrees of freedom that a level of blocks, or of logs, needs to count
LEAST_TIME_DOF = 2.0  # degrees of freedom with which the best level counts where none has enough
LEFT_OUT_REGULARISATION = 1e-3  # [1] of the whole information, added to what is left without a cluster
ASSUMED_SHARE = 0.1  # [1] of its average share of the information, that every cluster counts as having
SIMULATIONS = 40  # of white residuals
SLOW_RATIO = 2.0  # [1] variance by the coarsest blocks over the finest's, that shows a misfit as slow as the log
MOTION_CLASSES = 6  # of a simulated signal, equally full
MOTION_BLOCKS = 32  # of time, over which the means of the residuals by class scatter
MOTION_LEVEL = 0.001  # [1] probability, over all signals and outputs, below which residuals depend on a signal
# [1] residuals over the stated noise, beyond which no interval is given: sensors at the wrong place have left 26 to 49,
# friction that depends on load or position 2 to 8
MAX_MISFIT = 20.0
MAX_NRMSE = 0.2  # [1] the same over the channel's own variation, where the noise is estimated
# half widths of a 95 % interval of chance that hold 94 to 98 truths in 100 where residuals show an error of the model
# (2 hold 86), and first-order shifts to the best widths that hold 96 where stated ones are rejected
BIAS_HALF_WIDTHS, BIAS_SHIFTS = 4.0, 2.0
HARMLESS_BIAS = 0.02  # [1] over the value, up to which no design notices it
MIN_SIGNAL_SPREAD = 1e-6  # [1] of a signal over its size: a smaller one is rounding, and has no classes

# Problem

STATIC_SEGMENTS = 100  # of a static map's log, for blocks of time
MAX_NOISE_FACTOR = 3.0  # [1] between a stated noise level and the one that the log shows
MAX_BRIDGE = 10  # missing samples in a row that are bridged; at more a log is cut
MIN_RUN = 10  # samples with an output between two holes, that find the start state of a part
MAX_REST_DISTANCE = 0.2  # [half ranges] of the resting command from the middle of its range
RANGE_TOLERANCE = 0.02  # [half ranges] that are noise: beyond the range, and to both sides of its middle

# Profiles

MAX_REFITS_A_SIDE = 14  # after which an end counts as open
END_TOLERANCE = 0.02  # [1] of an end's distance from the estimate, or of the level, to which it is located
MAX_LOG_STEP = 1.5  # [e-folds] between two refits of a log parameter
MAX_LOG_PROBE = 0.3  # [e-folds] over which the curvature at the estimate is measured
REFIT_ITERATIONS = 40  # of a refit

# Review

PROFILE_DRAG_DEVIATIONS = 3.0  # that another parameter moves along a profile, beyond which it is profiled, too
MIN_PROMISED_SHARE = 0.5  # [1] of the misfit that a freed value must explain by the linearised equations to be tried
MIN_EXPLAINED_SHARE = 0.8  # [1] the same by a fit, to be named
WHOLE_SHARE = 0.98  # [1] of the misfit, from which a value explains all of it
# of a trial's stages, and of its last one: a value that explains the logs took 17 in all
TRIAL_FIT_ITERATIONS, LAST_TRIAL_ITERATIONS = 4, 10
MAX_FREED_TRIALS = 2  # values that are tried in a test, and tests of one problem
MIN_RELATIVE_CHANGE = 0.03  # [1] of a wrong value: a Coulomb law at a Stribeck curve asks for 1.3 % of the mass
ALIKE_SQUARES = 20.0  # [variances of the residuals] above the best, up to which logs do not tell two values apart

# Search

GUESS_STAGES = 3  # of a search with guesses held
HOPELESS_MISFIT = 3.0  # [noise variances a sample] beyond which the first start waits for the others
ACCEPTED_CHI_SQUARE_RATIO = 1.05  # [1] up to which no other start is tried: a wrong basin of bristles has left 1.1
MIN_DOUBTED = 3  # fits after which the problem is doubted: noise of the states comes before
MIN_EXCESS = 0.03  # [1] of a parameter over one that bounds it, below which another start is tried
SAME_COST_RATIO = 1.001  # [1] costs of two fits up to which both are one optimum
EXCERPT_SEGMENTS = 1000  # of an excerpt, and at most of a log's part to which the start of its forecast is fitted
MIN_LENGTH_RATIO = 2.5  # [1] length of a log over that of an excerpt, from which on it has one
MAX_SEGMENTS = 20_000  # of logs whose states are filtered one node after the other
PART_SEGMENTS = 150  # of all logs, that the filter follows
BEST = 2  # sets that descend
# deviation that the states gather along a segment [nominal sizes], the steps at most, and the sets that go on
LEVELS = ((1e-3, 4, 2), (3e-4, 6, 1), (1e-4, 6, 1), (3e-5, 6, 1))
MAX_COST = 1.3  # [1] cost a sample at which no set goes on; of what would lead to the noise .9
# [1] squared residuals over the noise's and the gaps' share of them, above which gaps are not tightened: a sensor's lag
# has 60 and .17, a plant that runs away from its log .9
MAX_CLOSED_MISFIT, MAX_CLOSED_SHARE = 100.0, 0.3
GAP_FACTOR = 0.3  # [1] gap of each tightening stage over that of the one before
MAX_STAGES = 3  # that tighten gaps
DECIDING = LEVELS[1][0]  # [nominal sizes] deviation from which on that cost counts

# Select model

# [1] squares of a trial over the least of all, up to which the simplest candidate leads: with 1.1 the richest leads on
# the log of problems/identify/emps.py, whose fit takes 12 CPU s more and ends at a bound
LEADER_RATIO = 2.0
HOPELESS_RATIO = 4.0  # [1] squares that a short search promises over the leader's, above which it is not searched on
NESTED_TEST_LEVEL = 0.01  # [1] probability below which a likelihood-ratio test rejects the simpler model
TIE = 6.0  # [1] difference of the BIC: a ratio of the likelihoods of 20 (Kass and Raftery 1995)
MAX_HELD_OUT_RATIO = 1.02  # [1] held-out NRMSE over a simpler model's, above which the richer is not recommended

# Tracking

MIN_LOGS = 4  # from which a drift is tested: three leave one degree of freedom, with which nothing is significant

# Widths

WIDTH_RANGE = 30.0  # [1] start of a width over its least: less keeps friction from sticking, more integrates slowly

# Windows

MIN_WINDOWS = 12  # of all logs
MIN_KNOWN_SHARE = 0.5  # [1] of the parameters that windows must determine to better than their own size
WINDOW_ITERATIONS = 30  # in windows that begin with the answer of others; twice as many in the first ones
WINDOW_FACTOR = 4.0  # [1] from one length to the next
