"""One tree of errors: what the user can mend, and what a solver could not do."""

import pytest

from pneuopt.quantities.errors import (
    ConvergenceError,
    InputError,
    LogError,
    ModelError,
    PneuoptError,
    UnitError,
    UnknownNameError,
    check_names,
    require,
)


@pytest.mark.parametrize("error", [UnitError, UnknownNameError, LogError, ModelError])
def test_all_that_the_user_can_mend_is_an_input_error_and_a_value_error(error: type[Exception]) -> None:
    assert issubclass(error, InputError)
    assert issubclass(error, ValueError)


def test_a_solver_failure_is_no_input_error() -> None:
    assert issubclass(ConvergenceError, PneuoptError)
    assert not issubclass(ConvergenceError, InputError)


def test_convergence_error_carries_the_solution() -> None:
    assert ConvergenceError("stopped", {"x": 1}).solution == {"x": 1}
    assert ConvergenceError("stopped").solution is None


def test_require_raises_what_it_is_told() -> None:
    require(True, "never seen")
    with pytest.raises(LogError, match="too short"):
        require(False, "too short", LogError)


@pytest.mark.parametrize("name", [1, 2.5, ["a"], {"a": 1}, None])
def test_what_is_no_name_at_all_is_refused_as_one(name: object) -> None:
    """As in a file: pressure_dependent = [1]."""
    with pytest.raises(UnknownNameError, match="law"):
        check_names("law", [name], {"a"})  # type: ignore[list-item]
