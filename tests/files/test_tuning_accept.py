"""`accept` of a tuning.toml: the defects with which a design is certified all the same."""

from pathlib import Path

import pytest

from pneuopt.evaluation.certificate import Defect
from pneuopt.files.tuning import read_tuning
from pneuopt.models.linear import SecondOrder
from pneuopt.quantities.errors import InputError

LOOP = '[pid]\nKp = "2 V*s/m"\n[[reference]]\nstep = "0.2 m/s"\nhorizon = "1 s"\n'


def read_accept(folder: Path, line: str) -> tuple[Defect, ...]:
    path = folder / "tuning.toml"
    path.write_text(f"{line}\n{LOOP}", encoding="utf-8")
    return read_tuning(path, SecondOrder().system()).accept


def test_defects_are_accepted_by_their_words(tmp_path: Path) -> None:
    assert read_accept(tmp_path, "") == ()
    every = ", ".join(f'"{defect.value}"' for defect in Defect)
    assert read_accept(tmp_path, f"accept = [{every}]") == tuple(Defect)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ('accept = ["hunt"]', "tuning.toml: accept.*unknown defect 'hunt'; did you mean 'hunts'"),
        ('accept = "hunts"', "write defects in a list before the first section"),
        ("accept = [1]", "write defects in a list"),
        ('acept = ["hunts"]', "unknown section 'acept'.*accept"),
    ],
)
def test_another_word_is_refused_with_the_nearest_one(tmp_path: Path, line: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        read_accept(tmp_path, line)
