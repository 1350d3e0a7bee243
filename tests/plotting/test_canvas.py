"""Files of figures."""

from pathlib import Path

import pytest
from matplotlib.figure import Figure

from pneuopt.plotting import (
    save_figure,
)
from pneuopt.quantities.errors import InputError


@pytest.mark.parametrize(("suffix", "start"), [("png", b"\x89PNG"), ("pdf", b"%PDF"), ("SVG", b"<?xml")])
def test_a_figure_is_written_by_its_suffix(tmp_path: Path, suffix: str, start: bytes) -> None:
    save_figure(Figure(), tmp_path / f"bode.{suffix}")
    assert (tmp_path / f"bode.{suffix}").read_bytes().startswith(start)
    with pytest.raises(InputError):
        save_figure(Figure(), tmp_path / "bode.jpg")
    with pytest.raises(InputError):
        save_figure(Figure(), tmp_path / "none" / "bode.png")
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("suffix", ["png", "svg", "pdf"])
def test_a_name_that_is_a_broken_formula_or_no_letters_is_drawn_as_it_is(tmp_path: Path, suffix: str) -> None:
    figure = Figure()
    figure.subplots().set_title("run $\\frac$ \x07 \udcff")
    save_figure(figure, tmp_path / f"a.{suffix}")
    assert (tmp_path / f"a.{suffix}").stat().st_size > 1000
