"""`CaseRows`: the table of a study while it grows, column by column: a hundred thousand cases take a few megabytes."""

from array import array
from collections.abc import Iterable, Mapping
from math import nan
from typing import Any

from pneuopt.quantities.parameters import ParameterSet
from pneuopt.studies.outcome import INTERRUPTED_CASE, CaseValues, Outcome

_STUDY_COLUMNS = ("case", "seconds", "error")


class CaseRows:
    """A row a case, in their order; one without an outcome counts as interrupted.

    Parameters
    ----------
    parameters : ParameterSet
        What the cases have in common.
    cases : mapping of str to mapping of str to float, or to ParameterSet

    Attributes
    ----------
    count, done, failed : int
        Cases, those with an outcome, and those of these that have an error.
    """

    def __init__(self, parameters: ParameterSet, cases: Mapping[str, CaseValues]) -> None:
        self._parameters, self._cases = parameters, cases
        self.count, self.done, self.failed = len(cases), 0, 0
        self._places = {str(name): place for place, name in enumerate(cases)}
        self._swept = _swept_names(parameters, cases.values())
        self._taken = {*_STUDY_COLUMNS, *self._swept}
        self._results: dict[str, list[Any]] = {}
        self._seconds = array("d", [nan]) * len(cases)
        self._errors = [INTERRUPTED_CASE] * len(cases)

    def add(self, name: str, outcome: Outcome) -> None:
        """Put what a case gave into its row."""
        place, outcome = self._places[name], _check_column_names(outcome, self._taken)
        self._seconds[place], self._errors[place] = outcome.seconds, outcome.error
        for n, value in outcome.results.items():
            if n not in self._results:
                self._results[n] = [nan] * len(self._cases)
            self._results[n][place] = value
        self.done += 1
        self.failed += bool(outcome.error)

    def is_missing(self, name: str) -> bool:
        """Whether a case has no outcome yet."""
        return self._errors[self._places[name]] == INTERRUPTED_CASE

    def row(self, name: str) -> dict[str, Any]:
        """The row of a case that has an outcome, without the results that it lacks."""
        place, case = self._places[name], self._cases[name]
        row: dict[str, Any] = {"case": name} | {n: _value_of(n, case, self._parameters) for n in self._swept}
        row |= {n: column[place] for n, column in self._results.items() if not self._errors[place]}
        return row | {"seconds": self._seconds[place], "error": self._errors[place]}

    def columns(self) -> dict[str, list[Any]]:
        """The table's columns."""
        columns: dict[str, list[Any]] = {"case": list(self._places)}
        columns |= {n: [_value_of(n, case, self._parameters) for case in self._cases.values()] for n in self._swept}
        return columns | self._results | {"seconds": list(self._seconds), "error": self._errors}


def _swept_names(parameters: ParameterSet, cases: Iterable[CaseValues]) -> list[str]:
    """The parameters in which the cases differ from what they have in common."""
    nominal = {n: p.value for n, p in parameters.items()}
    found: dict[str, None] = {}
    for case in cases:
        values = {n: p.value for n, p in case.items()} if isinstance(case, ParameterSet) else case
        found |= dict.fromkeys(n for n, v in values.items() if n not in found and nominal.get(n) != v)
    return list(found)


def _value_of(name: str, case: CaseValues, parameters: ParameterSet) -> float:
    if isinstance(case, ParameterSet):
        return case.value(name) if name in case else nan
    return float(case[name]) if name in case else parameters.value(name) if name in parameters else nan


def _check_column_names(outcome: Outcome, taken: set[str]) -> Outcome:
    twice = taken.intersection(outcome.results)
    if not twice:
        return outcome
    said = f"{', '.join(sorted(twice))}: a result has the name of a column of the study; rename it"
    return Outcome(seconds=outcome.seconds, error=said)
