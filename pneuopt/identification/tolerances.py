"""The numbers that decide in `identification`, each with its unit and what it decides."""


# Checkup

MIN_PERCENT = 0.1
"""Standard deviation over the value [%] below which the model's errors count, and not the noise: a lower one promises
what no rig keeps, a higher one hides what quiet sensors give."""
MAX_PERCENT = 100.0
"""Standard deviation over the value [%] beyond which its digits say nothing."""

# Compare logs

# standard deviations between a log's own estimate and the others' from which they disagree: lower blames chance, higher
# misses another load
DISAGREEMENT_DEVIATIONS = 4.0
# relative difference [1] that a disagreement must exceed, too: lower takes the bias of a model for another drive, whose
# intervals do not hold it; higher misses a small change of the drive
MIN_RELATIVE_DIFFERENCE = 0.02

# Examination

CHANGE = 1e-3
"""Change of a parameter [of its value, or of its unit] by which forces are seen to depend on it: smaller drowns in
rounding, larger leaves the range in which hardware is possible."""
STOP_DEPTH = 1e-3
"""Depth beyond a limit of the position [m] at which a model's end stop pushes back: less is rounded, more breaks it."""
MIN_FORCE_SHARE = 1e-3
"""Force of a signal over the largest one's [1] from which it counts: lower asks for a position where stops are rounded,
higher forgets soft springs."""
MIN_STOP_FORCE = 10.0
"""Force [N] by which a model's end stop pushes back at that depth at least: lower takes a spring for a stop."""

# Identifiability

# Standard deviations relative to the value (or per e-fold of a logarithm):
HARMLESS_DEVIATION = 0.01  # a combination known better does no harm; larger hides some, smaller names needless groups
MAX_LINEAR_DEVIATION = 0.15  # of a log parameter: beyond it the likelihood is no parabola, and the interval is profiled
MAX_RELATIVE_DEVIATION = 0.3  # beyond it a number is only rough; larger lets it pass unmarked, smaller marks good ones
MAX_EXPECTED_DEVIATION = 1.0  # before a fit, beyond it a parameter is unidentifiable: a fit need not be tried
UNIDENTIFIABLE_DEVIATION = 10 / 3  # after a fit: beyond it a factor of ten about the value is as good as the logs
# Combinations of parameters:
MAX_INFLATION = 30.0  # times that a standard deviation shrinks if the others were known: beyond it parameters act alike
MIN_COMBINATION_SHARE = 0.3  # of a weak combination's largest part: smaller names parameters that hardly take part
INFORMATION_ROUNDING = 1e-9  # root of information, relative to the largest: smaller takes rounding for information
MAX_INVERSE_SINGULAR = 1e9  # inverse singular values, at most: larger are rounding
# Parameters that were held, with a weak prior about their values:
# share of an estimate's variance [1] that the priors may make up: with more, the estimate rests on them and not on the
# logs; a lower limit marks estimates that the logs do identify
MAX_PRIOR_VARIANCE_SHARE = 0.1
# standard deviation over the value [1] up to which such an estimate is identified all the same: a factor of ten in what
# is held moves it by no more; higher hands out numbers that are the prior's, lower withholds friction known to 1 %
MAX_PRIOR_DEVIATION = 0.1
# confidence level [1] of the likelihood-ratio test that rejects held values: higher keeps wrong values, lower rejects
# right ones by chance
REJECTION_CONFIDENCE = 0.95
MAX_REDUCTION_SEGMENTS = 2000  # segments whose sensitivities are reduced together: more at once take memory, fewer time

# Logged loop

# difference of a log's time from the controller's, in sample times [1]: smaller refuses rounded times, larger takes
# samples of another moment
SAMPLE_TIME_TOLERANCE = 1e-3
# samples over which a position is differentiated where the fed-back speed is not logged: fewer are noisy, more lag
DIFFERENTIATION_WINDOW = 21

# Losses

MAX_REFITS = 12  # refits with new weights, at most: fewer leave the weights unsettled, more cost time
# standard deviations that an estimate may still move from refit to refit: smaller takes more refits, larger stops early
ESTIMATE_CHANGE_TOLERANCE = 0.05
NOISE_CHANGE_TOLERANCE = 0.02  # relative change of a noise level [1] from refit to refit, likewise
MIN_WEIGHT = 1e-8  # least weight of a sample [1]: zero would divide its noise by zero, a larger one lets outliers count
# residual over its channel's scale [1] of an outlier: one in 16 000 samples of normal noise; lower counts noise
OUTLIER_THRESHOLD = 4.0

# Misfit

