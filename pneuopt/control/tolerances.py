"""The numbers that decide in `control`, each with its unit and what it decides."""


# Averaging

MAX_NEWTON_ITERATIONS, NEWTON_TOLERANCE, MIN_NEWTON_STEP = 50, 1e-9, 1e-3
# Phases of a dither period over which is averaged, at least: fewer miss the edge of a dead zone between two of them,
# more cost time in proportion.
RIPPLE_PHASES = 32
# Newton steps, halved ones included, that the balance of the first harmonic may take. With fewer, a swing across
# Stribeck's minimum is left unbalanced; more are spent on lanes that have no balance at all.
MAX_BALANCE_STEPS = 40
# Newton step at which the balance counts as solved, a fraction of the swing; what is left is about its square. A larger
# one shows in Ms (0.01: 1e-4); a smaller one costs a step and changes nothing.
BALANCE_TOLERANCE = 1e-4
MIN_BALANCE_FRACTION = 1e-3  # of a Newton step: a swing that a smaller one does not improve is kept as it is

# Compensators

LEAST_SMOOTHING = 1e-9  # [any unit] of a smooth sign: at zero it would jump, and a rest has no derivative
PULSE_SAMPLES, PERIOD_SAMPLES = 2, 10  # [samples] defaults: shorter or rarer pulses move nothing, longer push through
CHANGE_SMOOTHING = 0.01  # [command's unit] default: a small one knocks on noise, a large one knocks too weakly
DIRECTION_SMOOTHING = 1e-3  # [measured unit] default: m/s or rad/s; a small one chatters about rest, a large one gives
COMMAND_SMOOTHING = (
    0.02  # [command's unit] default: a small one jumps about zero, a large one leaves a part of the zone
)
PULSE_WIDTH, PAUSE = 0.018, 0.016  # [s] defaults: a valve's spool cannot follow shorter pulses, longer ones go too far
LEAST_LIMIT, LEAST_TOLERANCE = 1e-9, 1e-12  # [command's unit, error's unit] by which is divided
PULSE_TOLERANCE = 1e-4  # [error's unit] default: a tenth of a millimetre
GROWTH, BRAKE = 1.1, 0.6  # [1] defaults: a larger growth arrives sooner, or beyond the reference; see `brake`
PULSE_SHARE = 0.5  # part of the error that a pulse shall take away: more overshoots, less needs more pulses
# Exponents of the ratio of the way wanted to that of the last pulse, where the peak rises and where it falls. A force
# that rises and falls at a given rate moves a body over (P - F)^3, F being the breakaway force: a peak of 1.2 F has a
# slope of 18 in logarithms, one of 1.6 F of 8. With larger ones the body is thrown to and fro, with smaller ones the
# peak learns slowly.
RISE, FALL = 0.05, 0.15
STANDSTILL_SHARE = 0.2  # of the tolerance: changes of the error below are a standstill; an encoder's count lies below
# Factor by which the peak rises at least towards one that has gone too far, and beyond it, should it no longer move the
# body: a larger one throws it, a smaller one takes more pulses.
LEAST_RISE = 1.02
LEAST_PEAK = 1e-9  # [command's unit] by which is divided
LEAST_WAY = 0.06  # of the tolerance: a pulse that has moved less counts as one that has moved this far
PASSED_TIME = 0.1  # [s] default: a short one passes nothing of a slow drive's swing, a long one shifts a loaded rest
MIN_PASSED_TIME = 1e-6  # [s]; below, the loop is too stiff to integrate
PRESSURE_NOMINAL = 1e5  # [Pa] a usual differential pressure, which scales the state
DERIVATIVE_FILTER_TIME = 5e-3  # [s] default: a short one passes an encoder's counts, a long one delays what shall damp
MIN_FILTER_TIME = 1e-4  # [s]; below, the loop is too stiff to integrate, and a difference over a sample is all counts

# Controller

LARGEST_SIGNAL = 1e30
"""A signal beyond it, or that compares with nothing, is no number: larger than any reading, a literal everywhere."""
MAX_BISECTIONS = 120  # halvings of a bracket: fewer than some 60 leave digits of a double, more cost time
MAX_DOUBLINGS = 60  # of a bracket from 1 [command's unit] on: fewer than some 20 miss large commands
MIN_FEEDFORWARD_TIME = 1e-6  # [s]; below, the loop is too stiff to integrate; above, fast leads are refused
POSITION_GAIN = 10.0  # [1/s] default: a small one creeps in, one near the speed loop's own bandwidth swings

# Dither

MAX_AVERAGED_PERIODS = 20  # periods, at most, that make a whole number of samples
MAX_BEAT_AMPLITUDE = 1e-3  # of the amplitude: what averaging may leave of it

# Linear loop

# Norm of a matrix and terms of the series of its exponential, whose remainder is then .5^17/17!, below rounding: a
# larger norm needs more terms, a smaller one more squarings, each of which doubles the rounding.
LARGEST_TAYLOR_NORM, TAYLOR_TERMS = 0.5, 16

# Moves

# Stops of a sequence that its label names; more make a heading that no table has room for.
MAX_LABELLED_STOPS = 4
LABEL_DECIMALS = 9  # of a stop in a label: more show what sums of distances leave of a zero, fewer hide micrometres

# Pid

UNUSED_FILTER_TIME = 0.01  # [s], the filter of a standard form's derivative that is switched off, Td = 0
FAULT_SAMPLES = 5.0  # default: fewer stop a drive for a disturbed telegram, more leave it longer on an old output
LEAST_KI = 1e-20  # [any unit] below it there is no integral action: a Ti of 1e30 s, "infinite" where no such literal is
MOST_EMPTYING = 10.0  # of Tt's default: a Tt that is to switch back-calculation off must not keep a transfer for ever

# Reset integral

RESET_RATIO = 1.0  # default: less brakes an overshoot less, more would make it swing

# Sensor

MIN_SENSOR_LAG = 1e-6  # [s]; below, the loop is too stiff to integrate; above, fast sensors are refused
