"""Numbers with names and units, over time."""
