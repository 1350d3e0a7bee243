"""The numbers that decide in `control`, each with its unit and what it decides; defaults of parameters stand there."""

SHORTEST_TIME = 1e-6  # [s] of a lag, a filter, a lead: below, a continuous loop is too stiff to integrate

# PID

LEAST_KI = 1e-20  # [any unit] below it there is no integral action: a Ti of 1e30 s, "infinite" where no such literal is
UNUSED_FILTER_TIME = 0.01  # [s] the filter of a standard form's derivative that is switched off, Td = 0
FAULT_SAMPLES = 5.0  # default: fewer stop a drive for a disturbed telegram, more leave it longer on an old output
MOST_EMPTYING = 10.0  # of Tt's default: a Tt that is to switch back-calculation off must not keep a transfer for ever

# Controller

LARGEST_SIGNAL = 1e30  # [any unit] beyond it a signal is no number: larger than any reading, a literal everywhere
MAX_BISECTIONS = 120  # halvings of a bracket: fewer than some 60 leave digits of a double, more cost time
MAX_DOUBLINGS = 60  # of a bracket from 1 [command's unit] on: fewer than some 20 miss large commands

# Compensators

LEAST_DIVISOR = 1e-9  # [any unit] of a smooth sign, a limit, a peak: what is divided by
MIN_FILTER_TIME = 1e-4  # [s] of a derivative: below, a difference over a sample is all counts
STANDSTILL_SHARE = 0.2  # of the tolerance: changes of the error below are a standstill; an encoder's count lies below
PULSE_SHARE = 0.5  # of the error, which a pulse shall take away: more overshoots, less needs more pulses
LEAST_WAY = 0.06  # of the tolerance: a pulse that has moved less counts as one that has moved this far
LEAST_RISE = 1.02  # factor of the peak towards and beyond one that went too far: larger throws, smaller needs pulses
# Exponents of the ratio of the way wanted to that of the last pulse, where the peak rises and where it falls. A force
# that rises and falls at a given rate moves a body over (P - F)^3, F being the breakaway force: a peak of 1.2 F has a
# slope of 18 in logarithms, one of 1.6 F of 8. With larger ones the body is thrown to and fro, with smaller ones the
# peak learns slowly.
RISE_EXPONENT, FALL_EXPONENT = 0.05, 0.15

# Dither and averaging

MAX_AVERAGED_PERIODS = 20  # periods, at most, that make a whole number of samples
MAX_BEAT_AMPLITUDE = 1e-3  # of the amplitude: what averaging may leave of it
RIPPLE_PHASES = 32  # of a period, at least: fewer miss the edge of a dead zone, more cost time in proportion
MAX_NEWTON_STEPS = 40  # of `AveragedPlant`: with fewer, a swing across Stribeck's minimum is left unbalanced
MAX_RIPPLE_STEPS = 50  # of `ripple`: with fewer, a swing that comes slowly is raised from small amplitudes instead
MIN_NEWTON_FRACTION = 1e-3  # of a Newton step: a swing that a smaller one does not improve is kept as it is
NEWTON_TOLERANCE = 1e-9  # last step of `ripple`, of the swing
BALANCE_TOLERANCE = 1e-4  # last step of `AveragedPlant`, of the swing; what is left is its square: 0.01 shows in Ms

# Linear loop

# Norm of a matrix and terms of the series of its exponential, whose remainder is then .5^17/17!, below rounding: a
# larger norm needs more terms, a smaller one more squarings, each of which doubles the rounding.
LARGEST_TAYLOR_NORM, TAYLOR_TERMS = 0.5, 16
LEAST_SAMPLES = 1e-6  # of a dead time, which are none: an angle of 3e-6 rad at the highest frequency
