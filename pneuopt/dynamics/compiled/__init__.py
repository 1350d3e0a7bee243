"""The same equations as cached machine code, a segment in each SIMD lane; CasADi's VM where there is no compiler.

`dynamics`, `shooting`, `evaluation` and `tuning` use it through `rollout`. A newcomer adds an operation of CasADi that
has no C yet, in `c_writer` and ``lanes.h``. CONTRIBUTING.md draws how arrays, lanes and sensitivities lie in memory.
"""
