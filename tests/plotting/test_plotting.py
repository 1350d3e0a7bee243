import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from pneuopt.control.moves import Move
from pneuopt.control.reference import Step
from pneuopt.dynamics.system import Linearisation
from pneuopt.evaluation.margins import margins
from pneuopt.logs.experiment import Experiment, split
from pneuopt.plotting import (
    Response,
    plot_bode,
    plot_correlation,
    plot_fit,
    plot_map,
    plot_prediction,
    plot_residuals,
    plot_steps,
    save_figure,
)
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.trajectories import Trajectory
from tests.plotting.fits import TRUTH, fit_of, fitted, line, texts

if TYPE_CHECKING:
    pass

TRIPLE = np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 1.0], [0.0, 0.0, -1.0]])


def lag(gain: float) -> Linearisation:
    A, B, C, D = (np.array([[v]]) for v in (-1.0, gain, 1.0, 0.0))
    return Linearisation(A, B, C, D, ("x",), ("u",), ("y",))


def test_a_fit_stands_beside_its_log_with_units() -> None:
    pairs = [fitted(seed) for seed in range(2)]
    figure = plot_fit(fit_of(TRUTH, {e.name: run for e, run in pairs}), [e for e, _ in pairs])
    assert len(figure.axes) == 4
    assert [texts(a) for a in figure.axes[:2]] == ["|position [mm]|run_0", "||run_1"]
    assert figure.axes[3].get_xlabel() == "time [s]"
    y = line(figure.axes[0], "fitted")[1]
    assert np.allclose(y, 1e3 * pairs[0][1]["position"])
    residual = np.asarray(figure.axes[2].lines[0].get_ydata(), dtype=float)
    assert np.abs(residual).max() < 1e-9
    assert [q.get_text() for q in figure.legends[0].get_texts()] == ["measured", "fitted"]
    assert all(a.get_legend() is None for a in figure.axes)


def test_windows_of_a_log_share_its_axes_and_many_logs_are_spread() -> None:
    experiment, run = fitted()
    windows = split(experiment, 0.25)
    runs = [run.rows(125 * k, 125 * (k + 1)) for k in range(len(windows))]
    assert len(plot_prediction(runs, windows, label="predicted").axes) == 2
    several = [Experiment(experiment.trajectory, name=f"log {k}") for k in range(7)]
    figure = plot_prediction([run] * 7, several, label="predicted")
    assert [a.get_title() for a in figure.axes[:3]] == ["log 0", "log 3", "log 6"]
    assert "3 of 7 logs" in [q.get_text() for q in figure.texts]
    with pytest.raises(InputError, match="2 runs do not match 1 experiments"):
        plot_prediction([run, run], [experiment], label="fitted")


def test_residuals_show_what_is_left_in_them() -> None:
    experiment, run = fitted()
    rng = np.random.default_rng(0)
    white = 1e-5 * rng.standard_normal(len(run))
    noisy = Experiment(run.with_columns({"force": experiment.trajectory["force"]}), {"position": 1e-5}, name="run")
    good = Experiment(noisy.trajectory.with_columns({"position": run["position"] + white}), {"position": 1e-5})
    pulled = run["position"] + white + 2e-7 * experiment.trajectory["force"]
    bad = Experiment(noisy.trajectory.with_columns({"position": pulled}), {"position": 1e-5})
    for log, expected in ((good.select(["force", "position"]), False), (bad.select(["force", "position"]), True)):
        over_time, own, crossed, spread = plot_residuals([run], [log]).axes
        assert texts(over_time) == "time [s]|position [mm]|residuals"
        assert texts(own).startswith("lag [samples]||autocorrelation")
        rho = np.asarray(line(crossed, "force")[1])
        band = 1.96 / np.sqrt(len(run))
        assert bool(np.abs(rho).max() > 2 * band) is expected
        (told,) = own.texts
        assert told.get_text().startswith("Ljung-Box p")
        assert ("< 1e-4" in told.get_text()) is expected
        assert (spread.get_xlabel(), spread.get_ylabel()) == ("residual / noise", "")
    with pytest.raises(InputError, match="1 runs do not match 2 experiments"):
        plot_residuals([run], [good, bad])


def test_correlations_are_cells_and_never_a_rounded_one() -> None:
    names = ["load.force", "friction.coulomb_asymmetry", "load.mass"]
    covariance = pd.DataFrame([[1, 0.99998, 0], [0.99998, 1, 0], [0, 0, np.nan]], index=names, columns=names)
    axes = plot_correlation(fit_of(TRUTH, {}, covariance)).axes[0]
    assert [q.get_text() for q in axes.get_xticklabels()] == names[:2]
    assert sorted(q.get_text() for q in axes.texts) == ["0.9999", "0.9999", "1.00", "1.00"]
    with pytest.raises(InputError, match="no estimate has a standard deviation"):
        plot_correlation(fit_of(TRUTH, {}, covariance * np.nan))


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
    with pytest.raises(InputError, match="no response"):
        plot_steps([])


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


