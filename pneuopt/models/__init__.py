"""Plants and their parts, symbolic in CasADi (SX); they know nothing of any optimisation problem.

Friction laws, loads, drives, transfer functions, sensors, cited numbers, and how each plant starts from a log. `files`,
`plotting`, `studies` and `cli` may import it; identification, tuning, shooting, evaluation and dynamics never do: they
read what a plant declares. A newcomer adds a friction law, with its row in `friction_laws`, or a plant (`drive_kinds`);
`drives` is the file to begin with.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, submodules=["catalog"])
