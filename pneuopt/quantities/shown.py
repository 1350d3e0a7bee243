"""`Shown`: what prints itself and stands in a notebook; `Result`: what can be saved besides."""

from abc import ABC, abstractmethod
from pathlib import Path

from pneuopt.quantities.report import Report
from pneuopt.quantities.result_file import write_result


class Shown(ABC):
    """What prints, and shows in a notebook, as its report."""

    @abstractmethod
    def summary(self) -> Report:
        """What there is to know, verdict first: print it, or take its `to_text(width)` or `to_html()`."""

    def __repr__(self) -> str:
        return self.summary().to_text()

    def _repr_html_(self) -> str:
        return self.summary().to_html()


class Result(Shown):
    """What a search or a certificate hands out: it prints, and it can be saved."""

    def save(self, path: str | Path) -> None:
        """Write all of it to a file of JSON text, whole or not at all; `load_result` reads it.

        Raises
        ------
        InputError
            If the file cannot be written.
        """
        write_result(path, self)
