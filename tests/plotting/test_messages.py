"""What is said of what cannot be drawn: what triggers each message, and its words."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from pneuopt.logs.doctor import examine
from pneuopt.models.drives import FORCE
from pneuopt.models.linear import FirstOrder
from pneuopt.plotting import (
    plot_correlation,
    plot_distribution,
    plot_finding,
    plot_friction,
    plot_loop,
    plot_map,
    plot_prediction,
    plot_residuals,
    plot_steps,
    save_figure,
)
from pneuopt.quantities.errors import InputError
from tests.logs.bad_logs import BAD_LOGS
from tests.plotting.fits import TRUTH, fit_of, fitted

TABLE = pd.DataFrame({"load.mass": [2.0], "supply.pressure": 5.0, "SettlingTime": 0.1, "Overshoot": 2.0, "error": ""})
EXPERIMENT, RUN = fitted()
NO_LOOP: Any = FORCE
REFUSALS: dict[str, tuple[Callable[[], object], str]] = {
    "runs without logs": (lambda: plot_prediction([RUN] * 2, [EXPERIMENT], label=""), "2 runs do not match 1 exp"),
    "logs without runs": (lambda: plot_residuals([RUN], [EXPERIMENT] * 2), "1 runs do not match 2 experiments"),
    "no correlation": (
        lambda: plot_correlation(fit_of(TRUTH, {}, pd.DataFrame([[np.nan]], index=["a"], columns=["a"]))),
        "no estimate has a standard deviation",
    ),
    "no friction": (
        lambda: plot_friction(FirstOrder().system(), fit_of(TRUTH, {}), [EXPERIMENT]),
        "a friction map is drawn for",
    ),
    "finding without signals": (
        lambda: plot_finding(replace(examine(BAD_LOGS["work"])[0], evidence=None)),
        "the finding 'work' has no signals to be drawn",
    ),
    "no response": (lambda: plot_steps([]), "no response"),
    "no loop": (lambda: plot_loop(NO_LOOP), "ClosedLoop"),
    "three axes": (
        lambda: plot_map(TABLE, dict.fromkeys(("load.mass", "supply.pressure", "Overshoot"), "1"), {"Overshoot": "%"}),
        "one or two axes, this has 3",
    ),
    "no metric": (lambda: plot_map(TABLE, {"load.mass": "kg"}, {}), "no metric"),
    "unknown metric": (
        lambda: plot_map(TABLE, {"load.mass": "kg"}, {"SetlingTime": "s"}),
        "unknown column 'SetlingTime'; did you mean 'SettlingTime'",
    ),
    "unknown column": (lambda: plot_distribution(TABLE, {"Overshot": "%"}), "Overshot"),
    "unknown suffix": (
        lambda: save_figure(Figure(), "bode.jpg"),
        r"bode\.jpg: a figure is written as \.png, \.pdf, \.svg; name it so",
    ),
    "no folder": (lambda: save_figure(Figure(), "none/bode.png"), "the folder does not exist"),
}


@pytest.mark.parametrize("name", REFUSALS)
def test_a_refusal_says_what_is_wrong_and_what_to_do(name: str) -> None:
    cause, words = REFUSALS[name]
    with pytest.raises(InputError, match=words):
        cause()
