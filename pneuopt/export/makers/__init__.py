"""The PID blocks of common controllers, a file a maker: what is typed in, by which formula and source, what is refused.

`export` may import it. A newcomer adds a maker: a file with its `BlockForm`, and a row in `export/vendor_blocks`. Read
`block_form.py` first.
"""
