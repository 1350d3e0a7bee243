"""Cases of a tuning: every reference on every plant that the design must suit, the nominal plant first."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Reference
from pneuopt.evaluation.scenarios import Factor, Scenarios, apply_scenario
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ConvergenceError, HardwareError, InputError, check_names, require
from pneuopt.quantities.parameters import ParameterSet


@dataclass(frozen=True, eq=False)
class TuningCase:
    """One reference on one plant.

    Parameters
    ----------
    reference : Reference
    scenario : str
        Its name; empty for the nominal plant.
    values : mapping of str to float or Factor
        The parameter values that differ from the nominal plant.
    """

    reference: Reference
    scenario: str = ""
    values: Mapping[str, float | Factor] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """Heading of its column in a table: "0 to 0.2 [load.mass high]"."""
        return f"{self.reference.label} [{self.scenario}]" if self.scenario else self.reference.label

    def case_parameters(self, parameters: ParameterSet) -> ParameterSet:
        """Parameters of this case: its plant and gains."""
        return apply_scenario(parameters, self.values)

    def case_vectors(self, p: Array, order: Sequence[str]) -> Array:
        """Copy of parameter vectors, shape (m, n_parameters), with this case's values in place."""
        out = p.copy()
        for n, value in self.values.items():
            k = order.index(n)
            out[:, k] = p[:, k] * value.share if isinstance(value, Factor) else value
        return out

    def slopes(self, names: Sequence[str]) -> Array:
        """Derivatives of this case's parameters to the candidate's, shape (n,); 0 where the scenario fixes a value."""
        values = (self.values.get(n, Factor(1.0)) for n in names)
        return np.array([v.share if isinstance(v, Factor) else 0.0 for v in values])

    def initial(self, loop: ClosedLoop, parameters: ParameterSet) -> Array:
        """State in which the loop waits for the step.

        Raises
        ------
        InputError, ConvergenceError
            As from `ClosedLoop.initial`; the message names the scenario.
        """
        values, step = self.case_parameters(parameters), self.reference
        try:
            return loop.initial(values, reference=step.origin, start=step.start)
        except ConvergenceError as error:
            raise ConvergenceError(f"{self._message_prefix}{error}", error.solution) from None
        except HardwareError as error:
            raise HardwareError(f"{self._message_prefix}{error}", error.parameter, error.remedy) from None
        except InputError as error:
            raise InputError(f"{self._message_prefix}{error}") from None

    @property
    def _message_prefix(self) -> str:
        return f"scenario {self.scenario!r}: " if self.scenario else ""


def cases(
    references: Sequence[Reference], scenarios: Scenarios, parameters: ParameterSet, tuned: Collection[str] = ()
) -> tuple[TuningCase, ...]:
    """Cases of every reference on the nominal plant, then on each scenario's plant.

    Parameters
    ----------
    references : sequence of Reference
    scenarios : mapping of str to mapping
    parameters : ParameterSet
        The parameters that a scenario may change.
    tuned : collection of str
        Names of tuned parameters, which a scenario may change by a `Factor` only.

    Raises
    ------
    InputError
        If two references have one label, or a scenario names an unknown parameter, or gives a tuned one a value.
    """
    labels = [r.label for r in references]
    twice = next((n for n in labels if labels.count(n) > 1), "")
    require(not twice, f"two references are {twice!r}, and tables name them by that label; leave one out")
    for name, values in scenarios.items():
        require(bool(name), "a scenario needs a name: {'heavy load': {'load.mass': 8.0}}")
        _check_scenario(name, values, parameters, tuned)
    nominal = [TuningCase(r) for r in references]
    return (*nominal, *(TuningCase(r, name, values) for name, values in scenarios.items() for r in references))


def _check_scenario(
    name: str, values: Mapping[str, float | Factor], parameters: ParameterSet, tuned: Collection[str]
) -> None:
    check_names("parameter", values, parameters, f"scenario {name!r}")
    for n, value in values.items():
        require(
            isinstance(value, Factor) or n not in tuned,
            f"scenario {name!r}: {n} is tuned, so no scenario can fix its value; for a tolerance around it write "
            f"tolerances(parameters, {{{n!r}: 0.01}})",
        )