# blocks of time at the finest level, halved twice: more miss slow residuals, fewer leave hardly a degree of freedom
TIME_BLOCKS = 24
# probability [1] that chance makes the clusters disagree so much, below which intervals are widened: higher widens
# those of exact models, lower leaves a slow misfit unseen
GATE_LEVEL = 0.05
# degrees of freedom [1] that a level needs to count: with fewer its intervals are wide whatever the residuals are
MIN_TIME_DOF, MIN_LOG_DOF = 3.0, 1.3
# degrees of freedom [1] with which the best level counts where none has enough: fewer make an interval of nothing,
# more trust a parameter that one moment of the log determines
LEAST_TIME_DOF = 2.0
# share of the whole information [1] that is added to what is left without a cluster: smaller lets a cluster that alone
# determines a parameter have a change without limit, larger hides its weight
LEFT_OUT_REGULARISATION = 1e-3
# information that every cluster counts as having, in its average share [1]: less lets scores count that hardly tell
# anything, more hides a disagreement of short clusters
ASSUMED_SHARE = 0.1
SIMULATIONS = 40  # of white residuals: fewer misjudge what chance does, more cost time
SLOW_RATIO = 2.0  # variance by the coarsest blocks over that by the finest [1] that shows a misfit as slow as the log
LEVEL = 0.95  # of the intervals by which the levels are compared [1]
# classes of a simulated signal, equally full: more see finer effects with less certainty
MOTION_CLASSES = 6
# blocks of time over which the means of the residuals by class scatter: fewer have little power, more are correlated
MOTION_BLOCKS = 32
# probability [1], over all signals and outputs, below which residuals depend on a signal: higher blames chance, lower
# misses stick-slip that the model smooths
MOTION_LEVEL = 0.001
# residuals in noise standard deviations [1] from which most of their power is an error of the model: a lower one blames
# the model for noise that a log states too low, a higher one trusts intervals of wrong models
MODEL_ERROR_LEVEL = 2.0
# residuals in standard deviations of the stated noise [1] beyond which there is no interval: the parameters of a model
# that misses so much are not those of the drive, and how far they are off is not in the residuals. Sensors at the wrong
# place have left 26 to 49, friction that depends on load or position 2 to 8
MAX_MISFIT = 20.0
# the same over the channel's own variation [1], where the noise is estimated: that of a fine encoder is far below what
# any model explains
MAX_NRMSE = 0.2
MIN_SIGNAL_SPREAD = 1e-6  # spread of a signal over its size [1]: a smaller one is rounding, and has no classes
# change of an estimate by a rejected width, in its deviations [1], up to which it is no bias: a 95 % interval that is
# shifted by half a deviation still holds the truth 92 times in 100; lower marks what does no harm
HARMLESS_SHIFT = 0.5

# Problem

STATIC_SEGMENTS = 100  # segments of a static map's log: fewer make uneven blocks of time, more cost time
REFIT_STAGES = 3  # last stages of a method that a refit runs, near its answer: more cost time, fewer may not converge
# Factor [1] between a stated noise level and the one that the log shows: a smaller one doubts good estimates of short
# logs and of noise that is not white, a larger one lets intervals through that are too narrow.
MAX_NOISE_FACTOR = 3.0
# Missing samples in a row that are bridged: with more an input that swings is wrong between its ends; with fewer a log
# that loses a block now and then falls apart, and each part has a start state to be found.
MAX_BRIDGE = 10
MIN_RUN = 10  # samples with an output between two holes: fewer hardly find the start state of a part, more lose data
# distance of the resting command from the middle of its range, over half the range [1]: higher takes a valve that holds
# a load for one with another centre, lower misses a wide dead zone
MAX_REST_DISTANCE = 0.2
RANGE_TOLERANCE = 0.02  # by which noise may leave the range, over half the range [1]; higher takes other ranges for it
MIN_EXCURSION = 0.02  # to both sides of the middle, over half the range [1]; lower takes one-way logs for two-way ones

# Profiles

MAX_REFITS_A_SIDE = 14  # refits on one side of the estimate: more cost time, fewer leave an end open that is not
# how closely an end is surrounded, relative to its distance from the estimate, or the deviance's root at a refit, to
# the level's: smaller takes more refits, larger interpolates the end from farther off
END_TOLERANCE = 0.02
MAX_LOG_STEP = 1.5  # e-folds of a log parameter between two refits: larger steps lose the optimum of the others
MAX_LOG_PROBE = 0.3  # e-folds over which the curvature at the estimate is measured: farther away it differs
REFIT_ITERATIONS = 40  # iterations of a refit, at most: fewer leave its cost too high, and the interval too narrow
# standard deviations over which a slope is taken: larger steps see curvature, smaller ones rounding
DELTA_METHOD_STEP = 1e-3

# Result

# inflation of a standard deviation [1] from which "nothing separates them" is shown: lower hides useful figures, higher
# shows rounding
INFINITE_INFLATION = 1e5
MAX_FIT_ROWS = 12
"""Rows of a table of logs: of more, the median and the worst are easier to read."""
# share of the largest speed [1] below which a sample counts as standing still: lower takes noise for motion, higher
# leaves slow motion out
MOVING_SPEED_SHARE = 0.05

