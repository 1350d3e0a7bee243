"""Mutated TOML files are read, or refused by an error of our own in one line, whatever they hold."""

import pytest

from tests.files.fuzz import fuzz


def test_a_few_mutated_files() -> None:
    fuzz(40, seed=1, kinds=("force",)).check()


@pytest.mark.slow
def test_many_mutated_files() -> None:
    fuzz(20_000, seed=0).check()
