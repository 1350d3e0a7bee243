"""Cells and time stamps of text logs."""

import pytest

from pneuopt.logs.text import seconds_from_first


@pytest.mark.parametrize(
    ("cells", "seconds"),
    [
        (["2026-03-12T10:00:00.000000001Z", "2026-03-12T10:00:00.5Z"], [0.0, 0.499999999]),
        (["2026-03-12 10:00:00+01:00", "2026-03-12 09:00:01Z"], [0.0, 1.0]),
        (["28.2.2026 23:59:59", "1.3.2026 00:00:00"], [0.0, 1.0]),
        (["28.02.24 23:59:59", "29.02.24 00:00:00"], [0.0, 1.0]),
        (["02/28/2026 11:59:59 PM", "03/01/2026 12:00:00 AM"], [0.0, 1.0]),
        (["28/02/2026 23:59:59", "01/03/2026 00:00:00"], [0.0, 1.0]),
        (["3/4/2026 23:59:58", "", "3/4/2026 23:59:59,25"], [0.0, float("nan"), 1.25]),
        (["23:59:59", "0:00:01", "0:00:02"], [0.0, 2.0, 3.0]),
        (["10:00:00:250", "10:00:01:125"], [0.0, 0.875]),
    ],
)
def test_stamps_count_from_the_first(cells: list[str], seconds: list[float]) -> None:
    assert seconds_from_first(cells, "run.csv", "time", 2) == pytest.approx(seconds, abs=1e-15, nan_ok=True)
