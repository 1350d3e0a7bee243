"""Systems of equations and their simulation."""
