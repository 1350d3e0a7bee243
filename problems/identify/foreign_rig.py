"""A rig as a stranger logs it, identified by defaults: stick-slip, a dead zone, 500 Hz, mm, bar(g) and 0-10 V.

    python problems/identify/foreign_rig.py [--seeds N] [--json FILE]

A cylinder under a speed loop that hunts; its friction is Karnopp's, which sticks and slips event by event, and its
valve has sharp edges, a dead zone of 2.4 % and its centre at 5.06 V. The log has what such a rig has: an encoder of
10 um, pressures with 5 mbar of noise, a command from 0 to 10 V. The drive.toml names hardware and what is to be found,
no width and no centre. Errors in percent of the truth, of the centre in V and in its own standard deviations, by seed;
CPU seconds of the fit alone.
"""

import csv
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np

import pneuopt as po
from problems.shared.arrays import Array
from problems.shared.claims import Claim, arguments, finish, frame

if TYPE_CHECKING:
    import pandas as pd

SAMPLE, SECONDS, AMBIENT = 2e-3, 8.0, 101325.0  # [s], [s], [Pa(a)]
CENTRE, WIRE = 5.06, (0.0, 10.0)  # the valve's own, of which the fit knows nothing, and what the wire may carry [V]
TRUTH = {
    "valve.conductance": 2.4e-8,
    "valve.dead_zone": 0.024,
    "friction.coulomb": 32.0,
    "friction.static": 48.0,
    "friction.stribeck_velocity": 0.015,
    "friction.viscous": 85.0,
}
HARDWARE = {
    "cylinder.stroke": 0.3,
    "cylinder.dead_volume_a": 25e-6,
    "cylinder.dead_volume_b": 25e-6,
    "cylinder.start": 0.4,
    "load.mass": 5.0,
    "valve.rounding": 0.002,  # sharp edges, of which the fit knows nothing
}
GAINS = {"pid.Kp": 1.5, "pid.Ki": 25.0, "pid.lower": WIRE[0] - CENTRE, "pid.upper": WIRE[1] - CENTRE}
BOUNDS = {  # of the errors [%]
    "valve.dead_zone": "0 +- 10",
    "friction.coulomb": "0 +- 5",
    "friction.static": "0 +- 5",
    "friction.viscous": "0 +- 5",
}
DRIVE = """[drive]
kind = "pneumatic"
[cylinder]
bore = "32 mm"
rod = "12 mm"
stroke = "300 mm"
dead_volume_a = "25 cm^3"
dead_volume_b = "25 cm^3"
[valve]
conductance = { value = "2e-8 m^3/(s*Pa)", free = true }
dead_zone = { value = "0 %", free = true }
[supply]
pressure = "6.0 bar(g)"
[load]
mass = "5 kg"
[friction]
model = "stribeck"
coulomb = { value = "30 N", free = true }
static = { value = "30 N", free = true }
stribeck_velocity = { value = "10 mm/s", free = true }
viscous = { value = "50 N*s/m", free = true }
"""


def main(seeds: int = 1) -> "pd.DataFrame":
    return frame([claim for seed in range(seeds) for claim in one_rig(seed)])


def one_rig(seed: int) -> list[Claim]:
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "drive.toml").write_text(DRIVE, encoding="utf-8")
        write_log(Path(folder) / "run.csv", record(seed))
        drive, given = po.read_drive(Path(folder) / "drive.toml")
        log = po.read_log(Path(folder) / "run.csv")
    began = time.process_time()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        fit = po.identify(drive.system(), [log], given, throw=False)
    seconds = time.process_time() - began
    print(f"seed {seed}: {fit.status}", *(str(w.message) for w in said), sep="\n  ")
    told = any("closed near 5 V" in str(w.message) for w in said)
    claims = [Claim(f"{seed}.converged", float(fit.status.converged), "1", None, ">= 1")]
    claims.append(Claim(f"{seed}.centre_told", float(told), "1", None, ">= 1"))
    for name, true in TRUTH.items():
        error = 100 * (fit.parameters.value(name) / true - 1)
        claims.append(Claim(f"{seed}.{name.split('.')[1]}", error, "%", None, BOUNDS.get(name, "")))
    off = fit.parameters.value("valve.centre") - CENTRE
    claims.append(Claim(f"{seed}.centre", off, "V", None, "0 +- 0.01"))
    claims.append(Claim(f"{seed}.centre_off", off / float(fit.estimates["stderr"]["valve.centre"]), "sd"))
    return [*claims, Claim(f"{seed}.cpu", seconds, "s")]


def record(seed: int) -> po.Trajectory:
    """The rig's own log, in SI units: half of it stands still, between several dozen slips."""
    random = np.random.default_rng(seed)
    loop = po.ClosedLoop(po.PneumaticDrive(friction=po.Karnopp(po.Stribeck())).system(), po.PID(sample_time=SAMPLE))
    reference = wanted_speeds(random)
    t = np.round(np.arange(len(reference)) * SAMPLE, 6)
    pressure = po.Sensor(noise=500.0, resolution=100.0)
    sensors = {"position": po.Sensor(resolution=1e-5), "pressure_a": pressure, "pressure_b": pressure}
    rig = po.Rig(loop, sensors, encoder=po.Encoder(filter=5e-3))
    p = loop.parameters.with_values(TRUTH | HARDWARE | GAINS)
    return po.record(rig, po.Trajectory(t, {"reference": reference}), p, seed=seed).experiment.trajectory


def wanted_speeds(random: np.random.Generator) -> Array:
    """Strokes of 30 to 90 mm at 30 to 400 mm/s about the middle, some with a stop behind."""
    parts, n, x = [], 0, 0.12
    while n < SECONDS / SAMPLE:
        speed = float(np.exp(random.uniform(np.log(0.03), np.log(0.4))))
        travel = min(float(random.uniform(0.03, 0.12)), 0.09)
        side = 1 if x < 0.15 else -1
        samples = min(max(int(travel / speed / SAMPLE), 50), 500)
        parts.append(np.full(samples, side * speed))
        x += side * speed * samples * SAMPLE
        if random.random() < 0.4:
            parts.append(np.zeros(100))
        n = sum(map(len, parts))
    return np.concatenate(parts)[: round(SECONDS / SAMPLE)]


def write_log(path: Path, run: po.Trajectory) -> None:
    """As a data logger writes it."""
    columns = {"time [s]": run.t, "valve_voltage [V]": np.round(run["valve_voltage"] + CENTRE, 4)}
    columns |= {"position [mm]": np.round(1e3 * run["position"], 4)}
    columns |= {f"pressure_{s} [bar(g)]": np.round((run[f"pressure_{s}"] - AMBIENT) * 1e-5, 3) for s in "ab"}
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("--seeds", type=int, default=1)
    options = parser.parse_args()
    sys.exit(finish(main(options.seeds), options))
