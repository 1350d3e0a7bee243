"""Planned experiments: their information, their limits, and whether an identification achieves what they predict."""

import functools
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.dynamics.simulate import simulate
from pneuopt.experiments import next_experiment as design_search
from pneuopt.experiments.design import AOptimal, DOptimal, ExperimentDesign, Precision, WantedPrecision
from pneuopt.experiments.next_experiment import next_experiment
from pneuopt.files.outputs import load_result
from pneuopt.identification.identify import identify
from pneuopt.logs.experiment import Experiment
from pneuopt.logs.read_log import read_log
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb, Stribeck, Viscous
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import Intersample
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.least_squares import LeastSquares

STEP, NOISE = 2e-3, {"position": 2e-5}
AXIS = ForceDrive(Stribeck())
LOOP = ClosedLoop(AXIS, PID(sample_time=STEP), measured="position")
VALUES = {"load.mass": 5.0, "friction.coulomb": 20.0, "friction.static": 30.0, "friction.stribeck_velocity": 0.02}
GAINS = {"pid.Kp": 2e4, "pid.Kd": 400.0, "pid.Tf": 5e-3, "pid.lower": -100.0, "pid.upper": 100.0, "pid.c": 0.0}
KNOWN = LOOP.parameters.with_values(VALUES | {"friction.viscous": 60.0, "friction.smoothing": 2e-3} | GAINS)
FREE = ("friction.coulomb", "friction.static", "friction.stribeck_velocity", "friction.viscous")
LIMITS = {"position": (0.05, 0.15), "speed": (-0.4, 0.4), "force": (-60.0, 60.0)}


@functools.cache
def design() -> ExperimentDesign:
    return next_experiment(
        LOOP,
        KNOWN.freed(*FREE),
        duration=3.0,
        limits=LIMITS,
        noise=NOISE,
        plants={},
        cpu_seconds=3,
        criterion=DOptimal(),
    )


def log_of(reference: Array, seed: int = 1) -> Experiment:
    """The log of a run by the tight simulation, which shares no integrator with the design."""
    t = STEP * np.arange(len(reference))
    start = LOOP.initial(KNOWN, reference=float(reference[0]))
    run = simulate(LOOP, Trajectory(t, {"reference": reference}), KNOWN, initial=start)
    noisy = run["position"] + NOISE["position"] * np.random.default_rng(seed).standard_normal(len(t))
    log = Experiment(Trajectory(t, {"force": run["control"], "position": noisy}), NOISE, name="run")
    return log.with_intersample({"force": Intersample.HELD})  # it is the drive's command


def test_its_information_is_that_of_finite_differences_in_a_plain_simulation() -> None:
    drive = ForceDrive(Viscous())
    known = drive.parameters.with_values({"load.mass": 2.0, "friction.viscous": 30.0})
    limits = {"position": (-0.05, 0.05), "force": (-20.0, 20.0)}
    found = next_experiment(
        drive,
        known.freed("load.mass", "friction.viscous"),
        duration=0.6,
        sample_time=STEP,
        limits=limits,
        noise={"position": 1e-4},
        cpu_seconds=2.0,
    )
    force, h = found.excitation["force"], STEP

    def rates(_: float, z: Array, push: float, mass: float, viscous: float) -> Array:
        return np.array([z[1], (push - viscous * z[1]) / mass])

    def positions(theta: Array) -> Array:
        mass, viscous, x, out = theta[0], theta[1], theta[2:].copy(), []
        for push in force:
            out.append(x[0])
            x = solve_ivp(rates, (0.0, h), x, args=(push, mass, viscous), rtol=1e-11, atol=1e-13).y[:, -1]
        return np.array(out)

    theta, size = np.array([2.0, 30.0, 0.0, 0.0]), np.array([2e-3, 3e-2, 1e-5, 1e-4])
    slopes = [(positions(theta + s) - positions(theta - s)) / (2 * s.max()) for s in np.diag(size)]
    covariance = np.linalg.inv(np.array(slopes) @ np.array(slopes).T) * 1e-4**2
    expected = np.sqrt(np.diag(covariance))[:2]
    np.testing.assert_allclose(found.table["stderr_alone"].to_numpy(dtype=float), expected, rtol=0.02)


def test_every_limit_is_kept_at_every_sample() -> None:
    run = simulate(
        LOOP,
        Trajectory(design().runs[0].t, {"reference": design().excitation["position_reference"]}),
        KNOWN,
        initial=LOOP.initial(KNOWN, reference=0.1),
    )
    for name, (low, high) in LIMITS.items():
        values, room = run["control" if name == "force" else name], 1e-3 * (high - low)
        assert low - room <= values.min()
        assert values.max() <= high + room
        assert design().room[name] <= 0


