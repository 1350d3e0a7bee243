"""The numbers that decide in `tuning`, each with its unit and what it decides."""

# Objectives

LEAST_IMPROVEMENT = 1e-3  # relative difference of two objectives from which on one is better and the optima are two
SAME_OBJECTIVE = (
    0.01  # relative difference of two objectives that count as one: of claim and certificate, of two starts
)
ACTIVE_ROOM = 0.02  # room left of a limit, a fraction of it, within which the limit counts as active
LIMIT_TOLERANCE = 1e-4  # relative excess over a limit that is rounding, and with which a search counts as successful
VIOLATION_PENALTY = 20.0  # weight of a limit's relative violation beside that of never settling
WORST_MERIT = 1e6  # largest objective that a search tells apart [s, %, V]; broken limits are graded beyond it
UNSETTLED_EXCESS = 10.0  # relative excess over its limits that a response counts as which never settles
RUNAWAY_LEVEL = 1e12  # size of an output [its unit, Pa too] from which on a response counts as running away

# Feasibility

LEAST_GROWTH = 1e-3  # growth over the horizon, in its logarithm, below which no loop is refused as unstable
JUST_BELOW = 0.999  # of a real pole: where the poles beyond are counted, far from rounding
MAX_CORNER_NAMES = 10  # parameters whose corners, twice as many with each, are proved to be unstable
POINTS_INSIDE = 100  # points within the bounds, beside the corners, where a dither may stabilise the loop

# Search and certificate

MARGINS_TO_TRY = 3  # attempts of a search, each with twice the margin before, until a design is certified
MAX_CERTIFIED_POINTS = 5  # rounded designs certified at each margin, each an independent simulation of every case
MAX_ROUNDINGS = 64  # rounded designs that are simulated; of 10 the best loses as much again as the limits' tolerance
BOUND_DISTANCE = 1e-6  # share of a gain's range from its bound, within which it is rounded to the bound
HORIZON_FACTORS = (4.0, 2.8, 2.0, 1.4)  # horizons after which hunting and creep are sought; the first the stroke allows
MAX_REFINED_SEARCHES = 3  # searches on closer samples or with shorter steps, until figures are resolved
SAMPLING_TOLERANCE = 5e-3  # change of a requirement on closer samples, of value and limit, that repeats a search
SEARCH_TOLERANCE = 5.0  # multiple of the tolerances of a certificate's readings that a search's samples keep
MEMBERS_A_GAIN, TRIALS_A_GAIN = 8, 900  # population and trials a free gain of the search on the limits' excess
LEAST_LIMIT_MEMBERS = 10  # of its population
MAX_CANDIDATES = 8  # its designs that are certified

# Robust designs

FINALIST_SHARE, MAX_FINALISTS = 0.05, 8  # objective above the best from which on a point is no finalist; how many
HIGH_SHARE = 0.95  # of plants: what these reach is promised; a design that holds on fewer is doubtful, and that is said
EXCHANGE_SHARE = 0.4  # of a short search: all of it takes twice the time for an objective that is up to 3 % smaller
ENOUGH_HELD = 0.97  # of the plants by which designs are chosen, so that 0.95 of others hold with a chance of 9 in 10

# Relaxation

RELAXATION_MARGIN = 0.002  # margin of the search for the least relaxation of a limit, a fraction
LOCAL_TRIALS_A_GAIN = 300  # trials a free gain for the least value of one limit, at most

# Front

LOG_SPACING_RATIO = 8.0  # ratio of a front's ends from which on its limits lie evenly in the logarithm
MAX_IMPROVEMENT_ROUNDS = 2  # rounds of searching again for designs of a front that others beat
RIVAL_SAMPLES = 2000  # points at which branches are sought that neither end of a front leads to
SECONDARY_WEIGHT = 1e-3  # weight of the other requirement at an end of a front, so that equals are told apart

# Gradients

