"""What a loop is worth, without any optimiser."""
