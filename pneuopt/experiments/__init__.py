"""Which run to log next: candidate runs, what each would tell of the parameters, and the plan that tells most.

It reads fits and models of `identification`, and the moves of `control`; `studies` and what is above it may import it.
A newcomer adds a criterion (`design.py`) or a waveform (`search.py`); the file to read first is `next_experiment.py`.
"""
