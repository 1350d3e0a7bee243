"""Keep figures that scripts have drawn with --out for the gallery of a clean clone: small, with what drew them.

python .docs/keep_figures.py out/FIGURE.png ...
"""

import sys
from pathlib import Path

from PIL import Image
from PIL.PngImagePlugin import PngInfo

FIGURES = Path(__file__).with_name("figures")
WIDTH, COLOURS = 1200, 96  # pixels, as many as a page shows on a sharp screen; in a palette, a third of the bytes


def keep(path: Path) -> Path:
    """Write a figure into `.docs/figures`, at most WIDTH wide, in a palette, with its Description."""
    said = PngInfo()
    with Image.open(path) as drawn:
        said.add_text("Description", drawn.info["Description"])
        width = min(WIDTH, drawn.width)
        small = drawn.convert("RGB").resize(
            (width, round(drawn.height * width / drawn.width)), Image.Resampling.LANCZOS
        )
    kept = FIGURES / path.name
    small.quantize(COLOURS).save(kept, optimize=True, pnginfo=said)
    return kept


if __name__ == "__main__":
    for name in sys.argv[1:]:
        figure = keep(Path(name))
        print(f"{figure}: {figure.stat().st_size / 1000:.0f} kB")
