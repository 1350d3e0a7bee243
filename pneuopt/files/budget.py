"""What a file may ask for: plants, cells of a grid and candidates are bounded before anything is made of them."""

MAX_CASES = 20_000
"""Plants or cells that a file may ask for [1]: more take days and gigabytes; fewer refuse a map of 100 by 100."""
MAX_OPTION = 1_000_000
"""A whole number among a method's options [1]: a thousand times more fill the memory; fewer refuse a long search."""
