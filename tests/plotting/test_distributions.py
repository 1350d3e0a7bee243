"""The figure of a study's cases: which share keeps a bound."""

import numpy as np
import pandas as pd
import pytest

from pneuopt.plotting import plot_distribution
from pneuopt.quantities.errors import InputError

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


def test_a_column_that_is_not_there_is_refused() -> None:
    with pytest.raises(InputError, match="Overshot"):
        plot_distribution(TABLE, {"Overshot": "%"})
