"""What the command line shows: tables that are read at 80 columns or piped, and progress on a terminal only."""
