"""Multiple shooting: a fit or an optimal control problem as segments joined by equations.

Transcription, structured least squares with its convergence test, and the full space for IPOPT; only here is anything
CasADi MX. `identification` and `tuning` may import it, `evaluation` never. A newcomer adds a method that solves a
`Transcription`. Read `transcription` first, then `run_stages` in `least_squares`: its search is a frozen `SearchState`,
which moves return anew and small policies (`choose_shortcut`, `choose_repeat`, ...) read to say what comes next.
"""
