"""The numbers that decide in `evaluation`, each with its unit and what it decides."""


# Batch margins

# Frequencies spread over the range, beside those about the closed poles. Fewer miss a broad maximum between them;
# more cost time in proportion.
SPREAD_FREQUENCIES = 48
# Finer grids about the two highest peaks, each within two steps of the last, and the frequencies of each. Fewer of
# either show a sharp resonance too low; more cost time in proportion.
PEAK_REFINEMENTS = 4
PEAK_GRID_POINTS = 9
LOOPS_AT_A_TIME = 128  # more do not fit the processor's cache; fewer spend their time between the operations

# Certificate

# Horizons to which a response is continued at most: with fewer, hunting that begins with a slow integral goes unseen;
# more cost time in proportion.
MAX_HORIZONS = 16
# Instants that a continuation may simulate. Below, a loop of 10 kHz or with a fast dither stays undecided; above, its
# certificate takes minutes.
MAX_CONTINUATION_INSTANTS = 200_000
# Tolerance of a continuation, relative; its absolute one is a hundredth. A smaller one costs twice the time for digits
# of which only a share of the settling band counts.
CONTINUATION_TOLERANCE = 1e-8
# Peak to peak of the mean over half the record, as a share of the settling band, that counts as standing. A larger one
# takes slow creep for rest; a smaller one continues responses whose ringing has all but gone.
STANDING_SHARE = 0.1
# Change of the command, were it to drift on to the last horizon, as a share of its largest size, that counts as none.
# A larger one misses an integral that pushes a stuck drive towards its break-away; a smaller one continues responses
# for the last of their decay.
COMMAND_DRIFT_SHARE = 0.01
# Share of a record before a contact with a validity limit that is not judged: the rounded edge of an end stop slows a
# piston some millimetres before it. With less, a speed that holds until the stop creeps; more hides what it did there.
CONTACT_SHARE = 0.1
# Size of the error, in steps, from which a response counts as running away: a lower one takes a large overshoot for
# it, from a higher one on numbers overflow.
RUNAWAY_ERROR = 100.0
# Share of the step below which a response has not moved: below it, a stuck drive whose friction gives way a little
# counts as a motion; above it, a response counts as none that creeps towards the reference.
MIN_MOTION = 0.1
# Overshoot of the continuation beyond the horizon's, as a share of the settling band, from which it takes its place.
# Below, the ripple's mean at the horizon's end decides; above, a larger overshoot goes unsaid.
MIN_LATER_OVERSHOOT = 1e-3
# Ratio of an oscillation's size in the last quarter of the record to that in the quarter before from which it grows.
# A lower one takes irregular hunting for growth; a higher one misses growth that takes many periods.
MIN_GROWTH = 1.1
# Share of the settling band that an oscillation inside it must reach for its growth to count, and a rest for a note
# that it lies near the edge. Smaller ones report what stays far inside; with larger ones only the edge itself counts.
GROWTH_SHARE, EDGE_SHARE = 0.5, 0.9
# Share of the range over half the record that a drift in one direction must cover to be creep: with less, slow hunting
# is creep too; with all of it, the least ringing on the drift hides it.
MIN_DRIFT_SHARE = 0.9
# Horizons within which a response must be in its band for good. With fewer, a design is refused whose user only
# underrated its settling; with more, one counts as settled that for its user's purposes never does.
LATEST_SETTLING = 4.0
MAX_NOTES = 4
"""Notes of a certificate that are shown: fewer hide kinds of notes; more repeat one of them for each case."""
# Relative excess of half a count over the band's half width that counts as none: below, rounding refuses a band of just
# half a count; above, a band that is too narrow passes.
COUNT_TOLERANCE = 1e-9

# Dither

# Share of the static friction below which a dither's force on a body at rest is said not to loosen it: the
# command gives the rest of the force, so a dither may loosen with less than all of it; lower promises too much.
MIN_LOOSENING_FORCE = 0.5
# Cycles of a hunting loop, at its end, over which its error is the largest one: fewer miss the worst of irregular
# cycles, more reach back into the transient.
LAST_CYCLES = 3
# Share by which a dither has to reduce the error of a loop that goes on hunting, to count as better: with less, one
# that shakes a hunting loop a little is useful; with more, no dither is that does not cure it.
MIN_CURE = 0.5
# Ripple from peak to peak, a share of the step, from which a dither is harmful whatever else it does: above, the motion
# goes to and fro instead of along the step; far below, a dither that cures hunting as large is refused.
MAX_RIPPLE_SHARE = 0.5

