"""How `tune` searches: the exact two-phase problem for linear loops, compiled screening for the others."""
