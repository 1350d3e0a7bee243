"""The numbers that decide in `shooting`, each with its unit and what it decides."""

import math

# Arrow

# smallest eigenvalue [1] of a matrix of unit diagonal that counts: lower takes rounding for information, higher calls
# separable parameters indistinguishable
RANK_TOLERANCE = 1e-12
# relative rounding error of a Schur complement from long chains of tight gaps (1 to 5e-16 measured): lower trusts lost
# digits, higher gives up parameters that the data determine
SCHUR_ROUNDING = 1e-14
# added to D's diagonal (scaled states): a state that no data depend on stays in place, and the optimum does not move;
# lower leaves D singular, higher slows the other states
STATE_REGULARISATION = 1e-6

# Equations

# width of a flat prior, in standard deviations by the data with all else known: lower lets the prior narrow intervals,
# higher loses digits
FLAT_PRIOR_WIDTH = 1e3
# share [1] of a step's squares below which a segment's excess is no curvature: lower takes rounding for it, higher
# leaves a node that overshoots
CURVATURE_RESOLUTION = 1e-6
# share of all nodes [1], and least number, that may overshoot: more slow a search down that is still far off, fewer
# leave the step of all to be cut for the sake of some
MAX_OVERSHOOTING_SHARE, MIN_OVERSHOOTING_NODES = 0.02, 3
# share of the excess [1] that these nodes must make up: lower damps nodes where the parameters' step is too long
MIN_LOCAL_EXCESS = 0.9
MAX_NODE_DAMPING = 1e6  # times a node's diagonal [1]: higher overflows, lower lets a node move that must not
# standard deviation over a weak prior's from which a parameter is held: there the prior makes up a tenth of the
# information of both; smaller holds what the data do determine, larger lets a search crawl along a valley
UNIDENTIFIABLE_PRIOR_RATIO = 1 / 3
# standard deviation of the prior about a start, in e-folds: lower holds wrong guesses, higher lets what wide gaps hide
# drift to where tight ones cannot tell it any more
START_PRIOR_DEVIATION = 1.0
WEAK_PRIOR_DEVIATION = math.log(10)  # of a weak prior, in e-folds: a factor of ten either way
# squared residuals that an e-fold change of a log parameter has to move, or it has no effect: smaller searches in
# rounding, larger holds what good data would show
MIN_LOG_INFORMATION = 1e-6

# Filters

# segments a piece, and before it, from which its states come: fewer leave it the error of its start, more take more
# steps one after the other
PIECE_SEGMENTS = 100
START_DEVIATION = 0.1  # of the state where a piece or a log begins, in nominal sizes [1]: about that of rough states
# deviation that a state gathers from one node to the next, in nominal sizes [1], by parameters that are not known well:
# lower follows wrong ones away from the measurements, higher leaves states that do not fit together
GATHERED_DEVIATION = 1e-4
KNOWN_DEVIATION = 1e-6  # of a state that is given, likewise
UPDATES = 4  # linearisations a segment: fewer miss a slip, more cost time
SETTLED_SQUARES = 0.01  # change of the squares [1] by which no state counts: lower takes updates that move none
STEP_CUT = 0.3  # of a step that has not helped [1]: higher tries it again too far, lower hardly moves
# squares of a segment, over its samples, beyond which they count by their logarithm [1]: lower is blind to what wrong
# parameters miss, higher lets one lost slip outweigh a log
ROBUST_SQUARES = 4.0
DAMPINGS = (1e-2, 10**-0.5, 10.0, 10**2.5)  # over the last one, tried side by side: wider spreads overshoot
FIRST_DAMPING, LEAST_DAMPING = 1e-2, 1e-6  # over the diagonal [1]: lower takes wild first steps, higher small ones
GIVEN_UP_DAMPING = 10.0  # where no damping helps beyond it, a descent has ended; higher takes time
SETTLED_DECREASE = 1e-3  # of the cost [1] at which a descent has ended: lower takes time, 1e-2 ends one too early
MAX_BATCH_NUMBERS = 4_000_000  # numbers of 8 bytes in a batch: more take memory, fewer time

