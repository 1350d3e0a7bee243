"""Any function of a `ParameterSet` over named cases, computed in processes, as one table.

It knows nothing of what the function does. `files`, `plotting` and `cli` may import it; it imports only `quantities`.
A newcomer adds a way to choose cases in `cases.py`; a place to compute them needs no code here, because `sweep`
takes any executor of concurrent.futures.
"""
