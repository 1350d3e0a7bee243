"""The page that moves: is it what `simulate` says at any setting, and does it follow a slider at once?

    python problems/demo/moving_page.py [--json FILE]

T32, a pneumatic drive with LuGre friction under a sampled PID and a dither of 160 Hz, in a page that a headless
Chromium shows. `difference`: fifty random places of all sliders at once, gains, dither, load, supply and friction, each
from its own rest over 1 s; the largest difference of any state or output from `simulate`, as a share of its largest
value. Rows frame.*: from a slider's move to the redrawn page by the clock, at four places of each slider the least of
five, as other work of the machine is in it. Without Chromium the script ends in a line.
"""

import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np

import pneuopt as po
from problems.shared.claims import Claim, arguments, finish, frame
from problems.shared.live_page import CHROMIUM, Run, compare_settings, run_in_chromium, time_frames

if TYPE_CHECKING:
    import pandas as pd

COUNT = 50
STEP = po.Step(0.2, horizon=1.0)  # [m/s]
VALUES = {"pid.Kp": 4.0, "pid.Ki": 20.0, "pid.lower": -5.0, "pid.upper": 5.0, "dither.amplitude": 0.3}


def t32_loop() -> tuple[po.ClosedLoop, po.ParameterSet]:
    """The drive T32 under a sampled PID and dither, and its parameters."""
    drive, hardware = po.catalog.t32()
    loop = po.ClosedLoop(drive.system(), po.PID(sample_time=1e-3), po.Dither(160.0))
    return loop, loop.complete(hardware).with_values(VALUES)


def main(run: Run, count: int = COUNT) -> "pd.DataFrame":
    """The claims; `run` gives what a script leaves in a page."""
    loop, parameters = t32_loop()
    times = time_frames(loop, parameters, [STEP], run)
    worst = compare_settings(loop, parameters, [STEP], count, run)
    return frame(
        [
            Claim("difference", worst, "1", None, "<= 1e-6"),
            Claim("frame.median", float(np.median(times)), "ms", None, "<= 50"),
            Claim("frame.p95", float(np.percentile(times, 95)), "ms", None, "<= 50"),
        ]
    )


if __name__ == "__main__":
    options = arguments(__doc__).parse_args()
    if CHROMIUM is None:
        sys.exit("no chromium on the path: apt-get install chromium")
    with tempfile.TemporaryDirectory() as place:
        sys.exit(finish(main(lambda script: run_in_chromium(script, Path(place))), options))
