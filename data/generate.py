"""Make the example logs of this folder: `python data/generate.py`. They are generated, not measured.

Truth is integrated by `pneuopt.simulate` (LSODA, 1e-8), or by `pneuopt.record`, event by event; a delay is exact, the
sensors add noise and are quantised.
"""

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import pneuopt as po

Array = NDArray[np.float64]
HERE = Path(__file__).parent
SEED = 20151107

STEP_RUNS = {
    "step_up_and_back": ((0.1, 2.0), (0.9, 4.0), (1.7, 0.0)),
    "step_through_zero": ((0.1, -3.0), (0.9, 2.5), (1.7, 1.0)),
    "step_held_out": ((0.1, 3.2), (0.9, -1.8), (1.7, 0.0)),
}
SPEED_NOISE, SPEED_STEP = 1e-3, 5e-4  # [m/s]

POSITION_LOOP = {"pid.Kp": 12000.0, "pid.Ki": 20000.0, "pid.Kd": 250.0, "pid.Tf": 0.002}
FORCE_RUNS = {
    "run_01": (0.15, 0.05, 0.12, 0.04, 0.16, 0.10, 0.06, 0.14),
    "run_02": (0.12, 0.10, 0.06, 0.13, 0.125, 0.07, 0.15, 0.09),
}
POSITION_NOISE, POSITION_STEP, FORCE_STEP = 5e-6, 1e-5, 1e-3  # [m], [m], [N]

SPEED_LOOP = {"pid.Kp": 1.5, "pid.Ki": 25.0, "pid.lower": -5.0, "pid.upper": 5.0}
PNEUMATIC_RUNS = {  # (speed [m/s], for [s])
    "run_01": (
        *((0.25, 0.4), (-0.25, 0.4), (0.1, 0.5), (-0.1, 0.5), (0.5, 0.25), (-0.5, 0.25), (0.03, 0.9), (-0.03, 0.9)),
        *((0.15, 0.4), (-0.3, 0.2), (0.2, 0.3), (-0.15, 0.4), (0.05, 0.6)),
    ),
    "run_02": ((0.2, 0.5), (-0.2, 0.5), (0.05, 0.8), (-0.08, 0.8), (0.4, 0.3), (-0.35, 0.3), (0.12, 0.8)),
}
COMMAND_STEP = 1e-4  # [V], of the log

ATMOSPHERE = 101325.0  # [Pa(a)], from which that rig's pressures count
OWN_SAMPLE, WIRE = 2e-3, (0.0, 10.0)  # [s], and what the wire of that rig's valve may carry [V]
OWN_LOOP = {"pid.Kp": 1.5, "pid.Ki": 25.0}
OWN_RUNS = {  # (speed [m/s], for [s]): strokes of 30 to 90 mm about the middle, some with a stop behind
    "run_01": (
        *((0.1, 0.6), (0.0, 0.4), (-0.06, 0.8), (0.25, 0.35), (-0.25, 0.35), (0.0, 0.3), (-0.04, 0.9), (0.12, 0.6)),
        *((0.0, 0.2), (-0.3, 0.25), (0.06, 0.9), (0.0, 0.3), (-0.1, 0.5), (0.35, 0.25), (-0.15, 0.5), (0.03, 0.8)),
    ),
    "run_02": ((0.15, 0.5), (0.0, 0.2), (-0.08, 0.8), (0.3, 0.25), (-0.2, 0.35), (0.05, 0.9), (0.0, 0.3), (-0.1, 0.7)),
}


def truth(rig: str) -> dict[str, Any]:
    """The generating values of a rig [SI], by parameter; and its table [rig], if it has one."""
    return tomllib.loads((HERE / rig / "truth.toml").read_text(encoding="utf-8"))


def main() -> None:
    rng = np.random.default_rng(SEED)
    for name, steps in STEP_RUNS.items():
        write(HERE / "step_rig" / f"{name}.csv", step_run(steps, rng))
    for name, levels in FORCE_RUNS.items():
        write(HERE / "force_rig" / f"{name}.csv", force_run(levels, rng))
    for seed, (name, speeds) in enumerate(PNEUMATIC_RUNS.items(), SEED):
        write(HERE / "pneumatic_rig" / f"{name}.csv", pneumatic_run(speeds, seed))
    for seed, (name, speeds) in enumerate(OWN_RUNS.items(), SEED):
        write_foreign(HERE / "own_rig" / f"{name}.csv", own_run(speeds, seed))


def step_run(steps: tuple[tuple[float, float], ...], rng: np.random.Generator) -> dict[str, Array]:
    """Speed of a drive whose valve voltage steps: 2.5 s at 1 kHz."""
    plant = po.SecondOrder(friction=po.Coulomb()).system()
    t = np.round(np.arange(0, 2.5, 0.001), 6)
    voltage = np.zeros_like(t)
    for at, level in steps:
        voltage[t >= at - 1e-9] = level
    values = truth("step_rig") | {"friction.viscous": 0.0, "friction.smoothing": 2e-3}
    late = np.concatenate([np.zeros(round(values.pop("plant.dead_time") / 0.001)), voltage])[: len(t)]
    run = po.simulate(plant, po.Trajectory(t, {"valve_voltage": late}), plant.parameters.with_values(values))
    noisy = run["speed"] + SPEED_NOISE * rng.standard_normal(len(t))
    return {"time [s]": t, "valve_voltage [V]": voltage, "speed [m/s]": quantised(noisy, SPEED_STEP)}


