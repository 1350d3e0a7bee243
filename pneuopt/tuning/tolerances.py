"""The numbers that decide in `tuning`, each with its unit and what it decides."""


# Feasibility

# Growth of a deviation over the horizon, in its logarithm, below which nothing is called unstable before a search. A
# smaller one meets the rounding of poles at zero; a larger one leaves slow instabilities to the certificate.
LEAST_GROWTH = 1e-3
JUST_BELOW = 0.999  # of a pole: where the number of poles beyond is counted, far from rounding
# Parameters over whose corners a loop's instability is proved, at most: their corners double with each.
MAX_CORNER_NAMES = 10
# Points within the bounds that count beside the corners. Fewer may miss a dither that stabilises the loop.
POINTS_INSIDE = 100
# Bisections for the largest part of a reference that can be held. Fewer make the message's figure coarse; each more
# costs an equilibrium.
BISECTION_STEPS = 10

# Front

# Ratio of the ends from which on the limits lie evenly in the logarithm. With a larger one a wide front has one design
# in its lowest decade; with a smaller one the limits of a narrow front are needlessly uneven.
LOG_SPACING_RATIO = 8.0
# Rounds of searching again for designs that others beat. Fewer leave such designs in the table; each more costs a
# search for each of them.
MAX_IMPROVEMENT_ROUNDS = 2
# Points at which all requirements are read in search of branches that neither end leads to. Fewer miss branches; each
# more costs a simulation of every case.
RIVAL_SAMPLES = 2000
# Relative improvement from which another design counts as better. A smaller one repeats searches for rounding; a larger
# one leaves designs in the table that another beats.
MIN_IMPROVEMENT = 1e-3
# Weight of the other requirement at an end, relative to the one that is best there. At zero, an arbitrary one is taken
# of designs that are equally good by the first; a larger one moves the end inwards.
SECONDARY_WEIGHT = 1e-3

# Gradients

# Curvature of the quadratic program over the objective's slope. At 1e-5 the solver fails on nearly flat programs; a
# larger one shortens the steps.
QP_CURVATURE = 3e-3
# Numbers of rows are rounded up to multiples of it, so that few programs are built. With a smaller one each program is
# built anew; a larger one makes the solver work on empty rows.
ROW_PADDING = 32
# Rounds in which rows that a step violates are added to its program. Fewer may return a step that violates rows; each
# more costs a program.
MAX_CUTTING_ROUNDS = 20
# Violation from which a row is added, as rows count. A smaller one adds rows for rounding errors; a larger one leaves
# violations in the step.
VIOLATION_TOLERANCE = 1e-7
# Actual over predicted decrease below which the trust region shrinks, and above which it grows. Higher ones keep steps
# short; lower ones accept steps that the linearisation does not predict.
SHRINK_GAIN_RATIO, GROW_GAIN_RATIO = 0.25, 0.75
INFINITE_BOUND = 1e20  # stands for no bound; a smaller one might be reached by a slack of a badly scaled objective
# Least penalty of leaving the settling band by the whole step, over the objective's scale. With a smaller one leaving
# the band pays; with a larger one a search stays in the first basin that it meets.
PROGRAM_BAND_PENALTY = 50.0
# Penalty of exceeding a limit by its own size, over the objective's scale; below and above as for the band.
PROGRAM_LIMIT_PENALTY = 2.0
# Trust region of Ts over that of the gains, both fractions of their ranges. At 1 the settling time, not the gains, held
# steps back; far above it the linearisation in time fails first.
SETTLING_RADIUS_RATIO = 5.0
# Lanes with sensitivities that are run and read at a time. Fewer leave cores idle; more do not fit the cache.
MAX_SENSITIVITY_LANES = 64
# Share of a limit on a margin from which on it has derivatives. Below it no step of a descent reaches the limit; nearer
# to it a step breaks a limit that it did not see; farther ones cost a frequency response a gain.
NEAR_LIMIT = 0.75
# Step of the difference quotients of margins and rest, a fraction of a gain's range. A smaller one divides rounding
# errors; a larger one linearises a curved function.
DIFFERENCE_STEP = 1e-4
# Share by which the programs' band and limits are tighter than the search's. With less, a solution, which lies on its
# limits, breaks them between the nodes; more gives performance away.
PROGRAM_MARGIN = 0.005
PENALTY_RAISES = 2  # descents with penalties ten times the last where limits stay broken; more slow each program
NODES = 2000  # instants at which a response is read, at most: fewer miss what a response does between them

