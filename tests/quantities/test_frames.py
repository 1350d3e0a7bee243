import pickle

import pandas as pd
import pytest

from pneuopt.quantities.frames import WideFrame

NAMES = ["value", "ci_low", "ci_high", "unit", "mark", "stderr", "dof", "bias", "source"]


def estimates() -> WideFrame:
    row = [0.0200024, 0.01999, 0.0200148, "m/s", "bias possible", 6e-6, 801.3, 0.0001, "run_01.csv, by hand"]
    return WideFrame([row, row], index=["friction.stribeck_velocity", "friction.coulomb"], columns=NAMES)


@pytest.mark.parametrize("width", [60, 80])
def test_every_column_is_printed_and_the_interval_beside_its_value(width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    text = repr(estimates())
    assert max(map(len, text.splitlines())) <= width
    assert all(name in text.split() for name in NAMES)
    first = next(line for line in text.splitlines() if "0.0200024" in line)
    assert "0.0200024  0.01999  0.0200148" in first
    assert all(name in estimates()._repr_html_() for name in NAMES)


def test_parts_of_it_print_likewise_and_it_is_a_data_frame() -> None:
    found = estimates()
    assert isinstance(found.assign(note="").loc[["friction.coulomb"]], WideFrame)
    pd.testing.assert_frame_equal(pickle.loads(pickle.dumps(found)), found)
    assert found.to_string().splitlines()[0].split() == NAMES


def test_of_many_rows_the_first_and_the_last_are_printed() -> None:
    text = repr(WideFrame({"case": [f"case {k}" for k in range(100)], "value": range(100)}))
    assert "case 0 " in text
    assert "case 99" in text
    assert "case 50" not in text
    assert repr(WideFrame()) == ""
