"""`study_executors.py`: tables are compared bit for bit, and one study in two places gives one table."""

import pandas as pd
import pytest

from problems.speed.study_executors import count_differences, main


def test_a_difference_in_the_last_bit_counts_and_the_time_does_not() -> None:
    one = pd.DataFrame(
        {"case": ["a", "b"], "Overshoot": [1.0, float("nan")], "seconds": [1.0, 2.0], "error": ["", "x"]}
    )
    assert count_differences(one, one.assign(seconds=[3.0, 4.0])) == 0
    assert count_differences(one, one.assign(Overshoot=[1.0 + 2.3e-16, float("nan")])) == 1
    assert count_differences(one, one.assign(error=["", "y"])) == 1
    assert count_differences(one, one[:1]) == 6


@pytest.mark.slow
def test_two_processes_give_the_table_of_one_thread() -> None:
    rows = main(4, ("serial", "processes")).set_index("name")["value"]
    assert rows["failed"] == rows["processes.differ"] == 0