# Racing

# Share of its weight that a case's victory keeps from race to race. Below, the order of the cases follows chance; near
# 1, it lags behind the search.
MEMORY_OF_KILLS = 0.95
# Numbers that a race records, at most. Fewer split a generation into several races, whose lanes idle at each end; more
# take memory (8 bytes each).
MAX_RECORDED_NUMBERS = 2**25
# Entries of the memory of successful step lengths and crossover rates. Fewer follow chance; more forget too slowly.
MEMORY_SIZE = 6
# Share of the population that counts as its best, towards which every trial moves: a smaller one draws the population
# into the first basin, a larger one slows it down.
BEST_SHARE = 0.15
# Spread of the step lengths (Cauchy) and the crossover rates (normal) about their memory, as published.
LENGTH_SPREAD, RATE_SPREAD = 0.1, 0.1
# Relative excess over a limit with which a search still counts as successful. At zero, rounding errors make a design
# that lies on its limit infeasible; a larger one hands over designs whose certificate is bound to fail.
LIMIT_TOLERANCE = 1e-4
# Share of the margin that limits on peaks of command and sensitivity are tightened by. A smaller one than a search's
# coarse samples miss of a peak makes the certificate fail; a larger one gives performance away.
SIMULATION_PEAK_MARGIN = 1 / 5
# Weight of a limit's relative violation beside that of never settling. With a smaller one a search stays with designs
# that settle and break a limit; with a larger one with loops so slow that they keep every limit and never settle.
VIOLATION_PENALTY = 20.0
# Shares of the trials that the starts get on coarse samples; the rest is for fine ones. Less for the first ends in the
# nearest optimum, less for the second is no second opinion, less for the rest leaves an optimum of the coarse samples.
START_SHARES = (0.5, 0.35)
# Shares of a start's trials over all bands, and over the nearest wider one. Less ends in the nearest optimum; more
# leaves the band asked for too few.
BAND_SHARES = (0.4, 0.25)
# Generations over which the best merit, or the median, must improve by this share for a phase to go on, and the spread
# of the whole population, a share of its best, below which it ends. Shorter or larger ends a search that still
# advances; so does to look at the best alone, which stands while the others catch up.
PATIENCE, LEAST_PROGRESS, LEAST_SPREAD = 25, 1e-3, 1e-4
# Members of the phase on fine samples. Fewer lose the optimum where coarse and fine samples rank points differently;
# each more costs fine simulations.
FINE_MEMBERS = 20
# Best points of the first start from which the second one begins, and its amplitudes, a share of their range: hardly
# any dither, where optima lie that a population with dither does not see.
FEW_BEST, NO_DITHER = 6, 0.02
# Points, as far from each other as this share of a gain's range, that gradients improve at a time, on whole responses:
# cut ones end at other operating points, whose margins they meet. Fewer or farther points miss basins; each more costs
# a descent, and closer ones end in the same point. A search near its start has fewer trials, so it gets more points.
POLISHED, POLISHED_NEARBY, MIN_DISTANCE = 2, 4, 0.03
AGREEMENT = 0.01  # relative difference of two starts' merits that count as one: larger ones hide a second optimum
# Best merit after the wide bands, over that with which the first start ended, from which on a start is given up; and a
# point's merit over the best, from which on gradients leave it. A smaller one gives up what gradients may still bring
# to the front; a larger one searches on behind it.
LAGGING = 1.3
# Best settling times, and shares of the horizon, that a race sees of each response, whichever is longer. Less takes for
# settled what leaves the band later; more simulates what seldom changes a merit. Each new best is proved on the whole.
CUT_SETTLING_TIMES, LEAST_CUT = 3.0, 0.15
# Trials for each free gain of a short search, unless the whole one has fewer. With 200 the smallest relaxation of one
# gain's limit came out 4 % too large; more cost time where there are many gains.
LEAST_SHORT_TRIALS = 400
# Members of a search, at least: a trial mixes four of them. Share of them in a short search: more take generations
# from its trials, fewer leave it to its start.
LEAST_MEMBERS, SHORT_MEMBERS = 5, 0.6
NEARBY = 0.05  # spread about a start that is close, a share of each range: a wider one leaves it, a narrower one sticks

