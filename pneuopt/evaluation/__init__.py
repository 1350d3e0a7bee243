"""What a loop is worth, without any optimiser: the certificate of every design.

Responses, metrics, margins, limit cycles, air; requirements, scenarios, the rig, the dither's verdict. It imports
neither `shooting` nor `tuning`, so that a proof shares nothing with the search; `tuning`, `studies` and the rooms above
import it. A newcomer adds a requirement: a class with its `Metric` in `requirements`.
"""
