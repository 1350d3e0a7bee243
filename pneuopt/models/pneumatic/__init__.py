"""The pneumatic drive and its parts: gas, valve, chambers, cylinder.

Whatever knows air is here. A newcomer adds a flow law in `gas`, a spool in `valve` or a kind of chamber in `chamber`.
"""
