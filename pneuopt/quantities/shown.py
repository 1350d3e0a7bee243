"""`Shown`: what every result can do, print itself, stand in a notebook, and be saved."""

from abc import ABC, abstractmethod
from pathlib import Path

from pneuopt.quantities.report import Report
from pneuopt.quantities.result_file import write_result


class Shown(ABC):
    """A result that prints, and shows in a notebook, as its report, and that can be saved."""

    @abstractmethod
    def summary(self) -> Report:
        """What there is to know, verdict first: print it, or take its `to_text(width)` or `to_html()`."""

    def save(self, path: str | Path) -> None:
        """Write all of it to a file of JSON text, whole or not at all; `load_result` reads it.

        Raises
        ------
        InputError
            If the file cannot be written.
        """
        write_result(path, self)

    def __repr__(self) -> str:
        return self.summary().to_text()

    def _repr_html_(self) -> str:
        return self.summary().to_html()
