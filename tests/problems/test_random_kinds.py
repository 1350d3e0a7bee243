"""The matrix exponential beside the certificate's simulation, and what the study calls a fault."""

import numpy as np
import pytest

import pneuopt as po
from problems.shared.plain_linear import respond_plainly
from problems.tune.random_kinds import HORIZONS, KINDS, find_faults, main

LINEAR = ("dead_time", "integrator", "light_damping", "load", "sampled_delay", "unstable")


@pytest.mark.parametrize("kind", LINEAR)
def test_the_matrix_exponential_and_the_certificate_see_one_response(kind: str) -> None:
    given = KINDS[kind](np.random.default_rng((5, LINEAR.index(kind))))
    (step,), plant = given.steps, given.plant
    gains = {n: plant.parameters.value(f"pid.{n}") for n in ("Kp", "Ki", "Kd", "Tf", "b", "c")}
    gains["Kd"] = 0.1 * plant.parameters["pid.Kd"].upper
    pid, load = plant.loop.pid, step.disturbance.get("valve_voltage", 0.0)
    assert given.plain is not None
    sampled = (pid.sample_time or 0.0, pid.delay)
    t, y = respond_plainly(given.plain, gains, step.final, load, (step.horizon, 1), sampled)
    tight = po.respond(plant.loop, step, plant.parameters.with_values({"pid.Kd": gains["Kd"]}))
    theirs = np.interp(t, tight.t, tight[plant.loop.feedback.name])
    assert np.ptp(theirs) > 0.1 * abs(step.nominal_size)
    late = plant.parameters.value("plant.dead_time") if "plant.dead_time" in plant.parameters else 0.0
    after = t >= step.at + 3 * late  # before, the certificate's approximant of the delay ripples
    np.testing.assert_allclose(y[after], theirs[after], atol=3e-4 * abs(step.nominal_size))
    np.testing.assert_allclose(y, theirs, atol=0.02 * abs(step.nominal_size))


def test_faults_are_named() -> None:
    step, t = po.Step(1.0), np.linspace(0.0, HORIZONS, 5001)
    calm = -np.exp(-t / 0.1)
    settled = 0.1 * np.log(50)
    wrong, deviation = find_faults(t, calm, step, settled)
    assert wrong == []
    assert deviation < 2e-3
    assert "leaves the band" in find_faults(t, calm, step, 0.9 * settled)[0][0]
    growing = 1e-3 * np.exp(t) * np.sin(30 * t)
    assert find_faults(t, growing, step, 0.1)[0][-1] == "does not stay at the reference"
    assert find_faults(t, calm + 2.0 * (t < 0.01), step, settled)[0][-1].startswith("peak")
    load = po.Step(0.0, disturbance={"valve_voltage": 1.0}, scale=1.0)
    assert find_faults(t, calm, load, settled)[0] == ["peak 100 %"]


def test_a_wrong_refusal_and_a_violation_fail_their_bounds() -> None:
    import pandas as pd

    good = {"kind": "load", "outcome": "solved", "violations": 0, "feasible": 0, "deviation": 1e-4, "cpu": 1.0}
    rows = main(pd.DataFrame([good, {**good, "violations": 1}, {**good, "outcome": "refused", "feasible": 1}]))
    broken = rows[~rows["holds"].astype(bool)]["name"].tolist()
    assert broken == ["load.violations", "load.refused_wrongly"]
