"""`METHODS`: the methods of `tune`, where a new one is registered; `choose_method` takes the first that suits."""

from collections.abc import Mapping
from types import MappingProxyType

from pneuopt.tuning.method import Method, TuningTask
from pneuopt.tuning.racing import Racing
from pneuopt.tuning.two_phase import TwoPhase

# By their key in a tuning's file; the first that suits a task is chosen: `Racing` suits every task.
METHODS: Mapping[str, type[TwoPhase] | type[Racing]] = MappingProxyType({"two_phase": TwoPhase, "racing": Racing})


def choose_method(task: TuningTask) -> Method:
    """Choose the first method in `METHODS` that suits a task."""
    return next(method for method in (kind() for kind in METHODS.values()) if method.suits(task))
