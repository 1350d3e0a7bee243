"""The pneumatic drive and its parts: gas, valve, chambers, cylinder, and how it starts from a log.

Whatever knows air is here. A newcomer adds a flow law in `gas`, a spool in `valve` or a kind of chamber in `chamber`.
"""
