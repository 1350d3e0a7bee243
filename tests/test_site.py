"""The site: every public name has its page, no source links to what is none; the slow part builds it."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

import pneuopt

ROOT = Path(__file__).parents[1]
MIN_FIGURES = 34  # of a clean clone
MAX_FIGURE_BYTES = 120_000


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def pages(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> ModuleType:
    monkeypatch.setattr(sys, "argv", ["make_pages.py", str(tmp_path / "pages")])
    return load("make_pages")


def test_every_public_name_and_script_has_its_place(pages: ModuleType) -> None:
    rooms = pages.public_names()
    assert set(rooms) <= set(pages.ROOMS)
    modules = {"catalog", "paper2015", "plotting"}
    assert {name for names in rooms.values() for name in names} | modules >= set(pneuopt.__all__) - {"__version__"}
    assert all((ROOT / call.split()[0]).is_file() for _, call, _ in pages.scripts() if call)


def test_pages_written_by_hand_have_their_tables_and_a_place(pages: ModuleType) -> None:
    assert "| `load.mass` | kg |" in pages.TABLES["keys.md"]()
    assert "**identify**: `pneuopt identify`" in pages.TABLES["outputs.md"]()
    shown = {f"{page}.md" for part in pages.CONTENTS.values() for page in part}
    assert set(pages.PAGES.values()) - {"index.md"} == shown - {"api/index.md"}
    assert set(pages.TABLES) <= set(pages.BY_HAND)


def test_sources_link_to_pages_of_the_site(pages: ModuleType) -> None:
    for source in pages.PAGES:
        pages.localise((ROOT / source).read_text("utf-8"), str(Path(source).parent))
    with pytest.raises(AssertionError, match=r"a link to LICENSE, of which the site has no page"):
        pages.localise("[licence](LICENSE)", "")
    with pytest.raises(AssertionError, match=r"a link to docs/no.md, which is not there"):
        pages.localise("[no](docs/no.md)", "")
    assert pages.localise("[words](logs.md#formats)", "docs") == "[words](logs.md#formats)"
    assert pages.localise("[b32](../problems/identify/b32.py)", "docs") == "[b32](gallery.md#b32)"
    assert pages.link_names("see `tune`\n```\n`tune`\n```") == "see {py:obj}`tune <pneuopt.tune>`\n```\n`tune`\n```"


def test_a_broken_link_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.html").write_text('<p id="x"><a href="b.html#y">b</a> <a href="#x">x</a><img src="http://c/d.png">')
    (tmp_path / "b.html").write_text('<a href="c.html">c</a>')
    wrong, inside, outside = load("check_links").problems_of(tmp_path)
    assert sorted(wrong) == [
        "a.html: b.html#y: the page has no such place",
        "a.html: fetches http://c/d.png",
        "b.html: c.html is not there",
    ]
    assert (inside, outside) == (3, 1)


def test_rows_that_a_docstring_names_stay_as_they_are(pages: ModuleType) -> None:
    text = "Rows frame.*: of a frame.\n\n    a.* b\n\nRows price.*: *all*."
    assert pages.escape_asterisks(text) == "Rows frame.\\*: of a frame.\n\n    a.* b\n\nRows price.\\*: *all\\*."


def test_the_gallery_of_a_clean_clone_shows_what_scripts_have_drawn(pages: ModuleType) -> None:
    scripts = [ROOT / call.split()[0] for _, call, _ in pages.scripts() if call]
    shown = {figure for script in scripts for figure in pages.figures_of(script)}
    committed = set((ROOT / "docs" / "figures").glob("*.png"))
    assert committed <= {ROOT / "docs" / "figures" / figure.name for figure in shown}, "each is of a script"
    linked = set(re.findall(r"\(\.\./docs/figures/(\S+?)\)", (ROOT / "problems" / "README.md").read_text("utf-8")))
    assert linked == {figure.name for figure in committed}, "the table of claims links them"
    assert len(shown) >= MIN_FIGURES
    assert all(figure.stat().st_size < MAX_FIGURE_BYTES for figure in committed)


def test_a_kept_figure_is_small_and_says_what_drew_it(
    pages: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    keeper = load("keep_figures")
    monkeypatch.setattr(keeper, "FIGURES", tmp_path)
    drawn = tmp_path / "out" / "p32.png"
    drawn.parent.mkdir()
    command = "python problems/tune/p32.py --plants 8 --out out"
    Figure(figsize=(12, 4)).savefig(drawn, dpi=150, metadata={"Description": command})
    kept = keeper.keep(drawn)
    with Image.open(kept) as image:
        assert image.size == (1200, 400)
    assert pages.drawing_command(kept, "problems/tune/p32.py") == command
    assert pages.drawing_command(ROOT / "docs/figures/crawl.png", "a.py PATH") == "python a.py PATH --out out"


def test_a_kept_figure_shows_the_colours_that_were_drawn(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A star of a few pixels on a map keeps its colour, too."""
    keeper = load("keep_figures")
    monkeypatch.setattr(keeper, "FIGURES", tmp_path)
    picture, drawn = Figure(figsize=(12, 4)), tmp_path / "out" / "map.png"
    drawn.parent.mkdir()
    axes = picture.subplots()
    axes.imshow(np.linspace(0, 1, 300).reshape(10, 30), cmap="viridis")
    axes.plot(15, 5, "*", color="#e57c00", ms=12)
    picture.savefig(drawn, dpi=100, metadata={"Description": "python problems/a.py --out out"})
    with Image.open(drawn) as image:
        asked = np.asarray(image.convert("RGB"), dtype=int)
    with Image.open(keeper.keep(drawn)) as image:
        assert np.abs(np.asarray(image.convert("RGB"), dtype=int) - asked).max() <= 25


@pytest.mark.slow
def test_the_site_is_built_without_a_warning_or_a_broken_link(tmp_path: Path) -> None:
    pytest.importorskip("furo", reason="the group docs is not installed: make docs")
    pages, site, config = tmp_path / "pages", tmp_path / "site", ROOT / "docs"
    sphinx = ["-m", "sphinx", "-q", "-W", "--keep-going", "-c", str(config), str(pages), str(site)]
    for arguments in ([str(config / "make_pages.py"), str(pages)], sphinx, [str(config / "check_links.py"), str(site)]):
        done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
