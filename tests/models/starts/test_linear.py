import numpy as np
import pytest

from pneuopt.dynamics.hooks import Log
from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import System, names
from pneuopt.models.friction import Coulomb
from pneuopt.models.linear import FirstOrder, Integrator, Plant, SecondOrder
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import LogError
from pneuopt.quantities.trajectories import Trajectory


def steps(t: Array, levels: tuple[float, ...]) -> Array:
    k = np.minimum((t / t[-1] * len(levels)).astype(int), len(levels) - 1)
    values: Array = np.array(levels)[k]
    return values


def logged(
    system: System, values: dict[str, float], levels: tuple[float, ...], seed: int = 0, begin: float = 0.0
) -> Log:
    """A generated log: 3 s at 1 kHz, noise of 0.5 % of the largest output."""
    t = np.linspace(0.0, 3.0, 3001)
    truth = system.parameters.with_values(values)
    run = simulate(system, Trajectory(t + begin, {"valve_voltage": steps(t, levels)}), truth)
    noise = 0.005 * np.abs(run["speed"]).max() * np.random.default_rng(seed).normal(size=len(t))
    channels = {"valve_voltage": steps(t, levels), "speed": run["speed"] + noise}
    return Log(Trajectory(t + begin, channels), system.parameters.freed("plant.*"))


SECOND = {"plant.gain": -0.12, "plant.natural_frequency": 22.0, "plant.damping": 0.35}
CASES: list[tuple[Plant, dict[str, float]]] = [
    (FirstOrder(), {"plant.gain": 0.4, "plant.time_constant": 0.13}),
    (FirstOrder(pade_order=3), {"plant.gain": 0.4, "plant.time_constant": 0.13, "plant.dead_time": 0.06}),
    (SecondOrder(), SECOND),
    (SecondOrder(pade_order=3), SECOND | {"plant.dead_time": 0.03}),
    (SecondOrder(), {"plant.gain": 2.0, "plant.natural_frequency": 8.0, "plant.damping": 1.9}),
    (Integrator(pade_order=2), {"plant.gain": 0.7, "plant.dead_time": 0.05}),
]


@pytest.mark.parametrize(("plant", "values"), CASES)
def test_the_first_candidate_is_near_the_truth_without_a_guess(plant: Plant, values: dict[str, float]) -> None:
    system = plant.system()
    first = system.starts({"run": logged(system, values, (0.0, 2.0, -1.0, 1.0))})[0]
    assert set(first.parameters) == set(values)
    for name, value in values.items():
        assert first.parameters[name] == pytest.approx(value, rel=0.06 if name == "plant.dead_time" else 0.02), name
    assert set(names(system.states)) <= set(first.states["run"].names)


def test_the_states_along_the_log_are_those_of_the_model() -> None:
    system = SecondOrder(pade_order=2).system()
    log = logged(system, SECOND | {"plant.dead_time": 0.02}, (0.0, 2.0, -1.0), begin=50.0)
    states = system.starts({"run": log})[0].states["run"]
    assert np.array_equal(states.t, log.measured.t)
    assert np.std(states["speed"] - log.measured["speed"]) < 0.012 * np.abs(log.measured["speed"]).max()


@pytest.mark.parametrize("order", [1, 2, 3, 5])
def test_the_delay_line_along_the_log_is_that_of_the_model(order: int) -> None:
    """At rest along the log it would say that nothing measured depends on the dead time."""
    system = SecondOrder(pade_order=order).system()
    log = logged(system, SECOND | {"plant.dead_time": 0.05}, (0.0, 2.0, -1.0))
    start = system.starts({"run": log})[0]
    given = system.parameters.with_values(start.parameters)
    run = simulate(system, log.measured.select(["valve_voltage"]), given)
    for name in (n for n in names(system.states) if "delay" in n):
        assert start.states["run"][name] == pytest.approx(run[name], abs=0.02), name


def test_several_logs_are_joined_and_need_not_begin_at_rest() -> None:
    system = SecondOrder().system()
    whole = logged(system, SECOND, (0.0, 2.0, -1.0, 1.0, 0.5, 0.0))
    parts = {n: Log(whole.measured.rows(a, b), whole.parameters) for n, a, b in (("a", 600, 1500), ("b", 1400, 2900))}
    start = system.starts(parts)[0]
    assert set(start.states) == {"a", "b"}
    assert start.parameters == pytest.approx(SECOND, rel=0.02)


def test_friction_is_found_beside_the_plant() -> None:
    system = SecondOrder(friction=Coulomb()).system()
    values = {"plant.gain": 0.2, "plant.natural_frequency": 12.0, "plant.damping": 0.8, "friction.coulomb": 0.4}
    log = logged(system, values, (0.0, 2.0, -1.5, 3.0, -2.0))
    start = system.starts({"run": Log(log.measured, log.parameters.freed("friction.coulomb"))})[0]
    assert start.parameters == pytest.approx(values, rel=0.05)


def test_fixed_values_stay_and_missing_samples_do_not_matter() -> None:
    system = SecondOrder().system()
    log = logged(system, SECOND, (0.0, 2.0, -1.0))
    holes = np.array(log.measured["speed"])
    holes[500:520] = np.nan
    known = log.parameters.with_values({"plant.gain": -0.12}).fixed("plant.gain")
    start = system.starts({"run": Log(log.measured.with_columns({"speed": holes}), known)})[0]
    assert "plant.gain" not in start.parameters
    assert start.parameters["plant.natural_frequency"] == pytest.approx(22.0, rel=0.02)


def test_logs_that_tell_nothing_are_refused() -> None:
    system = FirstOrder().system()
    t = np.linspace(0.0, 1.0, 101)
    still = Trajectory(t, {"valve_voltage": np.ones(101), "speed": np.zeros(101)})
    with pytest.raises(LogError, match="valve_voltage never changes"):
        system.starts({"run": Log(still, system.parameters.freed("plant.*"))})
    with pytest.raises(LogError, match=r"run: 10 samples of valve_voltage and speed are too few"):
        system.starts({"run": Log(still.rows(0, 10), system.parameters.freed("plant.*"))})


@pytest.mark.parametrize("dead", [0.02, 0.0])
def test_a_dead_time_may_have_a_lower_bound_of_zero(dead: float) -> None:
    """The model of a delay divides by it, and the candidates are told apart by their logarithms."""
    system = FirstOrder(pade_order=2).system()
    log = logged(FirstOrder().system(), {"plant.gain": 0.4, "plant.time_constant": 0.13}, (0.0, 2.0, -1.0, 1.0))
    late = np.interp(log.measured.t - dead, log.measured.t, log.measured["speed"])
    free = system.parameters.with_bounds({"plant.dead_time": (0.0, 1.0)}).freed("plant.*")
    starts = system.starts({"run": Log(log.measured.with_columns({"speed": late}), free)})
    assert all(start.parameters["plant.dead_time"] > 0 for start in starts)
    assert starts[0].parameters["plant.dead_time"] == pytest.approx(dead, abs=2e-3)
