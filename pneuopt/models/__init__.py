"""Plants and their parts, symbolic in CasADi (SX); they know nothing of any optimisation problem."""
