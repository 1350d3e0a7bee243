"""Models from and to python-control: the same plant, the same margins."""

import sys

import control
import numpy as np
import pytest

import pneuopt as po
from pneuopt.control.linear_loop import linear_plant, open_loop
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.dynamics.python_control import from_control, to_control
from pneuopt.dynamics.system import System
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.margins import frequency_response, margins
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import Quantity

VOLTAGE, SPEED = Quantity("valve_voltage", "V"), Quantity("speed", "m/s")
GAINS = {"pid.Kp": 0.4, "pid.Ki": 2.0, "pid.Kd": 0.02, "pid.Tf": 1e-3}
EQ16 = control.tf([1270.12], [1, 17.5, 86.34])


def test_margins_of_an_open_loop_are_those_of_python_control(second_order: System) -> None:
    loop = ClosedLoop(second_order, PID())
    linear = open_loop(loop, loop.parameters.with_values(GAINS))
    ours, theirs = margins(linear), control.stability_margins(to_control(linear))
    assert ours.phase_margin == pytest.approx(theirs[1], rel=1e-6)
    assert 1 / ours.max_sensitivity == pytest.approx(theirs[2], rel=1e-6)


@pytest.mark.parametrize("h", [1e-3, 5e-3])
def test_a_sampled_open_loop_is_sampled_there(second_order: System, h: float) -> None:
    loop = ClosedLoop(second_order, PID(sample_time=h, delay=1))
    linear = open_loop(loop, loop.parameters.with_values(GAINS))
    theirs, w = to_control(linear), np.geomspace(0.1, 0.99 * np.pi / h, 50)
    assert theirs.dt == h
    np.testing.assert_allclose(theirs(np.exp(1j * w * h)), frequency_response(linear, w), rtol=1e-7)
    dense = np.geomspace(0.1, 0.999 * np.pi / h, 4000)
    _, phase_margin, vector_margin, *_ = control.stability_margins(control.frd(theirs, dense, smooth=True))
    ours = margins(linear)
    assert ours.phase_margin == pytest.approx(phase_margin, abs=0.02)
    assert 1 / ours.max_sensitivity == pytest.approx(vector_margin, rel=1e-3)


def test_names_go_along(second_order: System) -> None:
    loop = ClosedLoop(second_order, PID())
    found = to_control(open_loop(loop, loop.parameters))
    assert (found.input_labels, found.output_labels) == (["error"], ["speed"])
    assert found.state_labels[:2] == ["speed", "acceleration"]
    assert all("." not in name for name in found.state_labels)


@pytest.mark.parametrize("model", [EQ16, control.ss(EQ16)])
def test_a_plant_comes_back_as_it_went(model: control.lti.LTI) -> None:
    loop = ClosedLoop(from_control(model, [VOLTAGE], [SPEED]), PID())
    back = control.tf(to_control(linear_plant(loop, loop.parameters)))
    s = 1j * np.logspace(-1, 4, 20)
    assert back(s) == pytest.approx(EQ16(s), rel=1e-9)


def test_a_plant_from_python_control_is_evaluated_as_ours(second_order: System) -> None:
    step = Step(0.2, horizon=2.0)
    ours, theirs = (
        evaluate(loop, step, loop.parameters.with_values(GAINS))
        for loop in (ClosedLoop(p, PID()) for p in (second_order, from_control(EQ16, [VOLTAGE], [SPEED])))
    )
    for metric in ("SettlingTime", "Overshoot", "PeakControl", "MaxSensitivity", "PhaseMargin"):
        assert theirs.loc[metric].iloc[0] == pytest.approx(ours.loc[metric].iloc[0], rel=1e-5), metric


def test_several_signals_and_a_feedthrough() -> None:
    A, B, C, D = (
        [[-1.0, 0.5], [0.0, -2.0]],
        [[1.0, 0.0], [0.0, 3.0]],
        [[1.0, 0.0], [0.0, 1.0]],
        [[0.0, 1.0], [0.0, 0.0]],
    )
    inputs, outputs = [Quantity(n, "V") for n in "ab"], [Quantity(n, "m") for n in "cd"]
    plant = from_control(control.ss(A, B, C, D), inputs, outputs)
    found = plant.linearise(np.zeros(2), {"a": 0.0, "b": 0.0}, plant.parameters.with_values({"plant.gain": 2.0}))
    assert found.A.tolist() == A
    assert found.B.tolist() == B
    assert found.C.tolist() == (2 * np.array(C)).tolist()
    assert found.D.tolist() == (2 * np.array(D)).tolist()


@pytest.mark.parametrize(
    ("model", "said"),
    [
        (control.tf([1], [1, 1], 0.1), "the model is sampled every 0.1 s"),
        (control.tf([1, 0, 0], [1, 1]), "the model has no state-space form"),
        (control.ss([[-1.0]], [[1.0, 1.0]], [[1.0]], [[0.0, 0.0]]), "the model has 2 inputs, 1 are named"),
        ("1/(s + 1)", "a TransferFunction or StateSpace is wanted, got str"),
    ],
)
def test_what_is_no_plant_is_refused(model: object, said: str) -> None:
    with pytest.raises(InputError, match=said):
        po.from_control(model)
    with pytest.raises(InputError, match="takes a Linearisation"):
        po.to_control(model)  # type: ignore[arg-type]


def test_without_python_control_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "control", None)
    with pytest.raises(InputError, match=r"pip install pneuopt\[control\]"):
        from_control(EQ16)
