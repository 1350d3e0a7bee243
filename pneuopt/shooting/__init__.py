"""Multiple shooting: a fit or an optimal control problem as segments joined by equations.

Transcription, structured least squares with its convergence test, and the full space for IPOPT; only here is anything
CasADi MX. `identification` and `tuning` may import it, `evaluation` never. A newcomer adds a method that solves a
`Transcription`. Read `transcription` first, then the head of `least_squares`, a page on the search with its stages and
ends.
"""
