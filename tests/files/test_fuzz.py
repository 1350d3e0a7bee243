"""Mutated TOML files are read, or refused by an error of our own in one line, whatever they hold."""

import pytest

from tests.files.fuzz import Report, fuzz


def check(report: Report) -> None:
    assert [failure[:2] for failure in report.failures] == [], report.failures[0]
    assert report.accepted.total() > 0.25 * report.cases.total()


def test_a_few_mutated_files() -> None:
    check(fuzz(40, seed=1, kinds=("force",)))


@pytest.mark.slow
def test_many_mutated_files() -> None:
    check(fuzz(20_000, seed=0))
