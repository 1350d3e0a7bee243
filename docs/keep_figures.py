"""Keep figures that scripts have drawn with --out for the gallery of a clean clone: small, with what drew them.

python docs/keep_figures.py out/FIGURE.png ...
"""

import sys
from pathlib import Path

from PIL import Image
from PIL.PngImagePlugin import PngInfo

FIGURES = Path(__file__).with_name("figures")
WIDTH = 1200  # pixels, as many as a page shows on a sharp screen
# A palette takes a third of the bytes. This one covers the colours evenly, so that a small star or the end of a colour
# bar keeps its own; the usual one, by how many pixels have a colour, turned yellow into orange.
PALETTE = {"colors": 256, "method": Image.Quantize.MAXCOVERAGE, "dither": Image.Dither.NONE}


def keep(path: Path) -> Path:
    """Write a figure into `docs/figures`, at most WIDTH wide, in a palette, with its Description."""
    said = PngInfo()
    with Image.open(path) as drawn:
        said.add_text("Description", drawn.info["Description"])
        width = min(WIDTH, drawn.width)
        small = drawn.convert("RGB").resize(
            (width, round(drawn.height * width / drawn.width)), Image.Resampling.LANCZOS
        )
    kept = FIGURES / path.name
    small.quantize(**PALETTE).save(kept, optimize=True, pnginfo=said)
    return kept


if __name__ == "__main__":
    for name in sys.argv[1:]:
        figure = keep(Path(name))
        print(f"{figure}: {figure.stat().st_size / 1000:.0f} kB")