# Evaluate

MAX_REFERENCE_COLUMNS, MAX_COMPARED_COLUMNS = 3, 2
"""References beside each other, alone and with other figures: more do not fit 80 columns; their worst is shown."""
MIN_SHOWN_PERCENT = 1e-3
"""Least figure in percent that is shown as it is: below, digits of rounding errors hide the others."""

# Limit cycle

# Share of a record that is left out for the transient, unless a start is given: a smaller one takes the transient's
# ringing for a cycle, a larger one leaves too few cycles of slow hunting.
TRANSIENT_SHARE = 0.4
MIN_CYCLES = 3  # fewer cycles do not show whether they repeat; more miss slow hunting in a short record
# Least autocorrelation one period later, relative to the variance: it allows noise as strong as the cycle; a smaller
# one finds cycles in noise alone.
MIN_AUTOCORRELATION = 0.5
# Largest standard deviation of the periods, relative to their mean: filtered noise has more, a smaller one rejects
# irregular hunting.
MAX_PERIOD_SPREAD = 0.35
# Moving averages per period that remove noise before zero crossings are sought: fewer flatten the cycle, more leave
# noise and its crossings.
WINDOWS_PER_PERIOD = 8
# Swing on both sides that a zero crossing needs, in standard deviations: with less, noise crosses too; with more, a
# cycle of varying amplitude loses crossings.
CROSSING_HYSTERESIS = 0.3
MIN_RELATIVE_AMPLITUDE = 0.01  # share of the record's range below which an amplitude counts as none
STANDSTILL_FRACTION = 0.02  # share of the largest speed below which a speed counts as standstill
PHASES_PER_CYCLE = 64  # points of the mean cycle: fewer cut its peaks, more cost time

# Margins

# Speed below which a body counts as resting, a share of its state's nominal value; a rest's own rounding lies below.
RESTING_SPEED = 1e-9
# Share of the largest speed by which a speed may miss it and count as the largest: below, rounding chooses between the
# instants of a steady motion; above, the body still accelerates.
SPEED_TOLERANCE = 1e-3
# Share of a matrix's size by which rounding moves its well conditioned poles. With a smaller one the drift of a piston
# under speed control makes it unstable; with a larger one slow instabilities beside fast filters pass.
POLE_ROUNDING = 1e-13
# Share of the fastest pole beyond which no rounding moves even a double pole at zero, the root of a double's precision.
MOST_POLE_ROUNDING = 1e-7
# Angle over a horizon of the slowest noise that counts [rad]. With a smaller one the noise gain is that of a drift, far
# slower than the response; with a larger one a resonance of slow loops is missed.
NOISE_ANGLE = 0.3
# Relative change of a response between the two lowest frequencies of a grid, below which it is that at rest. With a
# larger one an integral's response counts as one; with a smaller one a gain margin at rest is missed on a coarse grid.
FLAT = 1e-3

# Metric

# Share of a controller's sample time after which an instant counts as one sample later: nearer 1, rounding of the
# instants decides; well below 1, the command's change within a sample would count.
SAMPLE_SHARE = 0.999
# Whole dither periods at the end of a record over which its final value is averaged: fewer average less noise, more
# reach back into the transient.
FINAL_PERIODS = 5
# Share of a record that counts as its end, where ripple is read and a settling comes too late to count: a smaller one
# sees less than a cycle of slow hunting, a larger one reaches back into the transient.
TAIL_SHARE = 0.05
# Largest distance by which the signal is moved towards its mean, in amplitudes of the ripple at the end. Below 1 some
# of a steady ripple stays; at 1 all that it grows by does, where the stroke is passed or the valve is wide open; far
# above it a small ripple lets the mean smooth the transient.
RIPPLE_ALLOWANCE = 2.0
# Least instants in a period at which the wave is read: fewer cut its peaks, more cost time.
MIN_WAVE_PHASES = 20
# Share of a band's half width by which a signal on its edge may lie outside by rounding, and still be in it. At 0 the
# units decide whether a signal that ends on the edge has settled; far above, designs that leave the band have.
EDGE_ROUNDING = 1e-9
# Ratio of the time in the band at the record's end to any stay in it before, from which a response that came in late
# counts as settled. With a lower one slow hunting settles whenever it is inside; with a higher one a stroke that ends
# early makes creep of every response that once touched the band's edge.
MIN_STAY_RATIO = 2.0

