"""What several tests share."""

import os
import signal
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import casadi as ca
import hypothesis
import numpy as np
import pytest

from pneuopt.control.controller import Feedforward
from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.dynamics.compiled import compiler
from pneuopt.dynamics.compiled import compiler as library_cache
from pneuopt.dynamics.compiled import compiler as toolchain
from pneuopt.dynamics.compiled import rollout as kernels
from pneuopt.dynamics.simulate import simulate
from pneuopt.dynamics.system import Symbols, System, define
from pneuopt.models.catalog import t32
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb
from pneuopt.quantities.parameters import Intersample, Parameter, ParameterSet, Quantity
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.tuning.gradients import LinearisedProblem

# a run of CI fails for what was changed, not for the examples that chance drew; at a desk each run draws new ones
hypothesis.settings.register_profile("ci", derandomize=True, deadline=None)
hypothesis.settings.register_profile("desk", deadline=None)  # no wall-clock assertion: machines are noisy
hypothesis.settings.load_profile("ci" if os.environ.get("CI") else "desk")

# a shell has Ctrl-C ignored by what it starts in the background; tests of Ctrl-C would then wait for minutes
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

CACHES = (
    compiler.compile_library,
    compiler.warn_once,
    toolchain._packaged_compiler,
    toolchain._read_version,
    library_cache._temporary_folder,
    kernels.prepare_by_content,
)
AXIS_TRUTH = {"load.mass": 6.0, "friction.coulomb": 25.0, "friction.viscous": 40.0, "friction.smoothing": 5e-3}
DRIVE = """# my axis
[drive]
kind = "force"
[load]
mass = { value = "5 kg", lower = "1 kg", upper = "20 kg", free = true }   # weighed
[friction]
model = "coulomb"
coulomb = { value = "40 N", free = true }
viscous = { value = "10 N*s/m", free = true }
smoothing = "5 mm/s"
"""
TUNING = """# my speed loop
[pid]
sample_time = "2 ms"
Kp = { value = "100 N*s/m", lower = "10 N*s/m", upper = "600 N*s/m", free = true }   # by hand
Ki = "4000 N/m"
limits = ["-200 N", "200 N"]
[[reference]]
step = "0.2 m/s"
horizon = "0.3 s"
[minimise]
settling_time = { band = "5 %" }
[limits]
overshoot = "10 %"
"""


def _forget() -> None:
    for cache in CACHES:
        cache.cache_clear()


@pytest.fixture
def forget(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], None]]:
    """Nothing is remembered of what was built or said, before and after; call it to forget again."""
    _forget()
    yield _forget
    _forget()


@pytest.fixture
def count_calls(monkeypatch: pytest.MonkeyPatch) -> Callable[[ModuleType], list[int]]:
    """Patch a module's `compile_function` and rates; the list grows by a 1 at each call of what they make."""

    def patch(module: ModuleType) -> list[int]:
        calls = list[int]()

        def counted(compiled: Callable[[ca.Function], Any], function: ca.Function) -> Callable[..., Any]:
            call = compiled(function)

            def run(*inputs: Any) -> Any:
                calls.append(1)
                return call(*inputs)

            return run

        def counted_under_held_inputs(compiled: Callable[[ca.Function], Any], function: ca.Function) -> Any:
            hold = compiled(function)
            return lambda *given: counted(lambda _: hold(*given), function)

        for name in ("compile_function", "compile_rate"):
            monkeypatch.setattr(module, name, partial(counted, getattr(module, name)))
        if hasattr(module, "compile_held_rate"):
            patched = partial(counted_under_held_inputs, module.compile_held_rate)
            monkeypatch.setattr(module, "compile_held_rate", patched)
        return calls

    return patch


@pytest.fixture(scope="session")
def axis_truth() -> dict[str, float]:
    """What made the logs of `folder`."""
    return dict(AXIS_TRUTH)


@pytest.fixture(scope="session")
def axis_logs() -> dict[str, str]:
    """The logs of `folder`."""
    return generate_axis_logs()


def generate_axis_logs() -> dict[str, str]:
    """Two logs (ForceDrive with Coulomb friction, 20 um of noise) as text, by name."""
    system = ForceDrive(Coulomb()).system()
    texts = {}
    for seed, name in enumerate(("run_01", "run_02")):
        t = np.arange(0, 1.0, 2e-3)
        force = 60 * np.sin(2 * np.pi * 1.7 * t) + 30 * np.sin(2 * np.pi * 3.1 * t + seed)
        run = simulate(
            system,
            Trajectory(t, {"force": force}),
            system.parameters.with_values(AXIS_TRUTH),
            rtol=1e-6,
            intersample={"force": Intersample.LINEAR},
        )
        position = 1e3 * (run["position"] + 2e-5 * np.random.default_rng(seed).standard_normal(len(t)))
        rows = [f"{a:.4f},{b:.5f},{c:.5f}" for a, b, c in zip(t, force, position, strict=True)]
        texts[name] = "\n".join(["time [s],force [N],position [mm]", *rows]) + "\n"
    return texts