def study(masses: Sequence[float], pressures: Sequence[float], errors: Mapping[int, str] | None = None) -> pd.DataFrame:
    rows = []
    for k, (p, m) in enumerate(itertools.product(pressures, masses)):
        error = (errors or {}).get(k, "")
        rows.append((p, m, *((np.nan, np.nan) if error else (0.1 * m / p, m)), error))
    return pd.DataFrame(rows, columns=["supply.pressure", "load.mass", "SettlingTime", "Overshoot", "error"])


def test_a_study_over_two_axes_is_a_map_that_marks_what_failed() -> None:
    table = study([2.0, 4.0, 9.0], [6.0, 5.0], {0: "ValueError: no", 2: "interrupted"})
    table.loc[1, "SettlingTime"] = np.nan
    figure = plot_map(table, {"load.mass": "kg", "supply.pressure": "bar(g)"}, {"SettlingTime": "s", "Overshoot": "%"})
    left, right = figure.axes[:2]
    assert texts(left) == "load.mass [kg]|supply.pressure [bar(g)]|SettlingTime [s]"
    assert texts(right) == "load.mass [kg]||Overshoot [%]"
    cells = [["0.04", "0.08", "0.18"], ["failed", "never", "interrupted"]]
    for j, row in enumerate(cells):
        for i, cell in enumerate(row):
            assert [q.get_text() for q in left.texts if q.get_position() == (i + 0.5, j + 0.5)] == [cell]
    assert [q.get_text() for q in left.get_xticklabels()] == ["2", "4", "9"]
    assert [q.get_text() for q in left.get_yticklabels()] == ["5", "6"]
    assert [q.get_text() for q in right.texts] == ["2", "4", "9", "failed", "4", "interrupted"]


def test_a_study_of_many_cases_is_a_map_without_figures() -> None:
    table = study(np.linspace(1, 2, 20).tolist(), [4.0, 5.0])
    (panel, _) = plot_map(table, {"load.mass": "kg", "supply.pressure": "bar(g)"}, {"SettlingTime": "s"}).axes
    assert (len(panel.texts), len(panel.get_xticks()), len(panel.get_yticks())) == (0, 5, 2)


def test_a_study_over_one_axis_is_a_line_that_marks_what_failed() -> None:
    table = study([4.0, 2.0, 6.0], [5.0], {2: "ValueError: no"})
    figure = plot_map(table, {"load.mass": "kg"}, {"SettlingTime": "s"})
    (panel,) = figure.axes
    assert texts(panel) == "load.mass [kg]||SettlingTime [s]"
    x, y = panel.lines[0].get_data()
    assert np.array_equal(x, [2, 4, 6])
    assert np.array_equal(y, [0.04, 0.08, np.nan], equal_nan=True)
    assert [(q.get_text(), q.get_position()[0]) for q in panel.texts] == [("failed", 6)]


def test_a_study_that_cannot_be_drawn_says_why() -> None:
    table = study([2.0], [5.0])
    with pytest.raises(InputError, match="one or two axes, this has 3"):
        plot_map(table, {"load.mass": "kg", "supply.pressure": "bar", "Overshoot": "%"}, {"SettlingTime": "s"})
    with pytest.raises(InputError, match="no metric"):
        plot_map(table, {"load.mass": "kg"}, {})
    with pytest.raises(InputError, match="unknown column 'SetlingTime'; did you mean 'SettlingTime'"):
        plot_map(table, {"load.mass": "kg"}, {"SetlingTime": "s"})


@pytest.mark.parametrize(("suffix", "start"), [("png", b"\x89PNG"), ("pdf", b"%PDF"), ("SVG", b"<?xml")])
def test_a_figure_is_written_by_its_suffix(tmp_path: Path, suffix: str, start: bytes) -> None:
    save_figure(plot_bode(lag(5.0)), tmp_path / f"bode.{suffix}")
    assert (tmp_path / f"bode.{suffix}").read_bytes().startswith(start)
    with pytest.raises(InputError, match=r"bode\.jpg: a figure is written as \.png, \.pdf, \.svg; name it so"):
        save_figure(plot_bode(lag(5.0)), tmp_path / "bode.jpg")
    with pytest.raises(InputError, match="the folder does not exist"):
        save_figure(plot_bode(lag(5.0)), tmp_path / "none" / "bode.png")
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("suffix", ["png", "svg", "pdf"])
def test_a_name_that_is_a_broken_formula_or_no_letters_is_drawn_as_it_is(tmp_path: Path, suffix: str) -> None:
    figure = Figure()
    figure.subplots().set_title("run $\\frac$ \x07 \udcff")
    save_figure(figure, tmp_path / f"a.{suffix}")
    assert (tmp_path / f"a.{suffix}").stat().st_size > 1000
