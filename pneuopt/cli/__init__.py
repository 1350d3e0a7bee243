"""The command line: `app` declares the commands, one module each carries them out, `show_*` prints the results.

Nothing imports this room. A newcomer adds a command as a function in `app` and a module with a ``run_*`` that returns
an exit status of `exit_status`; files are written by `shared.finish`, once everything is computed.
"""
