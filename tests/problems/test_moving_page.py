"""The script of the page that moves: its rows hold what was measured, and a wrong page is found."""

import json
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from problems.demo.moving_page import STEP, main, t32_loop
from problems.shared.live_page import CHROMIUM, run_in_chromium, time_frames

NODE = shutil.which("node")


def runner(folder: Path, *, frame: float = 8.0, change: Callable[[str], str] = str) -> Callable[[str], Any]:
    """Node in the browser's place, which shows no sliders: a frame's time is given."""

    def run(script: str) -> Any:
        if "querySelectorAll" in script:
            return [frame] * 20
        place = folder / "script.js"
        place.write_text(f"{change(script)}console.log(JSON.stringify(told));", encoding="utf-8")
        done = subprocess.run([NODE or "node", str(place)], capture_output=True, text=True, check=True)
        return json.loads(done.stdout)

    return run


@pytest.mark.skipif(NODE is None, reason="node runs the script")
def test_the_rows_hold_what_is_claimed_and_a_wrong_page_is_found(tmp_path: Path) -> None:
    assert main(runner(tmp_path), count=1)["holds"].all()
    coarse = lambda text: text.replace("TOLERANCE = 3e-10", "TOLERANCE = 1e-4")  # noqa: E731
    wrong = main(runner(tmp_path, frame=80.0, change=coarse), count=1)
    assert not wrong["holds"].any()


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="chromium shows the page")
def test_a_browser_moves_every_slider(tmp_path: Path) -> None:
    loop, parameters = t32_loop()
    times = time_frames(loop, parameters, [STEP], lambda script: run_in_chromium(script, tmp_path))
    assert len(times) > 40
