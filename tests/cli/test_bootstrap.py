"""`pneuopt identify --bootstrap`: a fit is tried on simulated logs of the drive that truly sticks."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

import pneuopt.cli.identify as identify_module
from pneuopt.identification.identify import identify
from pneuopt.identification.result import IdentificationResult
from pneuopt.studies.bootstrap import Bootstrap
from tests.cli.test_check import folder, run, write
from tests.logs.bad_logs import swing

__all__ = ["folder"]  # the fixture: a drive.toml in a folder of its own
ROW = {"value": 30.0, "unit": "N", "corrected": 28.5, "bias": 1.5, "bias_error": 0.1, "spread": 0.2, "stderr": 0.2}
FOUND = Bootstrap(
    pd.DataFrame({"friction.coulomb": ROW | {"intervals": 3, "covered": 0}}).T.infer_objects(),
    pd.DataFrame({"error": ["", "", ""]}),
)


@pytest.mark.parametrize(("bias", "friction"), [(0.0, "Coulomb"), (1.0, "Karnopp")])
def test_the_table_follows_the_fit_and_a_rig_that_sticks_stands_in_where_the_fit_misses_the_logs(
    bias: float, friction: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: dict[str, Any] = {}

    def keep(*_: object, **options: object) -> Bootstrap:
        given.update(options)
        return FOUND

    def fit(*arguments: Any, **options: Any) -> IdentificationResult:
        result = identify(*arguments, **options)
        return replace(result, estimates=result.estimates.assign(bias=bias))

    monkeypatch.setattr(identify_module, "bootstrap", keep)
    monkeypatch.setattr(identify_module, "identify", fit)
    write(swing().select(["position", "force"]))
    result = run("identify drive.toml run.csv -q --bootstrap 3 --json fit.json")
    assert result.exit_code == 0
    assert given["count"] == 3
    assert type(given["rig"].friction).__name__ == friction
    assert ("truly sticks" in result.stdout) == (bias > 0)
    assert "doubt friction.coulomb" in result.stdout
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
