"""Numbers with names and units, over time: parameters, trajectories, units, status, errors, and files written whole.

Every room imports this one; it imports none of them, and neither CasADi nor, outside `units`, pint. A newcomer adds
what several rooms need and no field owns: a unit that users write, an error that they can mend.
"""