# Review

# standard deviations that another parameter moves along a profile, beyond which it is profiled, too: lower costs time,
# higher leaves wrong linear intervals
PROFILE_DRAG_DEVIATIONS = 3.0
RESIDUAL_BLOCK_SAMPLES = 50  # samples of a block of residuals: fewer show single outliers, more blur the time span
GAP_SUBSTEPS = (
    20  # integration steps a sample for the gaps that are shown: fewer add integration errors, more cost time
)
MIN_REPORTED_GAP = 1e-4  # of a state's nominal size: smaller gaps are integration errors, larger ones point to a fault
# share of the misfit [1] that a freed value must explain by the linearised equations to be tried: lower tries what does
# not help, higher passes over what is far off
MIN_PROMISED_SHARE = 0.5
# the same by a fit, to be named: lower blames a value for an error of the model, higher misses it beside another one
MIN_EXPLAINED_SHARE = 0.8
# iterations of a stage of a trial, and of its last one again where the equations by then promise enough: a value that
# explains the logs takes 17 in all, more are lost on what does not
TRIAL_ITERATIONS, LAST_TRIAL_ITERATIONS = 4, 10
MAX_FREED_TRIALS = 2  # values that are tried: more take time, fewer miss one whose promise is not the largest
MAX_TESTS = 2  # fits of one problem that are tested: more take time, fewer miss what the first one is too far off for
# change of a value in its deviations [1] below which it is not wrong: lower blames chance
MIN_CHANGE = 4.0
# the same over the given value [1]: lower names what a scale or a data sheet leaves open, and what a friction law that
# is a little wrong asks for (1.3 % of the mass, where a Coulomb law meets a Stribeck curve)
MIN_RELATIVE_CHANGE = 0.03
# share of the misfit [1] from which a value explains all of it: others are then tried only if they promise as much
WHOLE_SHARE = 0.98
# squared residuals above the best trial's, in variances of its residuals, up to which logs do not tell two values
# apart: lower names one of two by chance, higher names what fits worse
ALIKE_SQUARES = 20.0

# Search

GUESS_STAGES = 3  # stages of a search with guesses held: more force a wrong guess on the log, fewer rank starts wrongly
# squared residuals a sample after the first stage or before the last, in noise variances, beyond which the first start
# waits for the others: lower settles all starts of a model that misses the log a little, higher follows hopeless starts
# to their end
HOPELESS_MISFIT = 3.0
# relative width of the bounds that hold a guess; equal bounds would compile other equations than those of the search
GUESS_BOUND_WIDTH = 1e-9
# squared residuals a sample, in noise variances, up to which no other start is tried: below 1 every start would be
# tried, while a wrong basin of soft bristles has left 1.1
ACCEPTED_CHI_SQUARE_RATIO = 1.05
# cost of a settled start over that of the first one after as many stages [1] up to which the guess is not what is
# wrong: lower settles all starts of a wrong model, higher takes another basin for the same
SAME_MISFIT_RATIO = 1.02
MIN_DOUBTED = 2  # fits after which the problem is doubted: fewer doubt it for one bad start, more take time
# excess of a parameter over another one that bounds it [1] below which another start is tried: lower takes a basin that
# has lost it for the answer, higher searches drives twice that have as good as none
MIN_EXCESS = 0.03
SAME_COST_RATIO = 1.001  # costs of two fits up to which both are one optimum; lower, and rounding makes two of it
# iterations with tight gaps that long logs get before a part of them is tried: more cost time, fewer leave easy logs
SHORT_ITERATIONS = 10
# segments of an excerpt: fewer may lack motion that a parameter needs, more cost time
EXCERPT_SEGMENTS = 1000
# length of a log, over that of an excerpt, from which on it has one: lower spends more on excerpts than they save,
# higher searches long logs from a rough start
MIN_LENGTH_RATIO = 2.5
MAX_SEGMENTS = 20_000  # of logs whose states are filtered one node after the other: more take longer than they save
# segments of all logs that the filter follows: fewer may lack motion that a parameter needs, more cost time
PART_SEGMENTS = 300
BEST = 4  # sets that descend: fewer end in a side minimum, more cost time
# deviation that the states gather along a segment, in nominal sizes, the steps at most, and the sets that go on
LEVELS = ((1e-3, 4, 2), (3e-4, 6, 1), (1e-4, 6, 1), (3e-5, 6, 1))
# cost a sample at which no set goes on [1]: lower gives up what would lead to the noise (.9), higher follows a wrong
# model; and the least deviation gathered at which it counts, for with less of it a lost slip costs a right set as much
MAX_COST, DECIDING = 1.3, 3e-4
# squared residuals over the noise's [1], and the gaps' share of them [1], above which a model does not follow whole
# logs, so that windows are tried: lower cuts logs that it follows but for a sensor's lag (60 and .17), higher iterates
# for a plant that runs away from its log (.9)
MAX_CLOSED_MISFIT, MAX_CLOSED_SHARE = 100.0, 0.3
# gap of each stage over that of the one before [1]: lower leaves an optimum too far off, higher takes more stages
GAP_FACTOR = 0.3
MAX_STAGES = 3  # more weigh gaps until nothing else counts but rounding, fewer leave a misfit in them
# deviations [1] by which one estimate lies below another that bounds it, beyond which the model is wrong: lower blames
# chance, higher passes friction that no drive has
MAX_BELOW_DEVIATIONS = 4.0