QP_CURVATURE = 3e-3  # curvature of the quadratic program over the objective's slope; at 1e-5 the solver fails
ROW_PADDING = 32  # rows are padded to multiples of it, so that few programs are built
MAX_CUTTING_ROUNDS = 20  # rounds in which rows that a step violates are added to its program
VIOLATION_TOLERANCE = 1e-7  # violation from which on a row is added, as rows count
INFINITE_BOUND = 1e20  # stands for no bound of a program
PROGRAM_BAND_PENALTY = 50.0  # least penalty of leaving the settling band by the whole step, over the objective's scale
PROGRAM_LIMIT_PENALTY = 2.0  # penalty of exceeding a limit by its own size, over the objective's scale
PENALTY_RAISES = 2  # descents with penalties ten times the last where limits stay broken
PROGRAM_MARGIN = 0.005  # share by which the programs' limits are tighter, for a response breaks them between nodes
SETTLING_RADIUS_RATIO = 5.0  # trust region of Ts over that of the gains, both fractions of their ranges
NEAR_LIMIT = 0.75  # share of a limit on a margin from which on the margin has derivatives, a frequency response a gain
DIFFERENCE_STEP = 1e-4  # step of the difference quotients of margins and rest, a fraction of a gain's range

# Racing

MEMORY_OF_KILLS = 0.95  # share of its weight that a case's victory keeps from race to race, which orders the cases
MEMORY_SIZE = 6  # entries of the memory of successful step lengths and crossover rates
BEST_SHARE = 0.15  # share of the population towards whose points trials move
MOST_STARTS = 3  # of a search, the third only where no two agree to within `SAME_OBJECTIVE`: more cost more than found
BAND_SHARES = (0.2, 0.125)  # shares of a start's trials over all bands, and over the nearest wider one
FINE_SHARE = 0.15  # trials on fine samples, over those of a start
STALLED_GENERATIONS = 25  # generations without `LEAST_IMPROVEMENT` of the best and the median merit that end a phase
LEAST_SPREAD = 1e-4  # spread of all merits, a share of the best, that ends a phase
FINE_MEMBERS = 20  # members of the phase on fine samples, which rank points anew
FEW_BEST, NO_DITHER = 6, 0.02  # best points that begin the second start, and its dither's amplitude [of its range]
POLISHED, POLISHED_NEARBY = 2, 4  # points that gradients improve at a time; of a search near its start
REPORT_SECONDS = 1.0  # between two readings of the figures that a search reports [s]: each is a simulation
MIN_DISTANCE = 0.03  # how far apart they lie, a share of a gain's range
LAGGING = 1.3  # merit over the best from which on a start is given up, and gradients leave a point
CUT_SETTLING_TIMES, LEAST_CUT = 3.0, 0.15  # settling times, or share of the horizon, of a response that a race sees
LEAST_SHORT_TRIALS = 400  # trials a free gain of a short search; with 200 a relaxation came out 4 % too large
LEAST_MEMBERS, SHORT_MEMBERS = 5, 0.6  # members of a search, of which a trial mixes four; share of them in a short one
NEARBY = 0.05  # share of each range by which points near a start spread, and beyond which two candidates lie apart

# Simulator

KEPT_STATES = 64  # samples between two states that a run keeps, from which a second one sets out
STIFFEST_CORNERS = 8  # corners of the box, fastest on the nominal plant, whose fastest mode counts on other plants
MAX_SAMPLE_ANGLE = 20.0  # highest frequency at which a sampled loop is read, times its sample time [rad]
MAX_LOOP_SUBSTEPS = 100  # RK4 steps between two samples, at most: stiffer loops are refused with their cause

# Two phase

MAX_STEPS_A_SEGMENT = 3.5  # RK4 steps between two nodes for `TwoPhase`: the published loop takes 3; 4 to 16 failed
MIN_STARTS = 3  # starts after which the search ends if most of them have failed

# Result

MIN_DERIVATIVE_RATIO = 0.01  # Td/Tf below which a derivative adds less than 1 % to Kp and is said to be next to none
