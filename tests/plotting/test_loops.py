"""Step responses and Bode plots of loops."""

import numpy as np
import pytest

from pneuopt.control.moves import Move
from pneuopt.control.reference import Step
from pneuopt.dynamics.system import Linearisation
from pneuopt.evaluation.margins import margins
from pneuopt.plotting import (
    Response,
    plot_bode,
    plot_steps,
)
from pneuopt.quantities.trajectories import Trajectory
from tests.plotting.fits import line, texts

TRIPLE = np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 1.0], [0.0, 0.0, -1.0]])


def lag(gain: float) -> Linearisation:
    A, B, C, D = (np.array([[v]]) for v in (-1.0, gain, 1.0, 0.0))
    return Linearisation(A, B, C, D, ("x",), ("u",), ("y",))


def test_steps_show_band_reference_and_command() -> None:
    t = np.linspace(0, 1, 101)
    run = Trajectory(t, {"speed": 0.2 * (1 - np.exp(-t / 0.1)), "control": 3 * np.exp(-t)})
    wild = Trajectory(t, {"speed": 1e6 * t, "control": 1e6 * t})
    step = Step(0.2, at=0.0, horizon=1.0)
    figure = plot_steps([Response(run, step, "speed", ("m/s", "V"), wild)], band=0.05)
    top, bottom = figure.axes
    assert texts(top) == "|speed [m/s]|0 to 0.2 m/s"
    assert texts(bottom) == "time [s]|command [V]|"
    (band,) = top.collections
    assert band.get_datalim(top.transData).intervaly.tolist() == pytest.approx([0.19, 0.21])
    assert top.get_ylim()[1] < 0.5
    assert [q.get_text() for q in figure.legends[0].get_texts()] == [
        "± 5 % of the step",
        "reference",
        "before",
        "tuned",
    ]
    alone = plot_steps([Response(run, step, "speed", ("m/s", "V"))] * 4)
    assert [a.get_title() for a in alone.axes[:3]] == ["0 to 0.2 m/s"] * 3
    assert "3 of 4 steps" in [q.get_text() for q in alone.texts]


def test_a_move_is_drawn_as_it_runs() -> None:
    t, move = np.linspace(0, 1, 101), Move(0.2, speed=0.5, acceleration=5.0, dwell=0.5)
    run = Trajectory(t, {"position": move.values(t - 0.01), "control": np.zeros(101)})
    figure = plot_steps([Response(run, move, "position", ("m", "V"))])
    drawn = figure.axes[0].lines[0]
    assert drawn.get_label() == "reference"
    x, y = np.asarray(drawn.get_xdata()), np.asarray(drawn.get_ydata())
    np.testing.assert_allclose(y, move.values(x))
    assert y[-1] == move.final


def test_steps_show_what_goes_on_inside_where_it_is_known() -> None:
    t = np.linspace(0, 1, 101)
    run = Trajectory(t, {"speed": t, "control": t, "valve.spool": 0.1 * t, "friction.force": 40 * t})
    before = run.with_columns({"friction.force": 20 * t})
    figure = plot_steps([Response(run, Step(1.0, horizon=1.0), "speed", ("m/s", "V"), before)])
    assert [a.get_ylabel() for a in figure.axes] == ["speed [m/s]", "command [V]", "valve [%]", "friction [N]"]
    assert np.asarray(figure.axes[2].lines[-1].get_ydata())[-1] == pytest.approx(10.0)
    assert [np.asarray(q.get_ydata())[-1] for q in figure.axes[3].lines] == [20, 40]


def test_under_dither_the_average_is_drawn_that_the_metrics_read() -> None:
    t = np.linspace(0, 1, 1001)
    run = Trajectory(t, {"speed": 0.2 + 0.05 * np.sin(2 * np.pi * 50 * t), "control": t})
    figure = plot_steps([Response(run, Step(0.2), "speed", ("m/s", "V"), dither_period=0.02)])
    at, mean = line(figure.axes[0], "simulated, averaged")
    assert np.allclose(mean, 0.2, atol=1e-12)
    assert (at[0], at[-1]) == pytest.approx((0.0095, 0.9905))


@pytest.mark.parametrize("gain", [1.0, 4.0])
def test_bode_marks_the_margins(gain: float) -> None:
    A, B, C, D = TRIPLE, np.array([[0.0], [0.0], [gain]]), np.array([[1.0, 0.0, 0.0]]), np.zeros((1, 1))
    loop = Linearisation(A, B, C, D, ("x", "v", "a"), ("u",), ("x",))
    m, figure = margins(loop), plot_bode(loop)
    top, bottom, peaks = figure.axes
    labels = [q.get_text() for q in figure.legends[0].get_texts()]
    assert labels == [
        f"gain margin {20 * np.log10(m.gain_margin):.1f} dB at {m.phase_crossover:.3g} rad/s",
        f"phase margin {m.phase_margin:.1f}° at {m.gain_crossover:.3g} rad/s",
    ]
    ends = line(bottom, labels[1])[1]
    assert ends[0] == pytest.approx(-180)
    assert ends[1] - ends[0] == pytest.approx(m.phase_margin, abs=0.05)
    assert line(top, labels[0])[1][1] == pytest.approx(-20 * np.log10(m.gain_margin))
    assert ("UNSTABLE" in top.get_title()) == (gain > 2)
    assert texts(peaks).startswith("frequency [rad/s]|")
    assert np.max(peaks.lines[0].get_ydata()) == pytest.approx(m.max_sensitivity, rel=1e-3)
    assert np.max(peaks.lines[1].get_ydata()) == pytest.approx(m.max_complementary_sensitivity, rel=1e-3)


def test_bode_shows_the_loop_before_in_grey() -> None:
    figure = plot_bode(lag(5.0), lag(0.5))
    top = figure.axes[0]
    assert [q.get_label() for q in top.lines[:2]] == ["before", "tuned"]
    earlier, later = (np.asarray(q.get_ydata()) for q in top.lines[:2])
    assert later - earlier == pytest.approx(20.0)  # ten times the gain


def test_a_loop_without_crossings_has_no_marks() -> None:
    figure = plot_bode(lag(0.5))
    assert figure.legends == []
    assert "Ms = 1," in figure.axes[0].get_title()
