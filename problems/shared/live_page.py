"""A loop's page in a browser: random settings of all its sliders beside `simulate`, and what a frame takes."""

import json
import shutil
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pneuopt.control.loop import ClosedLoop, add_disturbances
from pneuopt.control.reference import Step
from pneuopt.dynamics.simulate import simulate
from pneuopt.evaluation.response import loop_inputs, sample_spacing
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.report.tuning_page import live_script, to_script

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
POINTS = 300  # instants at which the two are compared
QUIET = "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking"
FRAMES = """
const told = [];
for (const input of document.querySelectorAll("#live input")) {
  for (const value of [0.2, 0.4, 0.6, 0.8]) {
    const times = [1, 2, 3, 4, 5].map(() => {
      input.value = value;
      const begun = performance.now();
      input.dispatchEvent(new Event("input"));
      return performance.now() - begun;
    });
    told.push(Math.min(...times));
  }
}
"""

Run = Callable[[str], Any]


def live_data(script: str) -> Any:
    """What the page's script knows of its loop."""
    return json.loads(script.partition("const DATA = ")[2].partition(";\n")[0])


def random_settings(data: Any, parameters: ParameterSet, count: int) -> list[ParameterSet]:
    """Random places of all sliders at once, as the page moves them."""
    rng, found = np.random.default_rng(0), []
    for _ in range(count):
        places = ((s, rng.uniform()) for s in data["sliders"])
        found.append(parameters.with_values({s["name"]: slider_value(s, share) for s, share in places}))
    return found


def slider_value(slider: Any, share: float) -> float:
    """The value at a share of a slider's way."""
    low, high = slider["low"], slider["high"]
    return float(low * (high / low) ** share if slider["isLog"] else low + (high - low) * share)


def compare_settings(
    loop: ClosedLoop, parameters: ParameterSet, references: Sequence[Step], count: int, run: Run
) -> float:
    """The largest difference of a page at random settings from `simulate` there, from the rest that each finds."""
    script, worst = live_script(loop, references, parameters), 0.0
    loop, data = add_disturbances(loop, references), live_data(script)
    cases = random_settings(data, parameters, count)
    for k, reference in enumerate(references):
        jobs = to_script([loop.parameter_vector(p).tolist() for p in cases])
        call = f"const r = DATA.references[{k}]; const b = findRest(p, r);"
        call += f" const f = b && simulateLoop(p, b, r, r.horizon, {POINTS});"
        call += " return f && [...f.states, ...f.outputs].map((a) => Array.from(a));"
        found = run(f"{script}\nconst told = {jobs}.map((a) => {{ const p = Float64Array.from(a); {call} }});")
        for p, signals in zip(cases, found, strict=True):
            assert signals is not None, f"{reference.label}: the page finds no rest, or cannot simulate"
            worst = max(worst, _difference(loop, reference, p, signals))
    return worst


def time_frames(loop: ClosedLoop, parameters: ParameterSet, references: Sequence[Step], run: Run) -> list[float]:
    """From a slider's move to the redrawn page [ms], at four places of each slider: the least of five, so that what
    else the machine does counts little.
    """
    found: list[float] = run(live_script(loop, references, parameters) + FRAMES)
    return found


def run_in_chromium(script: str, folder: Path) -> Any:
    """What the script leaves as ``told``, from a page in a headless browser."""
    page = folder / "settings.html"
    text = f'<!DOCTYPE html><meta charset="utf-8"><pre id="told"></pre><section id="live"></section><script>{script}'
    text += 'document.getElementById("told").textContent = JSON.stringify(told);</script>'
    page.write_text(text, encoding="utf-8")
    call = [CHROMIUM or "chromium", *QUIET.split(), "--dump-dom", f"--user-data-dir={folder / 'profile'}"]
    done = subprocess.run([*call, page.as_uri()], capture_output=True, text=True, check=False)
    return json.loads(done.stdout.partition('<pre id="told">')[2].partition("</pre>")[0])


def _difference(loop: ClosedLoop, reference: Step, p: ParameterSet, signals: list[list[float]]) -> float:
    """Of a page's signals from those of `simulate`, each as a share of its largest value."""
    x0 = loop.initial(p, reference=reference.initial, start=reference.start)
    inputs = loop_inputs(loop, reference, sample_spacing(loop, reference, p))
    t, worst = np.linspace(0, reference.horizon, POINTS + 1), 0.0
    run = simulate(loop, inputs, p, initial=x0, t_out=t, max_steps=np.inf)
    names = [q.name for q in (*loop.states, *loop.outputs)]
    for name, signal in zip(names, signals, strict=True):
        size = max(float(np.abs(run[name]).max()), 1e-9)
        worst = max(worst, float(np.abs(run[name] - np.array(signal)).max()) / size)
    return worst
