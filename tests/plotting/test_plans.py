"""The figure of a planned experiment: its signals within their limits, and the intervals before and after."""

import numpy as np
import pandas as pd
from matplotlib.lines import Line2D

from pneuopt.experiments.design import ExperimentDesign
from pneuopt.plotting import plot_experiment
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.trajectories import Trajectory


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