# Full space

# integration steps up to which a segment is flattened to scalars, which evaluate faster: higher takes long to flatten
MAX_EXPANDED_STEPS = 400
# scalar operations up to which the whole graph is flattened to scalars: higher takes long to flatten, lower evaluates
# slowly
MAX_EXPANDED_OPERATIONS = 200_000
# barrier and distances from bounds [1] with which a solution's neighbour starts, in 9 iterations instead of 18: higher
# forgets the solution, lower starts on the bounds
WARM_START_BARRIER = 1e-5
# extrapolation along a path, in its last steps [1]: higher overshoots where the path bends, lower takes more iterations
MAX_EXTRAPOLATION = 1.5

# Least squares

# gap [1] beyond which log parameters are drawn to their start: lower biases what tight gaps tell, higher lets them
# drift to where tight gaps cannot tell them any more
WIDE_GAP = 2e-4
# share of the cost [1] that the gaps may carry: above it they absorb the misfit of a model; lower refuses good fits
MAX_GAP_SHARE = 0.05
# squared residuals a sample, in noise variances [1], up to which a fit explains the log to its noise: lower takes
# chance for misfit, higher passes a wrong model
MAX_CHI_SQUARE_RATIO = 1.2
# Marquardt's damping over the diagonal [1] with loose gaps: lower takes wild first steps, higher small ones
INITIAL_DAMPING = 1e-3
# least damping over the diagonal [1], in which the gaps weigh up to 1e14: higher slows parameters, lower is rounding
MIN_DAMPING = 1e-15
# actual over promised decrease [1] below which the nodes settle after a step: higher costs evaluations, lower crawls in
# valleys
MIN_GAIN_RATIO = 0.5
# steps of the nodes alone that close gaps, after a step that misses its promise or for a run from end to end: fewer
# creep along the bend of a valley (bristles at 60 s: .05 % an iteration), more follow nodes that do not settle
MAX_NODE_STEPS = 3
MAX_TRIES = 10  # dampings tried for a step: fewer give up where a step exists, more try what no longer moves anything
# undamped steps over a kink: fewer turn back before the cost has fallen again, more follow steps that diverge
MAX_UNDAMPED_STEPS = 10
# e-folds of a log parameter in a step: longer ones leave the model's range, shorter ones take more
MAX_LOG_CHANGE = 2.0
# relative decrease of the cost an iteration [1] below which a search has stalled: lower keeps crawling, higher gives up
STALL_COST_DECREASE = 2e-3
# error of the parameters [standard deviations] by derivatives from before the integration was refined: higher shifts
# estimates, lower costs a run with sensitivities
MAX_GRADIENT_ERROR = 0.01
# iterations of the last stage right after the first, and of each of its repeats, at most: more are lost where stages
# between are needed, and go on after a search has settled; fewer do not converge, and take a slow search for settled
TRIAL_ITERATIONS = 10
# squares that the last stage promises by the linearised equations, in noise variances [1], above which it is not tried
# right after the first: lower passes over it for a start that is only not yet near, higher iterates for wrong models
MAX_JUMP_MISFIT = 10.0
# stages at whose gaps noise of the states is tried [1]: fewer miss those at which a search settles, more of them hardly
# hold the states together
MAX_LOOSENED = 2
# creeping steps in a row after which a search with noise of the states takes undamped ones: fewer leave a way that
# leads on, more take long
MAX_CREEPING_STEPS = 3
MAX_STEP_HALVINGS = 3  # halvings of the integration steps: more cost time, fewer leave an answer that depends on them
# times that the iterations of the last stage are repeated near the noise [1]: fewer leave a search over kinks (bristles
# at rest) before its end, for other starts that take longer; more follow one that does not end
MAX_REPEATS = 3
# decrease of the cost by an iteration, over itself [1], with which a search goes on that is not near the noise yet:
# lower follows one that creeps, higher ends one that is about to come there
STEEP_DECREASE = 0.1
# step [standard deviations] up to which a search has settled where a repeat has moved no estimate: lower follows what
# kinks ask for in vain (100 iterations of bristles at rest for .1 deviations), higher takes a slow search for one that
# has settled; and where the gaps stand for noise of the states, whose every estimate is marked anyway
MAX_SETTLED_STEP, MAX_NOISY_STEP = 0.5, 1.0
# damping of a node alone, over its diagonal [1], beyond which a kink traps it, for it moves less than half as far as
# its equations ask: lower moves nodes that are only slow, higher leaves some behind
TRAPPING_DAMPING = 1.0
FIRST_JOINING_STAGE = 2  # stage from which two searches may join: before it the gaps are so wide that all cost alike
# promised decrease over the cost [1] at which a stage ends, so that searches which have joined differ by no more: lower
# wastes iterations and follows one optimum twice, higher ends stages too early and takes two optima for one
STAGE_COST_TOLERANCE = 1e-3
# promised decrease at which the last stage ends, in noise variances: half of (0.1 % of a standard deviation)^2
FINAL_COST_TOLERANCE = 5e-7
# promised decrease in noise variances at which the last stage ends where no parameter moves: lower iterates for states
# that no parameter depends on, higher leaves costs that are compared short of their least
SETTLED_COST_DECREASE = 0.01
# step of a parameter over the tolerance of convergence [1] at which the last stage ends: lower settles states that no
# parameter depends on, higher leaves the parameters short of their optimum; and where finer steps follow, which move it
FINE_TOLERANCE, COARSE_TOLERANCE = 0.01, 0.5
# the same where the model misses the logs, in deviations by the residuals: lower follows Gauss-Newton steps that go to
# and fro (30 iterations of .02 deviations on a log with sensor lag), higher leaves costs that differ at one optimum
MISFIT_TOLERANCE = 0.2
# iterations of a stage after which that counts: fewer leave optima that soon would be exact, more take time
PATIENT_ITERATIONS = 8
# promised decrease over the cost [1] at which such a first stage ends: lower iterates for what the last one finds
# anyway, higher jumps from a start that is not near
JUMP_COST_TOLERANCE = 1e-2
# actual over promised decrease [1] below which a search with noise of the states creeps: higher leaves a fit that
# converges, lower follows a kink of the model for hundreds of steps (encoder steps: 50 of .13 each, of 35 promised)
CREEPING_SHARE = 0.3
# shift of a node that open gaps still cause, in nominal sizes: higher shows in the errors of the run, lower is rounding
MAX_SHIFT = 1e-6

