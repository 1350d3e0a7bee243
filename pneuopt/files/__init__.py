"""The TOML files of a user: drive.toml, tuning.toml, study.toml, and fit.toml and tuned.toml made from them.

Each file has one module, which reads it with units and places in its messages, and writes it with the user's comments
kept. `cli` may import this room, and so may users' scripts through `pneuopt`. A newcomer adds a section to the module
of its file; a new kind of drive or requirement needs nothing here, because the files read their declarations.
What a key is, is declared once, as a `Key` or a `Parameter`; readers, `init`, schemas and lists of keys are made of it.
"""
