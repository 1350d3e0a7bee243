""""""

import numpy as np
import pytest

from pneuopt.logs.doctor import CHECKS, PISTON, examine
from pneuopt.plotting import plot_finding
from tests.logs.bad_logs import BAD_LOGS, STATED
from tests.plotting.fits import line, texts


@pytest.mark.parametrize("check", CHECKS)
def test_every_finding_is_drawn_with_names_and_units(check: str) -> None:
    finding = examine(BAD_LOGS[check], STATED.get(check, PISTON))[0]
    figure = plot_finding(finding)
    assert finding.evidence is not None
    panels = finding.evidence.panels
    for axes, panel in zip(figure.axes[:: len(figure.axes) // len(panels)], panels, strict=True):
        assert "[" in axes.get_ylabel()
        assert [str(drawn.get_label()) for drawn in axes.lines] == list(panel.curves)
    title = figure.get_suptitle().replace("\n", " ")
    assert title == f"swing: {finding.message}"


def test_the_signals_that_contradict_each_other_stand_above_each_other_in_the_units_of_a_figure() -> None:
    log = BAD_LOGS["speed"]
    figure = plot_finding(examine(log)[0])
    said = ["|[m/s]|whole log", "||enlarged", "time [s]|position [mm]|", "time [s]||"]
    assert [texts(axes) for axes in figure.axes] == said
    t, y = line(figure.axes[0], "speed")
    assert np.allclose(y, log.trajectory["speed"])
    assert np.allclose(t, log.trajectory.t)
    assert np.allclose(line(figure.axes[2], "position")[1], 1e3 * log.trajectory["position"])
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    assert words == ["speed", "slope of the position", "they contradict each other"]
    low, high = figure.axes[1].get_xlim()
    assert 0.5 < high - low < 2.1  # two strokes of half a second, and what noise adds