# Segments

SUBSTEPS_CAP = 1000  # integration steps a sample, at most: more take hours, fewer hide how stiff an absurd start is
MAX_STIFFNESS_NODES = 100  # nodes at which the stiffness is computed: more cost time, fewer miss the stiffest
# relative change of a parameter [1] after which the stiffness is computed anew: higher risks unstable steps
STIFFNESS_UPDATE_CHANGE = 0.03
MAX_SEARCH_SUBSTEPS = 200  # integration steps a sample: a search with more would take hours, fewer refuse stiff models
MAX_STAGE_REFINEMENT = 8  # factor on the start's integration steps in a stage: higher takes long, lower may be unstable
# RK4 steps over steps that are implicit in a state, at least [1]: such a step takes as long as one and a half of RK4's
# and is of lower order; higher leaves stiff plants slow, lower gives exactness away
MIN_IMPLICIT_GAIN = 4.0
# steps a sample that are implicit in a state, at least: fewer take crossings of rest so coarsely that estimates move,
# more take longer
MIN_IMPLICIT_SUBSTEPS = 4
# factor on a stage's refinement where steps are implicit in a state [1]: lower leaves errors that add up along a log,
# higher takes longer
IMPLICIT_REFINEMENT = 4
STABILITY_RESERVE = 1.3  # RK4 steps over those that it needs, as they are counted, below which it becomes unstable [1]
# values of a state at which its growth rate is asked for, on either side of zero, and the range that they span [1]:
# fewer may miss the steepest fall of friction, more take longer
GROWTH_POINTS, GROWTH_RANGE = 12, 1e-3