def test_a_design_tells_more_than_steps_and_a_fit_achieves_what_it_predicts() -> None:
    steps = 0.1 + 0.04 * np.sign(np.sin(2 * np.pi * np.arange(1500) * STEP / 1.5))
    asked = KNOWN.select(AXIS.parameters).freed(*FREE)
    planned = identify(AXIS, log_of(design().excitation["position_reference"]), asked)
    usual = identify(AXIS, log_of(steps), asked)
    narrower = usual.estimates["stderr"] / planned.estimates["stderr"]
    assert float(np.exp(np.log(narrower).mean())) > 1.25
    compared = design().compare(planned, alone=True)
    assert compared["ratio"].between(0.9, 1.1).all(), compared
    assert (compared["shift"].abs() < 4).all(), compared


def test_a_width_that_nobody_has_stated_counts_as_the_fit_counts_it() -> None:
    """Designed as if it were known, a run achieved deviations four times as large as predicted."""
    axis = ForceDrive(Coulomb())
    loop, free = ClosedLoop(axis, PID(sample_time=STEP), measured="position"), ("friction.coulomb", "friction.viscous")
    known = loop.parameters.with_values({n: v for n, v in (VALUES | GAINS).items() if n in loop.parameters})
    given: dict[str, Any] = {"duration": 2.0, "limits": LIMITS, "noise": NOISE, "plants": {}, "cpu_seconds": 1}
    found = next_experiment(loop, known.freed(*free), **given)
    assert tuple(found.table.index) == free
    start = loop.initial(known, reference=0.1)
    wanted = Trajectory(found.runs[0].t, {"reference": found.excitation["position_reference"]})
    run, rng = simulate(loop, wanted, known, initial=start), np.random.default_rng(1)
    noisy = run["position"] + NOISE["position"] * rng.standard_normal(len(run))
    log = Experiment(Trajectory(run.t, {"force": run["control"], "position": noisy}), NOISE, name="run")
    asked = known.select(axis.parameters).freed(*free)
    compared = found.compare(identify(axis, log.with_intersample({"force": Intersample.HELD}), asked), alone=True)
    assert compared["ratio"].between(0.9, 1.1).all(), compared


def test_an_exact_model_of_a_log_that_often_turns_is_not_taken_for_a_wrong_one() -> None:
    """A third of the designs made such logs: the fit gave noise to the states, and had not tried tight gaps."""
    t = STEP * np.arange(750)
    turning = 0.1 + 0.021 * np.sin(2 * np.pi * 1.5 * t) + 0.009 * np.sin(2 * np.pi * 8 * t)
    fit = identify(AXIS, log_of(turning), KNOWN.select(AXIS.parameters).freed(*FREE))
    assert "does not explain" not in fit.status.message
    assert fit.stats["gap_deviation"] == LeastSquares().stages[-1].gap
    found = fit.estimates
    truth = np.array([KNOWN.value(n) for n in found.index])
    assert ((found["value"] - truth).abs() < 4 * found["stderr"]).all(), found
    assert (found["stderr"] < 0.1 * truth).all()