# Relaxation

# Significant digits of a relaxed limit, rounded so that the design that was found keeps it. Fewer relax it needlessly;
# more claim a precision that a search does not have.
RELAXED_LIMIT_DIGITS = 3
# Relative excess over its limits that a response counts as which never settles, before its error at the end is added.
# A smaller one prefers such a response to one that settles and breaks a limit; a larger one only changes the scale.
UNSETTLED_EXCESS = 10.0
# Simulations of the local search for all limits together. Fewer report a relaxation larger than is needed; more cost
# time in proportion.
MAX_LOCAL_SIMULATIONS = 200

# Result

# Room left of a limit, a fraction of it, within which it counts as active. A smaller one misses limits that the
# search's margin keeps a design away from; a larger one names limits that hold nothing back.
ACTIVE_ROOM = 0.02
MIN_DERIVATIVE_RATIO = 0.01
"""Td/Tf below which a derivative adds less than 1 % to Kp at any frequency: its time would be a riddle."""

# Search

# Relative difference of the certified from the claimed objective that a certificate allows, up or down. A smaller one
# refuses designs for the search's coarser samples; a larger one certifies designs whose response grazes the band, and
# claims that the search has misread.
MAX_CERTIFIED_EXCESS = 0.01
# Defects that a status tells: fewer hide that there are several; more bury the remedy.
MAX_DEFECTS_TOLD = 3
# Margins tried, each twice the one before. Fewer give up on designs that need more room to survive the certificate;
# each more costs another search where no design exists.
MARGINS_TO_TRY = 3
# Rounded designs certified at each margin, at most. Fewer miss the one that survives; each more costs an independent
# simulation of every case.
MAX_CERTIFIED_POINTS = 5
# Rounds in which the neighbours of the best rounded design are simulated. Fewer miss a rounding that loses next to
# nothing; more move the design away from the one that was found.
ROUNDING_ROUNDS = 3
# Horizons over which a design is sought whose rival hunted or crept after one, the first that the stroke allows: fewer
# do not show it; more cost time in proportion.
HORIZON_FACTORS = (4.0, 2.8, 2.0, 1.4)
# Searches on closer samples or with shorter steps, at most: fewer claim figures of responses that are not resolved;
# more cost a search each.
MAX_REFINED_SEARCHES = 3
# Change of a requirement on closer samples, relative to its value and its limit, above which a search is repeated on
# them. A smaller one repeats searches for digits that no ranking needs; a larger one claims figures that the
# certificate refuses.
SAMPLING_TOLERANCE = 5e-3
# Margin of the search for the least relaxation of a limit, a fraction. A larger one reports more than is needed; at
# zero the design found does not survive its certificate.
RELAXATION_MARGIN = 0.002
# Members of the population and trials in all, for each free gain. Fewer miss designs that keep the limits; more delay
# the answer where there is none.
MEMBERS_A_GAIN, TRIALS_A_GAIN = 15, 900
SEED = 0  # of the random numbers, so that an answer repeats
# Designs that are certified one after the other, at most, and how far apart they lie, a share of a gain's range. Fewer
# or closer ones fail alike; each more costs an independent simulation of every case.
MAX_CANDIDATES, CANDIDATE_DISTANCE = 8, 0.05

# Simulator

