"""`pneuopt identify --bootstrap`: a fit is tried on simulated logs of the drive that truly sticks."""

import json
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

import pneuopt.cli.identify as identify_module
from pneuopt.studies.bootstrap import Bootstrap
from tests.cli.test_check import folder, run, write
from tests.logs.bad_logs import swing

__all__ = ["folder"]  # the fixture: a drive.toml in a folder of its own
ROW = {"value": 30.0, "unit": "N", "corrected": 28.5, "bias": 1.5, "bias_error": 0.1, "spread": 0.2, "stderr": 0.2}
FOUND = Bootstrap(
    pd.DataFrame({"friction.coulomb": ROW | {"intervals": 3, "covered": 0}}).T.infer_objects(),
    pd.DataFrame({"error": ["", "", ""]}),
)


def test_the_table_follows_the_fit_on_the_screen_and_in_json(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given: dict[str, Any] = {}

    def keep(*_: object, **options: object) -> Bootstrap:
        given.update(options)
        return FOUND

    monkeypatch.setattr(identify_module, "bootstrap", keep)
    write(swing().select(["position", "force"]))
    result = run("identify drive.toml run.csv -q --bootstrap 3 --json fit.json")
    assert result.exit_code == 0
    assert given["count"] == 3
    assert "Karnopp" in repr(given["rig"].friction)
    assert "distrust friction.coulomb" in result.stdout
    assert "5 % too high, and 0 of 3 intervals hold its value" in " ".join(result.stdout.split())
    assert json.loads((folder / "fit.json").read_text("utf-8"))["bootstrap"][0]["bias"] == 1.5


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("--bootstrap 1", "--bootstrap 1: a spread takes two sets of logs at least"),
        ("--bootstrap 20 --select", "--bootstrap tries one model's fit: leave it out with --select"),
    ],
)
def test_what_makes_no_bootstrap_is_refused(options: str, said: str, folder: Path) -> None:
    write(swing().select(["position", "force"]))
    result = run(f"identify drive.toml run.csv -q {options}")
    assert (result.exit_code, said in result.stderr) == (2, True)
