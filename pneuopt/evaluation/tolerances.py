"""The numbers that decide in `evaluation`, each with its unit and what it decides."""

# Simulations and readings

SIMULATION_TOLERANCE = 1e-8  # relative, of continuations and rest checks; the absolute one is a hundredth of it
READINGS_A_HORIZON = 1000  # at least: with fewer, a signal leaves the band between two readings unseen
MIN_READINGS_A_SAMPLE, MAX_READINGS_A_SAMPLE = 2, 16  # of the controller, whatever the horizon
# of a continuous dither, with 6 a drive that settles in 63 ms seems to take 47 ms; likewise of any dither's ripple,
# whose peaks fewer would cut
SAMPLES_A_DITHER_PERIOD = 20
POINTS_PER_READING = 4  # of the record for each reading of a search: with 1 both would miss the same
MIN_SETTLED_PERIODS = 2  # of a dither that a response stays in its band to count as settled where its ripple does not
LINE_TOLERANCE = 1e-4  # largest distance of a signal between two readings from the line that joins them [step]
INTEGRAL_TOLERANCE = 1e-3  # relative error of the integrals over the error that readings may cause
MAX_REFINEMENTS = 4  # times that readings are added: each brings them eight times as close and costs a simulation
SPREAD = 3.0  # factor on the time after a step within which other gains' responses change equally fast
MAX_INSTANTS = 60_000  # readings of a response: fewer leave a fast response in a long horizon unresolved

# The record of a step

SAMPLE_SHARE = 0.999  # of a sample time after which an instant is one sample later: it allows for rounding
FINAL_PERIODS = 5  # of a dither at a record's end, over which its final value is averaged
TAIL_SHARE = 0.05  # of a record that is its end, where ripple is read and a settling comes too late to count
RIPPLE_ALLOWANCE = 2.0  # amplitudes of the ripple by which the signal moves towards its mean: 1 leaves a growing ripple
EDGE_ROUNDING = 1e-9  # share of a band's half width by which rounding may put what lies on its edge outside
MIN_EXIT = 1e-3  # of a band's half width: an exit by less refutes no settling, for readings are no more exact
NO_OVERSHOOT = 1e-4  # overshoot [step] that counts as none: ten times what readings and rounded gains tell apart
MIN_STAY_RATIO = 2.0  # of the last stay in the band to the longest before, from which a late response has settled

# Limit cycles

TRANSIENT_SHARE = 0.4  # of a record, left out unless a start is given: less takes a ringing for a cycle
# fewer, of a cycle or of hunting's standstills, do not show whether they repeat or decay; so many of the last cycles
# show a hunting loop's largest error
MIN_CYCLES = 3
MIN_AUTOCORRELATION = 0.5  # one period later, relative to the variance: less finds cycles in noise alone
MAX_PERIOD_SPREAD = 0.35  # standard deviation of the periods over their mean: filtered noise has more
WINDOWS_PER_PERIOD = 8  # moving averages per period that remove noise before crossings are sought
CROSSING_HYSTERESIS = 0.3  # swing on both sides that a crossing needs, in standard deviations: with less, noise crosses
MIN_RELATIVE_AMPLITUDE = 0.01  # share of the record's range below which an amplitude counts as none
STANDSTILL_FRACTION = 0.02  # share of the largest speed below which a speed counts as standstill
PHASES_PER_CYCLE = 64  # points of the mean cycle: fewer cut its peaks
SUSTAINED_RATIO = 0.98  # of a cycle's size to the last: by two standard errors below it, a ringing decays
DECAY_RATIO = 0.8  # likewise, whatever the standard error

# Margins

RESTING_SPEED = 1e-9  # share of a speed's nominal value below which a body rests; a rest's own rounding lies below
SPEED_TOLERANCE = 1e-3  # share by which a speed may miss the largest one and count as it: rounding lies below
POLE_ROUNDING = 1e-13  # share of a matrix's size by which rounding moves its well conditioned poles
MOST_POLE_ROUNDING = 1e-7  # share of the fastest pole beyond which rounding moves no double pole at zero
NOISE_ANGLE = 0.3  # of the slowest noise that counts, over a horizon [rad]: slower noise is a drift
DELAY_ANGLE = 25.0  # of a dead time [rad], up to which frequencies are spread evenly: loops roll off before four turns
MOST_TANGENT = 1e6  # of half a sample's angle: nearer to half the sampling frequency an angle has no digits left
FLAT = 1e-3  # relative change of a response over a grid's two lowest frequencies, below which it is that at rest

