"""What was measured.

An `Experiment` is a log in SI units with its noise and conditions. A reader (`foreign.READERS`, one a file format)
returns a `LogTable` of named columns; `columns` says what they mean, for all formats; `doctor` looks a log over before
any fit. All rooms above may import this one; it imports only `quantities`. A newcomer adds a file format: a function
``read_x(path, raw) -> LogTable`` and its row in `foreign`, and a writer in ``tests/logs/test_foreign.py``. Read `table`
first.
"""