# Metrics

# Dither periods that a response must stay in its band to count as settled where its ripple does not: with fewer, one
# that just passes through the band counts too; more ask for longer records.
MIN_SETTLED_PERIODS = 2
# Largest distance of a signal between two readings from the straight line that joins them, a share of the step: with a
# larger one settling times and overshoots are off; a smaller one adds readings that change no digit shown.
LINE_TOLERANCE = 1e-4
# Relative error of the integrals over the error that readings may cause: with a larger one a search compares reading
# errors; a smaller one adds readings that change no digit shown.
INTEGRAL_TOLERANCE = 1e-3
# Parts into which a distance between readings is divided at a time: fewer take more simulations; more add readings
# where they are not needed.
PARTS_AT_A_TIME = 8
# Times that points are added where a response changes fast: each brings them eight times as close. Fewer leave the peak
# of a fast response in a long horizon unread; more cost a simulation each.
MAX_REFINEMENTS = 4
# Factor on the time after a step within which responses of different gains are taken to change equally fast: a smaller
# one misses those that are faster than the first; a larger one adds readings where nothing happens.
SPREAD = 3.0
# Readings of a response, at most: fewer leave a fast response in a long horizon unresolved; more take seconds to read.
MAX_INSTANTS = 60_000

# Moves

# Share of a move over which full command is tried first, and the factor on it where that is too short to come half
# way: larger ones run far beyond the move's end, where a cylinder's model ends; smaller ones try again more often.
FIRST_PUSH, PUSH_FACTOR = 0.1, 1.4
# Instants at which full command is read: fewer blur its times and its peak; more cost time in proportion.
PUSH_SAMPLES = 300
LONGEST_PUSH = 60.0  # [s], of what hardly moves: a shorter one refuses creeping drives, a longer one takes long
PUSH_TOLERANCE = 1e-7  # of the simulation: its figures are shown with three digits
# Bisections of a speed or a share of the limits. Fewer make the figures coarse; each more costs an equilibrium.
MOVE_BISECTIONS = 20
# Largest factor on a move's speeds that is tried for the shortest move: a larger one would end beyond any drive.
MOST_FACTOR = 64.0
# Share of what full command can that a message and the shortest move allow: nearer 1 the samples of a run refuse what
# was advised; lower it gives speed away.
ALLOWED_SHARE = 0.98
# Share of the stroke kept free at either end, and the least length of it [m]: less leaves a wrong guess of the gain no
# room to overshoot, more leaves no way to become fast on.
MARGIN_SHARE, LEAST_MARGIN = 0.1, 0.01
# Shortest way between the margins [m]: on a shorter one the fast moves end before the following error has settled.
LEAST_SPAN = 0.03
# Share of the fastest move that the drive's file allows: more, and a drive half as strong as its file says cannot
# follow; less leaves conductance and viscous friction to a part of the valve's travel.
FAST_SHARE = 0.5
# Least speed of the fastest moves [m/s], several Stribeck speeds of usual seals: with less, viscous friction is taken
# for Coulomb's.
LEAST_FAST_SPEED = 0.05
# Speeds of the medium, calm and slow moves over that of the fast ones [1].
MEDIUM, CALM, SLOW = 0.4, 0.15, 0.03
# Lengths of the calm, the slow and the short moves over the span [1].
CALM_WAY, SLOW_WAY, SHORT_WAY = 0.4, 0.08, 0.01
# Largest sensitivity of the plain controller on the plant as guessed [1], sliding: a gain half as large again, which a
# wrong conductance makes of it, is then still stable.
GUESSED_SENSITIVITY = 2.0
# Share of the command per span from which the gain is sought downwards, and the factor between two tries [1].
FIRST_GAIN, GAIN_STEP, MOST_TRIES = 100.0, 0.85, 80
REST_BEFORE = 0.5  # [s] before the first move: pressures at rest are read from it
# A dwell lasts until the error of a following at the move's speed would be this share of the span [1], and so long at
# least [s]: after shorter ones the axis still moves, longer ones show nothing more.
SETTLED_SHARE, LEAST_DWELL = 0.005, 0.3
LONGEST_STEP = 2e-5  # [s] of the simulation as guessed: longer ones are unstable where friction turns over .1 mm/s
# Part of the way from the run's ends to the stops that the simulated overshoot may take: more leaves none to a drive
# that is not as guessed.
MOST_OVERSHOOT = 0.5
PLACE_DIGITS, DWELL_DIGITS = 5, 2  # of places [m] and dwells [s] after the point: so a file shows them whole