@pytest.fixture
def folder(tmp_path: Path, axis_logs: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where a command runs: drive.toml, tuning.toml and two logs, on a terminal of 80 columns."""
    for name, text in axis_logs.items():
        (tmp_path / f"{name}.csv").write_text(text, encoding="utf-8")
    (tmp_path / "drive.toml").write_text(DRIVE, encoding="utf-8")
    (tmp_path / "tuning.toml").write_text(TUNING, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    return tmp_path


@pytest.fixture
def second_order() -> System:
    """The paper's eq. 16, V(s)/U(s) = k/(s^2 + a1 s + a0)."""
    gain, a1, a0 = 1270.12, 17.5, 86.34
    parameters = ParameterSet(
        {"plant.k": Parameter(gain, "m/(V*s^3)"), "plant.a1": Parameter(a1, "1/s"), "plant.a0": Parameter(a0, "1/s^2")}
    )

    def rhs(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:
        jerk = p["plant.k"] * u["valve_voltage"] - p["plant.a1"] * x["acceleration"] - p["plant.a0"] * x["speed"]
        return {"speed": x["acceleration"], "acceleration": jerk}, {"speed": x["speed"]}

    states = [Quantity("speed", "m/s"), Quantity("acceleration", "m/s^2")]
    return define(states, [Quantity("valve_voltage", "V")], [Quantity("speed", "m/s")], parameters, rhs)


@pytest.fixture
def axis() -> System:
    """A mass pushed by a force against viscous friction and a constant load; a pressure as a second input."""
    parameters = ParameterSet(
        {"mass": Parameter(2.0, "kg"), "viscous": Parameter(10.0, "N*s/m"), "load": Parameter(3.0, "N")}
    )

    def rhs(t: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:
        force = u["force"] - p["load"] - p["viscous"] * x["speed"] - 1e-5 * u["pressure"]
        rates = {"position": x["speed"], "speed": force / p["mass"]}
        return rates, {"position": x["position"], "speed": x["speed"], "acceleration": force / p["mass"]}

    states = [Quantity("position", "m"), Quantity("speed", "m/s")]
    inputs = [Quantity("force", "N"), Quantity("pressure", "Pa(g)")]
    outputs = [*states, Quantity("acceleration", "m/s^2")]
    return define(states, inputs, outputs, parameters, rhs)


Run = Callable[[ClosedLoop, ParameterSet, float, float, float], tuple[np.ndarray, np.ndarray, np.ndarray]]


@pytest.fixture
def run() -> Run:
    """Step the loop at rest: run(loop, parameters, reference, h, duration) -> t, states after update, outputs."""

    def march(
        loop: ClosedLoop, parameters: ParameterSet, reference: float, h: float, duration: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        model = loop.discrete(4)
        x, u, p = (
            ca.MX.sym("x", len(model.states)),
            ca.MX.sym("u", len(model.inputs)),
            loop.parameter_vector(parameters),
        )
        t = ca.MX.sym("t")
        after, y = model.advance_sample(t, ca.MX(h), x, u, ca.MX(ca.DM(p)))
        n = round(duration / h)
        grid = h * np.arange(n)
        inputs = np.zeros((len(model.inputs), n))
        inputs[0] = reference
        sample = ca.Function("sample", [x, ca.vertcat(t, u)], [after, y])
        states, outputs = sample.mapaccum(n)(loop.initial(parameters), np.vstack([grid, inputs]))
        return grid, np.array(states).T, np.array(outputs).T

    return march


@pytest.fixture
def light_cylinder() -> tuple[ClosedLoop, ParameterSet, Step]:
    """A light body at high pressure, with gains whose command crosses the valve's dead zone within a dither period."""
    drive, hardware = t32()
    loop = ClosedLoop(drive.system(), PID(), Dither(1000 / (2 * np.pi)), feedforward=Feedforward())
    p = loop.complete(hardware).with_values(
        {"pid.Kp": 28.47, "pid.Ki": 264.7, "pid.Kd": 0.3219, "pid.Tf": 5e-4, "pid.b": 0.984, "pid.c": 0.0}
        | {"pid.Tt": 0.1, "pid.lower": -5.0, "pid.upper": 5.0, "dither.offset": -0.34}
        | {"feedforward.gain": -20.0, "feedforward.time": 0.00401}
        | {f"friction.{n}": 0.7 * hardware.value(f"friction.{n}") for n in ("coulomb", "static", "viscous")}
        | {"load.mass": 0.7 * hardware.value("load.mass"), "supply.pressure": 1.1 * hardware.value("supply.pressure")}
    )
    return loop, p, Step(0.2, horizon=0.5, start={"position": 0.05, "pressure_b": 3.5e5})


@pytest.fixture(scope="session")
def check_slopes() -> Callable[[LinearisedProblem, np.ndarray], None]:
    """The rows' derivatives at z are those of central differences; nodes that move past a kink may be off."""

    def check(posed: LinearisedProblem, z: np.ndarray) -> None:
        (point,) = posed.evaluate(z[None])
        for k in range(len(z)):
            nudge = 1e-6 * (np.arange(len(z)) == k)
            above, below = posed.evaluate(np.array([z + nudge, z - nudge]))
            off = np.abs((above.values - below.values) / 2e-6 - point.slopes[:, k])
            scale = np.abs(point.slopes[:, k]).max() + 1e-3
            assert np.quantile(off, 0.99) < 2e-3 * scale, k
            assert np.median(off) < 1e-5 * scale, k

    return check
