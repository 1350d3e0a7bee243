"""Mutated logs are read right, or refused by an error of our own, whatever they hold."""

import pytest

from tests.logs.fuzz import Report, fuzz


def check(report: Report) -> None:
    assert [failure[:2] for failure in report.failures] == [], report.failures[0]
    assert report.accepted.total() > 0.25 * report.cases.total()


def test_a_few_mutated_logs() -> None:
    check(fuzz(100, seed=1, styles="plain"))


@pytest.mark.slow
def test_many_mutated_logs() -> None:
    check(fuzz(100_000, seed=0))
