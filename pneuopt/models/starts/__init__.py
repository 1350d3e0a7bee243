"""How each plant starts from a log."""
