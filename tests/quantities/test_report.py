"""Reports: no word and no number is broken, nothing is wider than asked for, and HTML says the same."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneuopt.quantities.report import Column, Line, Report, Table, Tone, number_columns, text_columns

WORD = st.text("abcdefgh._+-0123456789", min_size=1, max_size=24)
CELL = st.lists(WORD, max_size=3).map(" ".join)


@st.composite
def tables(draw: st.DrawFn) -> Table:
    count = draw(st.integers(1, 8))
    columns = tuple(Column(draw(CELL), is_text=draw(st.booleans())) for _ in range(count))
    return Table(columns, tuple(tuple(draw(CELL) for _ in range(count)) for _ in range(draw(st.integers(0, 4)))))


@given(table=tables(), width=st.integers(50, 100))
def test_a_table_has_each_word_whole_and_keeps_the_width(table: Table, width: int) -> None:
    """At 50 columns two words of 24 letters stand beside each other, so nothing need be wider."""
    lines = Report((table,)).to_text(width).splitlines()
    assert max(map(len, lines), default=0) <= width
    wanted = [word for row in table.rows for cell in row for word in cell.split()]
    shown = [word for line in lines for word in line.split() if set(word) != {"─"}]
    assert set(wanted) <= set(shown)
    assert len(shown) >= len(wanted)


@given(words=st.lists(WORD, min_size=1, max_size=40), width=st.integers(30, 100), indent=st.integers(0, 4))
def test_a_sentence_ends_its_lines_between_words(words: list[str], width: int, indent: int) -> None:
    lines = Report((Line(" ".join(words), indent=indent),)).to_text(width).splitlines()
    assert max(map(len, lines)) <= width
    assert [word for line in lines for word in line.split()] == words
    assert all(line.startswith(" " * (indent + 2)) for line in lines[1:])


def test_a_narrow_table_breaks_cells_then_stands_below_its_names_then_goes_on_below() -> None:
    columns = (*text_columns("parameter"), *number_columns("value", "interval"), *text_columns("mark"))
    row = ("friction.stribeck_velocity", "0.0200024", "0.0199900\u00a0to 0.0200148", "bias possible")
    report = Report((Table(columns, (row,)),))
    assert [line.split() for line in report.to_text(80).splitlines()[3:]] == [
        ["friction.stribeck_velocity", "0.0200024", "0.0199900", "to", "0.0200148", "bias", "possible"]
    ]
    assert [line.split() for line in report.to_text(75).splitlines()[3:]] == [
        ["friction.stribeck_velocity", "0.0200024", "0.0199900", "to", "bias", "possible"],
        ["0.0200148"],
    ]
    assert [line.split() for line in report.to_text(58).splitlines()[4:]] == [
        ["friction.stribeck_velocity"],
        ["0.0200024", "0.0199900", "to", "0.0200148", "bias", "possible"],
    ]
    lines = report.to_text(30).splitlines()
    assert sum(line.startswith("friction.stribeck_velocity") for line in lines) == 3, "one panel a column"


def test_html_holds_the_same_words_and_escapes_them() -> None:
    table = Table((*text_columns("metric"), *number_columns("limit")), (("Overshoot", "<= 5"),))
    page = Report((Line("converged & certified", Tone.GOOD), table))._repr_html_()
    assert "<= 5" not in page
    assert "&lt;= 5" in page
    assert "converged &amp; certified" in page
    assert re.search(r'<td style="text-align:right">&lt;= 5</td>', page)
    assert page.count("<tr>") == 2


@pytest.mark.parametrize(("columns", "width"), [("60", 60), ("200", 200)])
def test_the_terminal_says_how_wide_a_report_is(columns: str, width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    lines = str(Report((Line("word " * 100),))).splitlines()
    assert width - 5 < max(map(len, lines)) <= width
