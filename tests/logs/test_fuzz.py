"""Mutated logs are read right, or refused by an error of our own, whatever they hold."""

import pytest

from tests.logs.fuzz import fuzz


def test_a_few_mutated_logs() -> None:
    fuzz(100, seed=1, styles="plain").check()


@pytest.mark.slow
def test_many_mutated_logs() -> None:
    fuzz(100_000, seed=0).check()
