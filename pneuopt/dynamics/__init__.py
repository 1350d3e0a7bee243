"""Systems of equations with named signals, and their simulation.

A `System` is an ODE or a sampled model in CasADi's SX; `simulate` integrates it tightly, smooth or with stick-slip;
`compiled` runs many segments at once by machine code. The rooms above may import this one; it imports only `quantities`
and knows no plant. A newcomer rarely adds here: a plant declares its events, and `stick_slip` finds them.
"""