# The certificate

MAX_HORIZONS = 16  # to which a response is continued: with fewer, hunting of a slow integral goes unseen
MAX_CONTINUATION_INSTANTS = 200_000  # simulated at most: fewer leave a loop of 10 kHz undecided, more take minutes
STANDING_SHARE = 0.1  # of the band: peak to peak of the mean over half the record that counts as standing
COMMAND_DRIFT_SHARE = 0.01  # of its largest size, which the command may drift by to the last horizon: a windup is more
CONTACT_SHARE = 0.1  # of a record before a contact that is not judged: an end stop's rounded edge slows the piston
RUNAWAY_ERROR = 100.0  # from which a response runs away [steps]: no overshoot is as large, no number overflows
MIN_MOTION = 0.1  # below which a response has not moved [steps]: a stuck drive gives way a little
MIN_LATER_OVERSHOOT = 1e-3  # of the band, beyond the horizon's overshoot: the ripple's mean differs by less
MIN_GROWTH = 1.1  # ratio of the last quarter's oscillation to that of the quarter before: irregular hunting has less
GROWTH_SHARE, EDGE_SHARE = 0.5, 0.9  # of the band, from which an oscillation's growth counts, and a rest gets a note
MIN_DRIFT_SHARE = 0.9  # of the range over half the record that a drift in one direction covers: slow hunting has less
LATEST_SETTLING = 4.0  # horizons within which a response must be in its band for good

# Rest by events

MIN_KEPT_ERROR = 0.9  # ratio of the error at a standstill to the one before, from which hunting does not decay
MIN_PUSH = 1e-6  # share of the command's largest size by which it changes over the second half: rounding is less
STILL_SHARE = 1e-4  # of the step: a motion over the second half below which a body that never sticks dies away
READINGS_A_SECOND, MAX_READINGS = 200, 50_000  # of a continuous loop: fewer miss the extremes of a fast hunting

# The use of a dither

MIN_LOOSENING_FORCE = 0.5  # share of the static friction below which a dither's force does not loosen a body
MIN_CURE = 0.5  # share by which a dither must reduce the error of a loop that hunts on, to count as better
MAX_RIPPLE_SHARE = 0.5  # of the step, from peak to peak: from there on a dither is harmful whatever else it does

# Whether a move can be made

LONGEST_PUSH = 60.0  # [s], of what hardly moves: a shorter one refuses creeping drives
MOST_FACTOR = 64.0  # on a move's speeds that is tried for the shortest move: more would end beyond any drive
ALLOWED_SHARE = 0.98  # of what full command can that is advised: nearer 1 the samples of a run refuse it

# The excitation run

MARGIN_SHARE, LEAST_MARGIN = 0.1, 0.01  # of the stroke free at either end, at least [m]: a guessed gain overshoots
LEAST_SPAN = 0.03  # [m] between the margins: on less the fast moves end before the following error has settled
GUESS_SHARE = 0.5  # of the fastest move, and of the way to the stops: the drive may be half as strong as its file says
LEAST_FAST_SPEED = 0.05  # [m/s], several Stribeck speeds: with less, viscous friction is taken for Coulomb's
MEDIUM = 0.4  # speed of the medium moves over that of the fast ones
GUESSED_SENSITIVITY = 2.0  # of the plain controller on the plant as guessed: a gain half as large again is stable
GAIN_STEP = 0.85  # factor from a proportional gain that is tried to the next: a smaller one gives away gain
REST_BEFORE = 0.5  # [s] before the first move: pressures at rest are read from it
SETTLED_SHARE, LEAST_DWELL = 0.005, 0.3  # of the span, to which a dwell lets the following error decay; at least [s]
LONGEST_STEP = 2e-5  # [s] of the simulation as guessed: longer ones are unstable where friction turns over .1 mm/s

# Plants, scenarios and the search

PLANT_COUNT = 100  # if a design holds on all, at least 97 % of such plants hold with 95 % confidence: .05^(1/100)
GAIN_TOLERANCE = 0.01  # share by which a gain differs from the printed one: three digits, a PLC's integers
MIN_PROBABILITY = 1e-6  # that a distribution must leave within the bounds: below it, its tail has no digits left
MAX_CORNERS = 4096  # plants, 12 axes: each one is simulated for every candidate
MAX_DRAWS_PER_SAMPLE = 1000  # until a sample lies within the bounds: fewer refuse a covariance that reaches beyond them
STABILITY_SENSITIVITY = 10.0  # largest one of a loop that a search takes for stable where no limit was asked for
