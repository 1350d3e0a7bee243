"""Commands, and what the screen shows."""
