"""Commands under signals at random times lose nothing."""

import os

import pytest

from tests.cli.interruptions import interrupt_commands


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="signals are POSIX")
def test_commands_that_are_interrupted_at_random_times_lose_nothing() -> None:
    found = interrupt_commands(5, seed=0)
    assert {name: tally.faults for name, tally in found if tally.faults} == {}