# Select model

MAX_TRIALS = 3  # starts of a model that are tried: fewer may miss the right basin, more take as long as a search
# samples of a window where candidates jump from segment to segment and none has chosen one: fewer hardly tell models
# apart, with more all gather so much misfit that no search settles
JUMPING_WINDOW_SAMPLES = 20
# squares of a trial over the least of all [1], up to which the simplest candidate leads: lower lets idle terms lead,
# higher a model that does not follow the logs
LEADER_RATIO = 1.1
# squares that a short search promises over the leader's [1] above which a candidate is hopeless: lower gives up models
# that a whole search may save, higher searches for minutes what comes out last
HOPELESS_RATIO = 4.0
# probability [1] below which a likelihood-ratio test rejects the simpler model: higher keeps terms that are chance,
# lower drops weak true ones
NESTED_TEST_LEVEL = 0.01
# difference of the BIC [1] below which held-out runs, or simplicity, decide: a ratio of the likelihoods of 20 (Kass and
# Raftery 1995); higher lets few samples decide, lower takes chance for evidence
TIE = 6.0
# held-out NRMSE over a simpler model's [1] above which the richer one is not recommended: higher recommends models that
# predict worse, lower lets noise decide
MAX_HELD_OUT_RATIO = 1.02

# Tracking

MIN_LOGS = 4
"""Logs from which a drift is tested [1]: three leave one degree of freedom, with which nothing is significant."""
HISTORIES = 40_000
"""Drawn histories: fewer make the level of a look uncertain by more than a tenth, more take seconds."""
WEEK = 604800.0  # [s]
POWERS = (0.8, 0.9)
"""Probabilities [1] with which the drift is seen after the logs that the power calculation names."""

# Widths

# stages of the method that confirm another width: with fewer a search that has not settled counts as a wrong width,
# with more it takes as long as a search
CONFIRMING_STAGES = 4
MAX_TRIAL_SAMPLES = 8000  # of all logs: more take time and tell no more, fewer may leave out where a log sticks
EXCERPTS = 4  # stretches in which a longer log is tried: fewer may miss where it sticks, more are short
# foreseen cost over that with the given width [1], below which no search with tight gaps confirms a narrower one:
# higher trusts equations far from their optimum, lower takes minutes where a sample takes a hundred integration steps
FORESEEN_RATIO = 0.5
# fall of the squared residuals that counts, in variances (chi-square with one degree of freedom exceeds it once in a
# thousand); lower follows chance, higher keeps wrong widths
SIGNIFICANT_FALL = 10.8
# fall of the cost that counts [1]; lower takes integration errors for a better width, higher keeps wrong widths
MIN_RELATIVE_FALL = 2e-3
# width over what it hides [1], above which it is narrowed even where the cost does not fall: above .25 a rounded edge
# shifts the dead zone that it is fitted with
MAX_HIDING_SHARE = 0.25
# squared residuals over the noise's [1] up to which a wider one counts: above it the model lacks something that a wide
# one would hide, as viscous friction that is held at zero; below 2 the tails of the noise alone refuse it
MAX_WIDENED_MISFIT = 4.0

# Windows

# measured samples of the shortest window that is tried: with fewer its start states take most of what it tells, with
# more a plant that runs away quickly is not followed
MIN_WINDOW_SAMPLES = 20
MIN_WINDOWS = 12  # windows of all logs: with fewer the scatter between parts is a guess, more leave out long ones
# share of the parameters that windows must determine to better than their own size [1]: short windows with starts of
# their own follow any smooth log, also one of another plant, and a lower share takes that for an answer; with a higher
# one an offset that is zero forbids windows
MIN_KNOWN_SHARE = 0.5
# iterations in the first windows, which begin where a search of whole logs has failed, and in the next ones, which
# begin with the answer of those twice as long: fewer leave what would converge, more are lost where one window creeps
FIRST_ITERATIONS, NEXT_ITERATIONS = 60, 30
WINDOW_FACTOR = 2.0  # from one length to the next [1]: lower takes more fits, higher may pass over the best