def force_run(levels: tuple[float, ...], rng: np.random.Generator) -> dict[str, Array]:
    """Position of a cylinder's load that a known force pushes, under a sampled position loop: 6 s at 1 kHz."""
    drive = po.ForceDrive(po.Stribeck())
    loop = po.ClosedLoop(drive.system(), po.PID(sample_time=1e-3), measured="position")
    limits = {"pid.lower": -300.0, "pid.upper": 300.0}
    p = loop.parameters.with_values({**truth("force_rig"), "friction.smoothing": 1e-3, **POSITION_LOOP, **limits})
    t = np.round(np.arange(6000) * 1e-3, 6)
    held = np.repeat(levels, len(t) // 2 // len(levels))
    slow = 0.1 + 0.02 * np.abs((np.arange(len(t) - len(held)) * 1e-3 / 0.75 + 0.5) % 2 - 1) - 0.01
    reference = np.concatenate([held, slow])
    start = {"position": levels[0]}
    run = po.simulate(loop, po.Trajectory(t, {"reference": reference}), p, initial=start)
    noisy = run["position"] + POSITION_NOISE * rng.standard_normal(len(t))
    columns = {"time [s]": t, "force [N]": quantised(run["control"], FORCE_STEP)}
    return {**columns, "position [mm]": quantised(noisy * 1e3, POSITION_STEP * 1e3)}


def pneumatic_run(speeds: tuple[tuple[float, float], ...], seed: int) -> dict[str, Array]:
    """A cylinder under a hand-tuned speed loop that hunts: 4 to 6 s at 1 kHz, by the rig model."""
    values = truth("pneumatic_rig")
    said = values.pop("rig")
    known = po.read_drive(HERE / "pneumatic_rig" / "drive.toml")[1]
    drive = po.PneumaticDrive(friction=po.Karnopp(po.Stribeck()))
    loop = po.ClosedLoop(drive.system(), po.PID(sample_time=1e-3))
    given = {n: known.value(n) for n in drive.parameters if n in known} | values
    reference = np.concatenate([np.full(round(1000 * seconds), speed) for speed, seconds in speeds])
    t = np.round(np.arange(len(reference)) * 1e-3, 6)
    rig = po.Rig(loop, sensors(said), po.Actuator(said["valve_hysteresis"]), po.Encoder(filter=said["speed_filter"]))
    p = loop.parameters.with_values(given | SPEED_LOOP)
    run = po.record(rig, po.Trajectory(t, {"reference": reference}), p, seed=seed).experiment.trajectory
    columns = {"time [s]": t, "speed_reference [m/s]": reference}
    columns |= {"valve_voltage [V]": quantised(run["valve_voltage"], COMMAND_STEP)}
    columns |= {"position [mm]": quantised(run["position"] * 1e3, said["position_resolution"] * 1e3)}
    step = said["pressure_resolution"] * 1e-5
    return columns | {f"pressure_{side} [bar(a)]": quantised(run[f"pressure_{side}"] * 1e-5, step) for side in "ab"}


def own_run(speeds: tuple[tuple[float, float], ...], seed: int) -> dict[str, Array]:
    """A rig as its owner logs it, under a hand-tuned speed loop: 4 to 8 s at 500 Hz, gauge pressures, 0 to 10 V."""
    values = truth("own_rig")
    said, centre = values.pop("rig"), values.pop("valve.centre")
    drive = po.PneumaticDrive(friction=po.Karnopp(po.Stribeck()))
    loop = po.ClosedLoop(drive.system(), po.PID(sample_time=OWN_SAMPLE))
    known = po.catalog.s32()[1]
    hardware = {n: known.value(n) for n in drive.parameters if n in known}
    rig = po.Rig(loop, sensors(said), encoder=po.Encoder(filter=said["speed_filter"]))
    limits = dict(zip(("pid.lower", "pid.upper"), (end - centre for end in WIRE), strict=True))
    p = loop.parameters.with_values(hardware | values | OWN_LOOP | limits)
    reference = np.concatenate([np.full(round(seconds / OWN_SAMPLE), speed) for speed, seconds in speeds])
    t = np.round(np.arange(len(reference)) * OWN_SAMPLE, 6)
    run = po.record(rig, po.Trajectory(t, {"reference": reference}), p, seed=seed).experiment.trajectory
    gauge = {side: (run[f"pressure_{side}"] - ATMOSPHERE) * 1e-5 for side in "ab"}
    columns = {"t [ms]": t * 1e3, "U_valve [V]": quantised(run["valve_voltage"] + centre, said["command_resolution"])}
    columns |= {"x [mm]": quantised(run["position"] * 1e3, said["position_resolution"] * 1e3)}
    step = said["pressure_resolution"] * 1e-5
    return columns | {f"p{side.upper()} [bar]": quantised(gauge[side], step) for side in "ab"}


def sensors(said: dict[str, float]) -> dict[str, po.Sensor]:
    """Of the pneumatic rig: an encoder and two pressure sensors."""
    pressure = po.Sensor(said["pressure_lag"], said["pressure_noise"], said["pressure_resolution"])
    position = po.Sensor(resolution=said["position_resolution"])
    return {"position": position, "pressure_a": pressure, "pressure_b": pressure}


def quantised(values: Array, step: float) -> Array:
    """Rounded to whole steps of a sensor; ten digits keep the file free of binary noise."""
    return np.round(np.round(values / step) * step, 10)


def write_foreign(path: Path, columns: dict[str, Array]) -> None:
    """As a recorder writes it: a line above the header, semicolons between the columns."""
    write(path, columns)
    text = path.read_text(encoding="utf-8").replace(",", ";")
    path.write_text("Recorder 3, gauge pressures\n" + text, encoding="utf-8", newline="\n")


def write(path: Path, columns: dict[str, Array]) -> None:
    """A CSV of the columns, with the shortest text that reads back the same."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = zip(*(map(repr, column.tolist()) for column in columns.values()), strict=True)
    lines = [",".join(columns), *map(",".join, rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")


if __name__ == "__main__":
    main()
