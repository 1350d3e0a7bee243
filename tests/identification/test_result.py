import math

import pandas as pd

from pneuopt.identification.result import report_agreement, report_estimates


def test_open_ends_and_what_is_unidentifiable_are_no_numbers() -> None:
    none = math.nan
    rows = {
        "a.open": (2.0, none, 1.5, math.inf, none, none, "widened", ""),
        "b.blind": (7.0, none, -math.inf, math.inf, none, none, "unidentifiable", "unidentifiable"),
        "c.missed": (7.0, none, none, none, 6.0, 9.0, "bias possible", ""),
        "d.pressed": (7.0, none, none, none, none, none, "bias possible", "at its bound"),
    }
    columns = ["value", "stderr", "ci_low", "ci_high", "range_low", "range_high", "mark", "note"]
    table = pd.DataFrame.from_dict(rows, orient="index", columns=columns).assign(unit="N")
    shown = [line.split() for line in report_estimates(table).to_text(80).splitlines()[-4:]]
    assert shown == [
        ["a.open", "2", "above", "1.5", "N", "widened"],
        ["b.blind", "-", "not", "determined", "N", "unidentifiable"],
        ["c.missed", "7", "range", "6.00", "to", "9.00", "N", "bias", "possible"],
        ["d.pressed", "7", "not", "determined", "N", "at", "its", "bound"],
    ]


def test_marks_fit_a_terminal_of_80_columns() -> None:
    row = [0.020014, 2.8e-5, 0.019958, 0.02007, math.nan, math.nan, "bias possible", "", "m/s"]
    columns = ["value", "stderr", "ci_low", "ci_high", "range_low", "range_high", "mark", "note", "unit"]
    table = pd.DataFrame([row], index=["friction.stribeck_velocity"], columns=columns)
    lines = report_estimates(table).to_text(80).splitlines()
    assert max(map(len, lines)) <= 80
    words = ["friction.stribeck_velocity", "0.020014", "0.019958 to 0.020070", "m/s", "bias possible"]
    assert sum(all(word in line for word in words) for line in lines) == 1


def test_many_logs_are_shown_in_short() -> None:
    rows = [
        {
            "log": f"run@{k}",
            "channel": "position",
            "nrmse": 1e-3 * k,
            "free_run_nrmse": 2e-3 * k,
            "rmse": 1e-6,
            "unit": "m",
        }
        for k in range(13)
    ]
    out = report_agreement(pd.DataFrame(rows).set_index(["log", "channel"])).to_text(80)
    assert "median" in out
    assert out.count("@") == 1
    assert [word for word in out.splitlines()[-1].split() if word in {"0.6", "1.2", "2.4"}] == ["0.6", "1.2", "2.4"]
