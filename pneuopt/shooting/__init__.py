"""Multiple shooting: a fit or an optimal control problem as segments joined by equations.

Only here is anything CasADi MX. `identification` and `tuning` may import it, `evaluation` never. A newcomer adds a
method that solves a `Transcription`. Read `transcription` first, then the head of `least_squares`.
"""