# Plants

# Plants on which a design is tried. If it holds on all of 100, at least 97 % of such plants hold with 95 % confidence
# (0.05^(1/100)); fewer say less, more cost time in proportion.
PLANT_COUNT = 100
# Share by which a controller's gain differs from the printed one: rounding to three digits, integer scaling in a PLC.
GAIN_TOLERANCE = 0.01
FIT_SHARE = 0.95  # of the plants [1] that lie between the low and the high end of a fit's estimate

# Requirements

LEAST_ROOT = 1e-300  # keeps the derivative of a root finite where nothing is off: 0/0 otherwise
ANR_DENSITY = 1.185  # density of air in the standard state of ISO 8778 (ANR: 100 kPa, 20 degC, 65 % humidity) [kg/m^3]
LITRES_PER_CUBIC_METRE = 1e3

# Response

# Samples of a response of a loop without sample time: fewer blur a settling time, more cost time in proportion.
RESPONSE_SAMPLES = 1000
# Readings of a sampled loop over a horizon, and the least and most of them a sample: with fewer, the signal leaves the
# settling band between two readings unseen; more cost time in proportion.
READINGS_A_HORIZON, MIN_READINGS_A_SAMPLE, MAX_READINGS_A_SAMPLE = 1000, 2, 16
# Samples a period of a continuous dither: with six, the averaged response of a drive with friction seems to settle in
# 47 ms where it takes 63 ms; more cost time in proportion.
SAMPLES_A_DITHER_PERIOD = 20
# Points of the simulated record for each reading of a search: with one, the record would miss what happens between the
# search's readings just as the search does; more cost time in proportion.
POINTS_PER_READING = 4
# Instants over a horizon at which a reference is read: fewer miss a turn by more of its way, more take longer.
TRAVEL_SAMPLES = 2001

# Rest check

# Standstills whose errors are compared: of fewer nobody can say whether hunting decays; more take longer than a minute
# of slow hunting.
MIN_STANDSTILLS = 3
# Ratio of the error at a standstill to that at the one before from which hunting does not decay. A lower one takes the
# last slips of a loop that comes to rest for hunting; a higher one misses hunting of varying size.
MIN_KEPT_ERROR = 0.9
# Change of the command over the second half of the run, as a share of its largest size, that counts as none. A larger
# one takes an integral that still pushes a stuck body for rest; a smaller one rounding.
MIN_PUSH = 1e-6
# Motion over the second half, as a share of the step, below which a body that never sticks has come to rest: without a
# break-away force its motion dies away. A larger one hides creep, a smaller one waits for what nobody sees.
STILL_SHARE = 1e-4
# Instants at which a continuous loop is read, each second, and at most: fewer miss the extremes of a fast hunting, more
# cost memory; a body that hunts slowly stands at its extremes.
READINGS_A_SECOND, MAX_READINGS = 200, 50_000
# Tolerance of the integration, relative: a larger one moves a break-away's instant, a smaller one costs time.
TOLERANCE = 1e-8
USUAL_DURATION = 60.0
"""How long a loop is watched [s], unless it is said: hunting of a servo axis has periods of seconds."""

# Scenarios

MIN_PROBABILITY = 1e-6
"""Probability [1] that a distribution must leave within a parameter's bounds: below it, its tail has no digits left;
a larger one refuses what is only cut off."""
EDGE = 2.0**-53  # share nearest to 0 and 1 [1]: at these themselves a quantile is infinite
MAX_CORNERS = 4096  # plants, 12 axes: each one is simulated for every candidate, and another axis doubles their number
# Draws until a sample lies within the bounds: fewer refuse a covariance that reaches beyond them, more only delay the
# error where hardly any draw fits.
MAX_DRAWS_PER_SAMPLE = 1000

# Specification

# Largest sensitivity of a loop that a search takes for stable where none was asked for. With a smaller one good designs
# on fast loops are lost that nobody had forbidden; with a larger one designs are found that a tenth more or less gain,
# or another operating point, makes unstable.
STABILITY_SENSITIVITY = 10.0
