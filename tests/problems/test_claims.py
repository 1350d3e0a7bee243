import json
from pathlib import Path

import pytest
from matplotlib.figure import Figure
from PIL import Image

from problems.shared.claims import Claim, arguments, finish, frame, table, unbounded_patterns

GOOD = Claim("design.settling", 0.203, "s", 0.503, "<= 0.21")
SHOWN = Claim("design.Kp", 0.3972, "V/V")
BAD = Claim("design.overshoot", float("nan"), "%", None, "<= 0.02")


def test_rows_print_within_80_columns() -> None:
    text = table(
        frame([GOOD, SHOWN, BAD, Claim("gain_from_table1.worst_residual", -1.2345e-6, "rad/s", 2e-6, "6.3 +- 0.1")])
    )
    assert max(map(len, text.splitlines())) <= 80
    assert "1 of 3 claims hold; 1 figures shown only" in text
    assert [line.split()[-1] for line in text.splitlines()[1:4:2]] == ["ok", "FAIL"]


def test_nan_keeps_no_bound_and_the_exit_status_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = arguments("").parse_args(["--json", str(tmp_path / "deep" / "rows.json")])
    assert finish(frame([GOOD, SHOWN]), options) == 0
    assert finish(frame([GOOD, BAD]), options) == 1
    written = json.loads((tmp_path / "deep" / "rows.json").read_text())
    assert list(written[0]) == ["name", "value", "unit", "reference", "bound", "holds"]
    assert (written[0]["holds"], written[1]["value"], written[1]["holds"]) == (True, None, False)
    assert "FAIL" in capsys.readouterr().out
    assert [f.name for f in (tmp_path / "deep").iterdir()] == ["rows.json"]


def test_what_the_text_claims_of_rows_has_a_bound(capsys: pytest.CaptureFixture[str]) -> None:
    text = "Rows design.*: settled. Rows map.*: what it costs. Rows *.Kp: shown. Rows later.*: of another run."
    rows = frame([GOOD, Claim("map.air", 2.0, "l"), Claim("map.best", 1.0, "s"), SHOWN])
    assert unbounded_patterns(text, rows) == ["map.*", "*.Kp"]
    assert finish(rows, arguments(text).parse_args([])) == 1
    assert "claimed in the text without a bound: map.*, *.Kp" in capsys.readouterr().out
    assert finish(rows, arguments("Rows design.*: settled.").parse_args([])) == 0


def test_figures_are_made_only_when_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def figures() -> dict[str, Figure]:
        return {"empty": Figure()}

    assert finish(frame([GOOD]), arguments("").parse_args([]), figures) == 0
    assert finish(frame([GOOD]), arguments("").parse_args(["--out", str(tmp_path)]), figures) == 0
    assert (tmp_path / "empty.png").stat().st_size > 0
    assert "empty.png" in capsys.readouterr().out
    with Image.open(tmp_path / "empty.png") as image:
        assert image.info["Description"].startswith("python ")
        assert image.info["Description"].endswith(" --out out")