def test_a_search_that_begins_with_a_part_of_the_run_ends_no_worse_than_one_of_the_whole(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def planned(repeats: int) -> ExperimentDesign:
        monkeypatch.setattr(design_search, "MOST_REPEATS", repeats)
        return next_experiment(
            *(LOOP, KNOWN.freed(*FREE)), duration=3.4, limits=LIMITS, noise=NOISE, plants={}, cpu_seconds=1e-6
        )

    whole, parts = planned(1), planned(4)
    assert parts.stats["tried"] > whole.stats["tried"]
    assert parts.stats["after"] <= whole.stats["after"] * (1 + 1e-9)
    assert len(parts.runs[0].t) == 1700
    assert all(room <= 0 for room in parts.room.values())


def test_what_a_fit_knows_counts_and_its_noise_is_taken() -> None:
    steps = 0.1 + 0.04 * np.sign(np.sin(2 * np.pi * np.arange(1500) * STEP / 1.5))
    fit = identify(AXIS, log_of(steps), KNOWN.select(AXIS.parameters).freed(*FREE))
    own = fit.parameters | KNOWN.select(n for n in KNOWN if n.startswith("pid."))
    found = next_experiment(
        LOOP, own, duration=1.0, limits=LIMITS, fit=fit, criterion=Precision("friction.static"), cpu_seconds=3.0
    )
    table = found.table
    np.testing.assert_allclose(table["stderr_before"], fit.estimates["stderr"][table.index], rtol=1e-6)
    assert (table["stderr_after"] < table["stderr_before"]).all()
    assert found.stats["plants"] == 3
    assert "narrower" in str(found)


def test_several_runs_tell_more_than_one_and_are_written_each(tmp_path: Path) -> None:
    def planned(runs: int) -> ExperimentDesign:
        return next_experiment(
            *(LOOP, KNOWN.freed(*FREE)),
            duration=1.0, limits=LIMITS, noise=NOISE, runs=runs, criterion=AOptimal("friction.*"), cpu_seconds=1e-6,
        )  # fmt: skip

    one, two = planned(1), planned(2)
    assert two.stats["after"] < one.stats["after"]
    files = two.write_csv(tmp_path / "run.csv")
    assert [f.name for f in files] == ["run_1.csv", "run_2.csv"]
    assert files[0].read_text().startswith("time [s],position_reference [m]\n")
    np.testing.assert_allclose(read_log(files[1]).trajectory["position_reference"], two.runs[1]["position_reference"])
    with pytest.raises(InputError, match="2 runs are planned"):
        _ = two.excitation


def test_a_design_is_saved_whole_and_reproduced(tmp_path: Path) -> None:
    def planned() -> ExperimentDesign:
        return next_experiment(
            LOOP, KNOWN.freed(*FREE), duration=0.2, limits=LIMITS, noise=NOISE, cpu_seconds=600, plants={}
        )

    first = planned()
    first.save(tmp_path / "design.json")
    assert str(load_result(tmp_path / "design.json")) == str(first) == str(planned())


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"limits": {"speed": (-1.0, 1.0)}}, "limits: give the least and greatest value of 'position_reference'"),
        ({"limits": LIMITS | {"sped": (0.0, 1.0)}}, "unknown signal 'sped'; did you mean 'speed'"),
        ({"limits": LIMITS | {"speed": (1.0, 0.0)}}, "limits: speed: the least value must lie below"),
        (
            {"limits": LIMITS | {"force": (1.0, 2.0)}},
            "no excitation keeps 'force': under the gentlest one, it moves from",
        ),
        ({"noise": None}, "noise: give the standard deviation of each output"),
        ({"noise": {"position": 0.0}}, "noise: that of position must be positive"),
        ({"noise": {"force": 1.0}}, "unknown output 'force'"),
        ({"duration": 0.01}, "duration = 0.01 s: with a sample every 0.002 s it may be 0.2 to 2000 s"),
        ({"runs": 0}, "runs = 0: plan one at least"),
        ({"sample_time": 1e-3}, "the loop's controller acts every 0.002 s"),
        ({"criterion": Precision("load.mass")}, "criterion: load.mass is not free"),
        ({"criterion": WantedPrecision({"load.mass": 0.01})}, "criterion: load.mass is not free"),
        ({"criterion": DOptimal("friction.sigma0")}, "unknown parameter 'friction.sigma0'"),
        ({"plants": -1}, "plants = -1"),
        ({"start": {"angle": 1.0}}, "start: unknown output 'angle'"),
        ({"cpu_seconds": 0.0}, "cpu_seconds must be positive"),
    ],
)
def test_what_cannot_be_planned_is_refused_with_a_remedy(given: dict[str, Any], message: str) -> None:
    usual: dict[str, Any] = {"duration": 0.5, "limits": LIMITS, "noise": NOISE, "cpu_seconds": 1.0}
    with pytest.raises(InputError, match=re.escape(message)):
        next_experiment(LOOP, KNOWN.freed(*FREE), **(usual | given))


def test_nothing_free_is_refused() -> None:
    with pytest.raises(InputError, match="no parameter of the plant is free"):
        next_experiment(LOOP, KNOWN, duration=0.5, limits=LIMITS, noise=NOISE)


def test_the_precision_that_is_wanted_decides_which_parameter_counts() -> None:
    def planned(coulomb: float, viscous: float) -> ExperimentDesign:
        wanted = WantedPrecision({"friction.coulomb": coulomb, "friction.viscous": viscous})
        return next_experiment(
            *(LOOP, KNOWN.freed(*FREE)), duration=0.3, limits=LIMITS, noise=NOISE, cpu_seconds=1, plants={},
            criterion=wanted,
        )  # fmt: skip

    of_coulomb, of_viscous = (planned(*wanted).table["stderr_alone"] for wanted in ((1e-5, 1.0), (1.0, 1e-5)))
    assert of_coulomb["friction.coulomb"] < of_viscous["friction.coulomb"]
    assert of_viscous["friction.viscous"] < of_coulomb["friction.viscous"]


@pytest.mark.parametrize("wanted", [{}, {"load.mass": 0.0}, {"load.mass": float("nan")}])
def test_a_wanted_precision_is_positive(wanted: dict[str, float]) -> None:
    with pytest.raises(InputError, match="WantedPrecision"):
        WantedPrecision(wanted)


def test_what_no_run_tells_is_said() -> None:
    """In open loop with the force of a stuck axis, viscous friction and mass stay out of sight."""
    found = next_experiment(
        AXIS,
        KNOWN.freed("friction.viscous"),
        duration=0.4,
        sample_time=STEP,
        limits={"force": (-1e-3, 1e-3), "position": (-0.1, 0.1)},
        noise={"position": 1e-3},
        cpu_seconds=1.0,
    )
    assert found.unidentifiable == ("friction.viscous",)
    assert "does not identify friction.viscous" in str(found)
