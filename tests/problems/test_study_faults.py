"""`study_faults.py`: the faulty cases are the ones that are meant; all its claims hold."""

import math

import pytest

import pneuopt as po
from problems.speed.study_faults import certify_with_faults, main

RIG = po.ParameterSet({"mass": po.Parameter(5.0, "kg")})


def test_only_the_plant_that_is_meant_is_at_fault() -> None:
    faults = {"nan": {"mass": 5.0}}
    assert math.isnan(certify_with_faults(faults, lambda _: 1.0, RIG))
    assert certify_with_faults(faults, lambda _: 1.0, RIG.with_values({"mass": 4.0})) == 1.0


@pytest.mark.slow
def test_nothing_is_lost_and_each_fault_is_said() -> None:
    assert main()["holds"].dropna().all()
