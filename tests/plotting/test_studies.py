"""Maps and lines of studies, the share of cases that keep a bound, and bars of sensitivities.

The figure of a planned experiment: its signals within their limits, and the intervals before and after.
"""

import itertools
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pandas as pd
import pytest
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from pneuopt.experiments.design import ExperimentDesign
from pneuopt.plotting import plot_distribution, plot_experiment, plot_map, plot_sensitivity
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.studies.sensitivity import LocalSensitivity, sensitivity
from tests.plotting.fits import texts

TABLE = pd.DataFrame(
    {
        "SettlingTime": [0.3, 0.1, np.nan, 0.2, np.nan],
        "PhaseMargin": [60.0, 40.0, 50.0, 30.0, np.nan],
        "error": ["", "", "", "", "failed"],
    }
)


def test_a_curve_is_the_share_of_all_cases_that_keep_the_bound() -> None:
    panels = plot_distribution(TABLE, {"SettlingTime": "s", "PhaseMargin": "deg"}).axes
    x, y = map(np.asarray, panels[0].lines[0].get_data())
    assert x.tolist() == [0.1, 0.1, 0.2, 0.3]
    assert y.tolist() == pytest.approx([0.0, 0.2, 0.4, 0.6])
    assert panels[0].get_title() == "2 without a figure"
    x, y = map(np.asarray, panels[1].lines[0].get_data())
    assert x.tolist() == [60.0, 60.0, 50.0, 40.0, 30.0]  # at least
    assert y.tolist() == pytest.approx([0.0, 0.2, 0.4, 0.6, 0.8])


def test_the_bound_that_most_cases_keep_is_marked() -> None:
    table = pd.DataFrame({"Overshoot": np.arange(1.0, 101.0), "error": ""})
    (panel,) = plot_distribution(table, {"Overshoot": "%"}).axes
    assert panel.texts[0].get_text() == "95 % at most 95"


CUBE = ParameterSet(dict.fromkeys(("little", "much"), Parameter(1.0, "1")))


def figures(p: ParameterSet) -> dict[str, float]:
    value = 0.2 * p.value("little") + p.value("much")
    return dict.fromkeys(("SettlingTime", "Overshoot", "ISE", "Ripple"), value)


def test_bars_are_the_indices_and_what_is_left_out_is_said() -> None:
    with ThreadPoolExecutor(1) as executor:
        found = sensitivity(figures, CUBE, dict.fromkeys(CUBE, 0.1), count=32, executor=executor)
    picture = plot_sensitivity(found)
    panels = picture.axes
    assert [panel.get_title() for panel in panels] == ["SettlingTime", "Overshoot", "ISE"]
    assert [text.get_text() for text in panels[0].get_yticklabels()] == ["much", "little"]
    widths = [bar.get_width() for bar in panels[0].patches if isinstance(bar, Rectangle)]
    own = found.table.loc["SettlingTime"]
    assert widths == pytest.approx([*own["total"][["much", "little"]], *own["first"][["much", "little"]]])
    assert [text.get_text() for text in picture.texts] == ["3 of 4 figures"]


def test_a_third_bar_is_the_share_by_the_slope_at_a_design() -> None:
    with ThreadPoolExecutor(1) as executor:
        found = sensitivity(figures, CUBE, dict.fromkeys(CUBE, 0.1), count=32, executor=executor)
    index = pd.MultiIndex.from_product([["SettlingTime", "Overshoot"], ["little", "much"]], names=["figure", "axis"])
    shares = pd.DataFrame({"share": [0.1, 0.9, float("nan"), 0.5]}, index=index)
    panels = plot_sensitivity(found, LocalSensitivity(shares, pd.DataFrame())).axes
    widths = [[bar.get_width() for bar in panel.patches if isinstance(bar, Rectangle)][4:] for panel in panels]
    assert widths == [[0.9, 0.1], [0.5, 0.0], [0.0, 0.0]]  # "much" stands on top
    assert [text.get_text() for text in panels[0].get_yticklabels()] == ["much", "little"]


def test_panels_have_one_scale_whose_end_is_the_whole_variance_for_a_constant_too() -> None:
    with ThreadPoolExecutor(1) as executor:
        found = sensitivity(
            lambda p: {"moves": p.value("much"), "stays": 1.0},
            CUBE,
            dict.fromkeys(CUBE, 0.1),
            count=32,
            executor=executor,
        )
    ends = [panel.get_xlim() for panel in plot_sensitivity(found).axes]
    assert [low for low, _ in ends] == [0.0, 0.0]
    assert ends[0][1] >= 1.0
    assert ends[1][1] == 1.0


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


def design(before: float) -> ExperimentDesign:
    t = np.arange(100) * 0.01
    run = Trajectory(t, {"position_reference": 0.1 + 0.02 * np.sin(t), "position": 0.1 + 0.02 * np.sin(t), "force": t})
    rows = {n: {"value": v, "stderr_before": before, "stderr_after": 0.01 * v, "target": v > 1} for n, v in VALUES}
    limits = {"position": (0.0, 0.121), "force": (-500.0, 500.0)}
    units = {"position_reference": "m", "position": "m", "force": "N"}
    table = pd.DataFrame.from_dict(rows, orient="index")
    return ExperimentDesign("position_reference", (run, run), (), table, limits, {}, "", {}, units)


def x(line: Line2D) -> Array:
    return np.asarray(line.get_xdata(), dtype=np.float64)


def y(line: Line2D) -> Array:
    return np.asarray(line.get_ydata(), dtype=np.float64)


VALUES = (("friction.coulomb", 40.0), ("load.mass", 1.0))


def test_each_limited_signal_has_a_panel_and_each_parameter_a_line() -> None:
    *signals, intervals = plot_experiment(design(0.5)).axes
    assert [p.get_ylabel() for p in signals] == ["position\nreference [mm]", "position [mm]", "force [N]"]
    assert [t.get_text() for t in intervals.get_yticklabels()] == ["friction.coulomb (asked)", "load.mass"]
    dashed = [line for line in signals[1].lines if line.get_linestyle() == "--"]
    assert [y(line)[0] for line in dashed] == [121.0]  # the other limit is far away
    assert max(x(line)[-1] for line in signals[0].lines) > 1.9  # the second run
    np.testing.assert_allclose(x(intervals.lines[-1]), 1.96, rtol=1e-3)


def test_without_logs_in_hand_there_is_no_interval_before() -> None:
    *_, intervals = plot_experiment(design(np.nan)).axes
    assert len(intervals.lines) == 1
