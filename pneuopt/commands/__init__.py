"""What each command does: read, compute, show, and only then write."""
