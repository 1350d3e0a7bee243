"""How a plant without air starts from a log: parameters and states over time, before any simulation.

`System.starts` calls these; a fit begins at the best of them. A newcomer who adds a plant writes how it starts here
(of a pneumatic one in `pneumatic`, where whatever knows air is).
"""
