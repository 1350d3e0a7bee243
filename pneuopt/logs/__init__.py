"""What was measured.

An `Experiment` is a log in SI units with its noise and conditions. A reader (`readers`, one a file format) returns a
`Table` of named columns; `columns` says what they mean, for all formats; `doctor` looks a log over before any fit. All
rooms above may import this one; it imports only `quantities`. A newcomer adds a file format: a file with a
``read_table(path, raw) -> Table``, a row in `readers.READERS`, and a writer in ``tests/logs/test_foreign.py``.
"""
