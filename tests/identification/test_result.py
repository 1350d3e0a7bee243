""""""

import math

import numpy as np
import pandas as pd

from pneuopt.identification.result import (
    missing_excitation,
    remedy,
    report_agreement,
    report_estimates,
    summarise_motion,
)
from pneuopt.logs.experiment import Experiment
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Asymmetric, LuGre
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.trajectories import Trajectory


def test_open_ends_and_what_is_unidentifiable_are_no_numbers() -> None:
    none = math.nan
    rows = {
        "a.open": (2.0, none, 1.5, math.inf, 0.0, "widened", ""),
        "b.blind": (7.0, none, -math.inf, math.inf, none, "unidentifiable", "unidentifiable"),
        "c.missed": (7.0, none, none, none, 1.4, "bias possible", ""),
        "d.pressed": (7.0, none, none, none, none, "bias possible", "at its bound"),
        "e.early": (7.0, none, none, none, none, "bias possible", ""),
        "f.far": (7.0, none, none, none, 8.0, "bias possible", ""),
    }
    columns = ["value", "stderr", "ci_low", "ci_high", "bias", "mark", "note"]
    table = pd.DataFrame.from_dict(rows, orient="index", columns=columns).assign(unit="N")
    shown = [line.split() for line in report_estimates(table).to_text(80).splitlines()[-6:]]
    assert shown == [
        ["a.open", "2", "above", "1.5", "N"],
        ["b.blind", "-", "not", "determined", "N", "unidentifiable"],
        ["c.missed", "7", "not", "determined", "N", "bias", "<=", "20", "%"],
        ["d.pressed", "7", "not", "determined", "N", "at", "its", "bound"],
        ["e.early", "7", "not", "determined", "N", "bias", "possible"],
        ["f.far", "7", "not", "determined", "N", "bias", "possible"],
    ]


def test_marks_fit_a_terminal_of_80_columns() -> None:
    row = [0.020014, 2.8e-5, 0.019958, 0.02007, 0.0062, "bias possible", "", "m/s"]
    columns = ["value", "stderr", "ci_low", "ci_high", "bias", "mark", "note", "unit"]
    table = pd.DataFrame([row], index=["friction.stribeck_velocity"], columns=columns)
    lines = report_estimates(table).to_text(80).splitlines()
    assert max(map(len, lines)) <= 80
    words = ["friction.stribeck_velocity", "0.020014", "0.019958 to 0.020070", "m/s", "bias <= 31 %"]
    assert sum(all(word in line for word in words) for line in lines) == 1


def test_many_logs_are_shown_in_short() -> None:
    rows = [
        {
            "log": f"run@{k}",
            "channel": "position",
            "nrmse": 1e-3 * k,
            "free_run_nrmse": 2e-3 * k,
            "rmse": 1e-6,
            "unit": "m",
        }
        for k in range(13)
    ]
    out = report_agreement(pd.DataFrame(rows).set_index(["log", "channel"])).to_text(80)
    assert "median" in out
    assert out.count("@") == 1
    assert [word for word in out.splitlines()[-1].split() if word in {"0.6", "1.2", "2.4"}] == ["0.6", "1.2", "2.4"]


VALUES = ForceDrive(LuGre()).parameters  # 5 kg, 30 N, Stribeck velocity 20 mm/s
HINTS = ForceDrive(Asymmetric(LuGre())).system().identification_hints
T = np.arange(0, 4, 1e-3)


def seen(speed: Array) -> Experiment:
    return Experiment(Trajectory(T, {"speed": speed}), name="log")


def test_a_sine_excites_everything() -> None:
    found = summarise_motion([seen(0.3 * np.sin(2 * np.pi * T))], {}, VALUES, VALUES)
    assert found is not None
    assert 0.45 < found.forward < 0.55
    assert 6 <= found.reversals <= 8
    assert abs(found.acceleration - 0.3 * 2 * np.pi / np.sqrt(2)) < 0.1
    free = [f"friction.{n}" for n in ("coulomb", "static", "viscous", "stribeck_velocity", "bristle_stiffness")]
    assert all(missing_excitation(HINTS, name, [*free, "load.mass", "load.force"], found) is None for name in free)


def test_what_is_lacking_counts_only_where_it_confuses() -> None:
    found = summarise_motion([seen(np.full(T.size, 0.2))], {}, VALUES, VALUES)
    both = ["friction.coulomb", "friction.viscous", "load.force"]
    for name, words in (("friction.viscous", "too near for a slope"), ("load.force", "moves forwards only")):
        lack = missing_excitation(HINTS, name, both, found)
        assert lack is not None
        assert words in lack[0]
    assert missing_excitation(HINTS, "friction.viscous", ["friction.viscous"], found) is None
    assert missing_excitation(HINTS, "load.force[run 1]", ["load.force[run 1]"], found) is None
    assert missing_excitation(HINTS, "valve.leak", ["valve.leak"], found) is None
    bristle = missing_excitation(HINTS, "friction.bristle_damping", ["friction.bristle_damping"], found)
    assert bristle is not None
    assert bristle[0].startswith("the motion never reverses")
    assert missing_excitation(HINTS, "load.mass", ["load.mass"], found) is not None


def test_states_stand_in_for_a_speed_that_is_not_logged() -> None:
    log = Experiment(Trajectory(T, {"position": T}), name="log")
    assert summarise_motion([log], {}, VALUES, VALUES) is None
    found = summarise_motion([log], {"log": Trajectory(T, {"speed": np.full(T.size, -0.1)})}, VALUES, VALUES)
    assert found is not None
    assert found.forward == 0
    assert missing_excitation(HINTS, "friction.viscous", ["friction.viscous", "friction.coulomb"], None) is None


def test_the_remedy_suits_the_pair() -> None:
    assert "turn the axis round" in remedy(HINTS, ["load.force[a]", "friction.coulomb_asymmetry"])
    assert "beyond 5 times the stribeck velocity" in remedy(HINTS, ["friction.coulomb", "friction.viscous"])
    assert "slow ramps" in remedy(HINTS, ["friction.static", "friction.stribeck_velocity"])
    assert remedy(HINTS, ["rig.area"]) == "fix it, or log a run that moves differently"
    assert remedy(HINTS, ["rig.area", "rig.area_bias"]).startswith("fix one of them")
