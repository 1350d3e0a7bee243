import json
from pathlib import Path

import pytest

from tests.cli.test_app import run

pytestmark = pytest.mark.usefixtures("folder")


def test_a_spent_budget_is_said_first_and_is_no_success() -> None:
    ended = run("identify drive.toml run_01.csv --budget 0.001 --json ended.json -o fit.toml")
    assert ended.exit_code == 1
    said = json.loads(Path("ended.json").read_text(encoding="utf-8"))["status"]
    assert said["code"] == "the CPU budget is spent"
    assert said["message"].startswith("the CPU budget of 0.001 s is spent: these are the best values so far")
    assert Path("fit.toml").exists()


@pytest.mark.parametrize("words", ["--budget 0", "--budget 5 --select"])
def test_a_budget_that_says_nothing_is_refused(words: str) -> None:
    refused = run(f"identify drive.toml run_01.csv {words}")
    assert refused.exit_code == 2
    assert "budget" in refused.stderr
