"""The worth of a loop, without any optimiser: simulated responses, metrics, margins, limit cycles, air and energy.

Read `certificate.py` first: it says what holds of a design, and what is shared with the search that found it: the model
and the metrics' definitions, and no step of the search. So this room imports neither shooting nor tuning, and no
models; identification, tuning, studies and what is above them may import it. A newcomer adds a requirement: a class
with its `Metric` in `requirements.py`, and a row of `REQUIREMENT_KINDS` there, which files, tables and searches read.
"""
