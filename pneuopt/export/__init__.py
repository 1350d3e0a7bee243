"""A tuned controller in the form that another machine takes: C, structured text, Python, gains of common blocks.

`cli` may import it; it imports `tuning` and what is below, and reads no files. All languages are written from the one
symbolic law that the loop runs (`control.controller`) by one walk over its graph (`writer`). A newcomer adds a language
in `languages`, a maker's PID block in `makers`. Read `program` first.
"""
