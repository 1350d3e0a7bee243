"""A page of its own parts: order, escape, figures that fail, whole or not at all.

How a design gets to a controller: a page offers the forms that can hold it, and no other.
"""

from contextlib import nullcontext
from functools import partial
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from pneuopt.control.compensators import DeadZoneInverse
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.export.blocks import describe_refusal, export_settings
from pneuopt.export.makers import Block
from pneuopt.models.linear import FirstOrder
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.report import Line, Report, Table, Tone, number_columns, text_columns
from pneuopt.report.page import EXPORTS, Page, Picture, Section, render_page, report_exports, write_page
from tests.report.reading import HOSTILE, read_page


def figure(title: str = "a title") -> Figure:
    made = Figure()
    axes = made.subplots()
    axes.plot(range(3), label="three")
    axes.set_title(title)
    return made


def page(name: str = "drive") -> Page:
    columns = (*text_columns(f"name\n{name}"), *number_columns("value"))
    table = Report((Line(name, Tone.DOUBTFUL, 2), Table(columns, ((name, "5"),))))
    picture = Picture(lambda: figure(name), f"three points of {name}", f"Points of {name}")
    verdict = Report((Line(f"converged: {name}", Tone.GOOD), Line("details", indent=2)))
    return Page(f"Fit of {name}", verdict, (Section(name, (table, picture)), Section("empty", ())), (name,))


def test_the_verdict_stands_first_then_warnings_then_sections() -> None:
    read = read_page(render_page(page()))
    assert [w for tag, w in read.words if tag == "h1"] == ["Fit of drive"]
    assert (
        read.words.index(("p", "converged: drive"))
        < read.words.index(("li", "drive"))
        < read.words.index(("h2", "drive"))
    )
    assert [w for tag, w in read.words if tag == "h2"] == ["drive"], "an empty section is left out"
    assert ("figcaption", "Figure 1. Points of drive") in read.words
    assert read.named("svg")[0]["aria-label"] == "three points of drive"


def test_the_worst_verdict_colours_the_box() -> None:
    lines = (Line("converged", Tone.GOOD), Line("holds on 3 of 100 plants", Tone.DOUBTFUL), Line("why"))
    read = read_page(render_page(Page("Tuning", Report(lines), ())))
    assert read.named("div")[0]["class"] == "verdict doubtful"


def test_hostile_names_are_text_everywhere() -> None:
    text = render_page(page(HOSTILE))
    read = read_page(text)
    assert "<script>" not in text
    said = HOSTILE.replace("\x07", "\ufffd")
    assert read.text.count("{{ 7*7 }}") >= 7, "title, heading, verdict, warning, table, caption and figure"
    assert said in (read.named("svg")[0]["aria-label"] or "")
    assert any(tag == "text" and "onerror" in words for tag, words in read.words), "the figure's title"


def test_a_formula_becomes_paths_and_a_broken_one_stays_text() -> None:
    good, broken = (Picture(partial(figure, t), "a figure with a formula", "It.") for t in ("$K_p$", "$\\frac$"))
    read = read_page(render_page(Page("p", Report(), (Section("s", (good,)),))))
    assert not read.named("text")
    read = read_page(render_page(Page("p", Report(), (Section("s", (broken,)),))))
    assert ("text", "$\\frac$") in read.words


def test_a_figure_that_cannot_be_drawn_says_why() -> None:
    def refuse() -> Figure:
        raise InputError("the runs have nothing in common")

    read = read_page(render_page(Page("p", Report(), (Section("s", (Picture(refuse, "nothing", "Residuals"),)),))))
    assert "Residuals is not drawn: the runs have nothing in common" in read.text
    assert not read.named("svg")


def test_the_same_page_is_the_same_to_the_letter() -> None:
    assert render_page(page()) == render_page(page())


def test_a_figure_lets_the_shadow_through_that_shows_a_phone_where_it_goes_on() -> None:
    drawn = read_page(render_page(page())).named("path")[0]
    assert drawn["style"] == "fill: none", "the sheet behind the axes"


def test_a_page_without_figures() -> None:
    read = read_page(render_page(page(), draws=False))
    assert not read.named("figure")
    assert "converged: drive" in read.text


def test_a_name_of_bytes_that_are_no_letters_is_written(tmp_path: Path) -> None:
    write_page(tmp_path / "a.html", page("run_\udcff"))
    assert "run_\ufffd" in read_page(tmp_path / "a.html").text


def test_what_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    def fail() -> Figure:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        write_page(tmp_path / "a.html", Page("p", Report(), (Section("s", (Picture(fail, "a", "b"),)),)))
    with pytest.raises(InputError, match="the folder does not exist"):
        write_page(tmp_path / "none" / "a.html", page())
    assert list(tmp_path.iterdir()) == []


def test_a_cloud_is_an_image_and_a_page_stays_small() -> None:
    def cloud() -> Figure:
        made = Figure()
        made.subplots().plot(range(20_000), ".")
        return made

    text = render_page(Page("p", Report(), (Section("s", (Picture(cloud, "a cloud of many points", "b"),)),)))
    assert read_page(text).named("image")
    assert len(text) < 100_000


PLAIN = ClosedLoop(FirstOrder().system(), PID(sample_time=0.01))
BENT = ClosedLoop(FirstOrder().system(), PID(sample_time=0.01), compensators=(DeadZoneInverse(),))
LIMITED = {"pid.lower": -5.0, "pid.upper": 5.0}


@pytest.mark.parametrize("loop", [PLAIN, BENT])
@pytest.mark.parametrize("values", [LIMITED, {}])
def test_a_page_offers_the_exports_that_are_not_refused(loop: ClosedLoop, values: dict[str, float]) -> None:
    given = loop.parameters.with_values(values | ({"dead_zone_inverse.width": 0.1} if loop is BENT else {}))
    report = report_exports(loop.controller, given, [Step(1.0)], 0.0, Path("fit.toml"), Path("tuned.toml"))
    shown = " ".join(report.to_text().split())
    told = {block: describe_refusal(loop.controller, given, block, Step(1.0)) for block in Block}
    for block, reason in told.items():
        with pytest.raises(InputError) if reason else nullcontext(InputError("")) as refusal:
            export_settings(loop, given, block, Step(1.0))
        assert reason == str(refusal.value if isinstance(refusal, pytest.ExceptionInfo) else refusal)
    refused = {block.value for block, reason in told.items() if reason}
    assert bool(refused) == (loop is BENT or not values)
    assert [form for form in EXPORTS if f"--to {form}" in shown] == [form for form in EXPORTS if form not in refused]