# Samples between two states that a run keeps, from which a second one sets out for the fastest sample. Fewer take
# memory and time to write; more lengthen that second run.
KEPT_STATES = 64
# Lanes up to which different references run together, the shorter ones padded. Fewer leave a processor's lanes empty;
# more waste time on the padding.
MAX_MIXED_LANES = 32
# Lanes that are run and read at a time. Fewer leave cores idle; the responses of more do not fit a processor's cache.
MAX_CHUNK_LANES = 128
# Samples of a dither period during a search. Fewer shift settling times by more: at ten by 0.1 ms on the drive of
# problems/speed/t32.py, 3 ms at worst; more cost time in proportion.
COARSE_SAMPLES_A_PERIOD = 10
# Corners of the gains' box, the fastest on the nominal plant, at which the fastest mode is sought on the scenarios'
# plants. Fewer may miss a stiff one, on which RK4 is then unstable; each more costs an eigenvalue problem a plant.
STIFFEST_CORNERS = 8
# Highest frequency at which a sampled loop is read, times its sample time [rad]: below ten, its last crossings are
# missed; more thin out the grid.
MAX_SAMPLE_ANGLE = 20.0

# Space

# RK4 steps between two samples, at most. A lower limit refuses stiff loops that could be run; with a higher one a
# search whose bounds let a filter get too fast takes hours instead of naming them.
MAX_LOOP_SUBSTEPS = 100
# Distance from a bound, a fraction of the range, within which a gain is rounded to the bound. A larger one moves gains
# that matter; below a solver's tolerance an unused derivative time is printed as 1e-9 s.
BOUND_DISTANCE = 1e-6
# Rounded points around a design that are simulated, at most: 5^4, all that differ by two last places or less in four
# gains. Fewer miss roundings that keep the limits; each more costs a simulation.
MAX_ROUNDING_POINTS = 625
INTEGRAL_OUTPUT = -1  # index of the signal's integral, under dither the last output and the last state
# Size of an output [its unit] from which a response counts as running away. A lower level may be reached by sound
# signals in small units (pressures in Pa); beyond a higher one the metrics of a diverging response lose their digits.
RUNAWAY_LEVEL = 1e12
# The largest objective that a search tells apart, in place of infinity. Below what objectives reach (seconds, percent,
# volts) good designs would tie; far above it the grading of broken limits, which is multiplied by it, loses digits.
WORST_MERIT = 1e6
# Multiple of the tolerances of a certificate's readings that a search's samples keep. A smaller one searches on more
# samples than a ranking of designs needs; a larger one claims figures that the certificate refuses.
SEARCH_TOLERANCE = 5.0

# Tune

# Starts that must end in the same optimum for a search to be believed alone: a single one may be the nearest of many;
# more search twice where two have confirmed each other.
MIN_AGREEING = 2

# Two phase

# RK4 steps between two nodes up to which the method is chosen. A lower number leaves loops to the race that are solved
# exactly (the published one takes 3 steps). With a higher one a response leaves its band between two nodes, unseen, and
# a start takes long: of six lags of second order with 4 to 16 steps none was certified in 6 to 20 s, all by the race in
# 1.5 s; of an oscillator with dead time and 10 steps 36 s gave 0.67 s to settle, 2 s of the race 0.30 s.
MAX_STEPS_A_SEGMENT = 3.5
# Share of the margin that limits on peaks of command and sensitivity are tightened by. With less, rounding the gains
# breaks them; more gives performance away, for the exact problem misses no peak.
EXACT_PEAK_MARGIN = 1 / 300
# Relative difference of two objectives below which starts agree. A smaller one counts the solver's tolerance as another
# optimum; a larger one hides local optima.
OPTIMA_TOLERANCE = 1e-3
# Starts after which the search ends if most of them have failed. One that fails takes longer than one that succeeds,
# and where most fail the exact problem is hard (of an oscillator with dead time 9 of 10 starts): a lower number gives
# up after a bad draw, a higher one delays the search by simulation that `tune` then makes.
MIN_STARTS = 3

# Validation

# Percentile of the plants that the figures show [%]. A lower one says little of bad plants; near 100 a few plants
# decide it, as they decide the worst.
SUMMARY_PERCENTILE = 95.0
# Digits to which a relaxed limit is rounded, away from what is asked; fewer give away more than is needed.
RELAXED_DIGITS = 3
# Parameters that an advice names, at most: more are no longer a hint where the trouble comes from.
MAX_ADVISED_AXES = 3
