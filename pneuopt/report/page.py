"""`Page`: what a page holds, and how it becomes HTML. The template beside this file says how it looks."""

import base64
import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pneuopt.plotting import replace_unprintable, to_svg
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.output import write_text
from pneuopt.quantities.report import Line, Report, Table, Tone

if TYPE_CHECKING:
    from pneuopt.plotting.canvas import Figure

_SEVERITY = [tone.value for tone in (Tone.PLAIN, Tone.HEADING, Tone.GOOD, Tone.DOUBTFUL, Tone.BAD)]


@dataclass(frozen=True)
class Picture:
    """A figure of a page.

    Attributes
    ----------
    draw : callable
        Makes the figure; one that raises `InputError` leaves its reason in the figure's place.
    alt : str
        What it shows, for those who do not see it.
    caption : str
        What stands below it.
    """

    draw: Callable[[], "Figure"]
    alt: str
    caption: str


@dataclass(frozen=True)
class Section:
    """A part of a page under a heading; it is left out where it holds nothing.

    Attributes
    ----------
    title : str
    parts : tuple of Report or Picture
    """

    title: str
    parts: tuple[Report | Picture, ...]


@dataclass(frozen=True)
class Page:
    """A result for a reader who has nothing but this page.

    Attributes
    ----------
    title : str
        What was done with what: "Identification of drive.toml".
    verdict : Report
        What stands first: how it ended, in colour, with details and remedies.
    sections : tuple of Section
    warnings : tuple of str
        What to know before any figure is believed; stands below the verdict.
    script : callable, optional
        Makes what moves the page's last part, `live_script`; no other script runs in the page.
    """

    title: str
    verdict: Report
    sections: tuple[Section, ...]
    warnings: tuple[str, ...] = ()
    script: Callable[[], str] | None = None


def write_page(path: str | Path, page: Page, *, draws: bool = True) -> None:
    """Write a page, whole or not at all.

    Parameters
    ----------
    path : str or Path
    page : Page
    draws : bool
        Whether its figures are drawn and its script is made; an interrupted command leaves them out.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    write_text(path, render_page(page, draws=draws))


def render_page(page: Page, *, draws: bool = True) -> str:
    """The page as HTML; parameters as for `write_page`."""
    from importlib import resources

    from jinja2 import Environment, StrictUndefined
    from markupsafe import Markup

    template = resources.files(__package__).joinpath("page.html").read_text("utf-8")
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    numbers = count(1)

    def blocks(parts: tuple[Report | Picture, ...]) -> Iterator[dict[str, Any]]:
        for part in parts:
            if isinstance(part, Picture):
                if draws:
                    block = _picture_block(part, next(numbers))
                    yield {**block, "svg": Markup(block["svg"])} if "svg" in block else block
            else:
                yield from map(_report_block, part.parts)

    sections = [{"title": s.title, "blocks": found} for s in page.sections if (found := list(blocks(s.parts)))]
    verdict = list(blocks((page.verdict,)))
    tones = [block.get("tone", Tone.PLAIN.value) for block in verdict]
    tone = max(tones, key=_SEVERITY.index, default=Tone.PLAIN.value)
    script = page.script() if page.script is not None and draws else ""
    text = environment.from_string(template).render(
        title=page.title,
        tone=tone,
        verdict=verdict,
        warnings=page.warnings,
        sections=sections,
        script=Markup(script),
        script_hash=Markup(base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()),
    )
    return replace_unprintable(text)  # of a file's name, say, whose bytes are no letters


def _picture_block(picture: Picture, number: int) -> dict[str, Any]:
    try:
        svg = to_svg(picture.draw(), f"figure{number}", picture.alt)
    except InputError as error:
        return {"kind": "line", "text": f"{picture.caption} is not drawn: {error}", "tone": "plain", "indent": 0}
    return {"kind": "picture", "svg": svg, "number": number, "caption": picture.caption}


def _report_block(part: Line | Table) -> dict[str, Any]:
    if isinstance(part, Line):
        return {"kind": "line", "text": part.text, "tone": part.tone.value, "indent": part.indent}
    columns = [{"heading": c.heading.split("\n"), "is_text": c.is_text} for c in part.columns]
    return {"kind": "table", "columns": columns, "rows": part.rows}
