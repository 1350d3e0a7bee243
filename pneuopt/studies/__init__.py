"""Any function of a `ParameterSet` over named cases, computed in processes, as one table.

`files`, `plotting` and `cli` may import it; `sweep` knows nothing of what the function does. A newcomer adds a way to
choose cases in `sweep`, where to begin reading; a place to compute them needs no code here, because `sweep` takes any
executor of concurrent.futures.
"""
