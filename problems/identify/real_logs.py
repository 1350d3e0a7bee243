"""Logs as rigs give them, on generated logs of known truth: each trouble, and what becomes of the estimates.

    python problems/identify/real_logs.py [--json FILE]

The benchmark drive B32 (b32.py) under a saturated, sampled position loop whose command is not logged, and under a speed
loop at half the log's rate; two logs with different channels, a skew of 5 ms and wrong zero points; a valve for 0 to
10 V that is closed at 5.07 V; 1 % outliers; a noise level stated ten times wrong; three logs with different channels,
rates, jitter and holes in one fit; a wrong sign, gauge for absolute, and two drives. Estimates in percent of the truth
or in their own standard deviations.
"""

import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np
from numpy.typing import NDArray

import pneuopt as po
from problems.shared.b32 import FREE, NOISE, START, VALVE, integrate_loop, reference
from problems.shared.claims import Claim, arguments, finish, frame

if TYPE_CHECKING:
    import pandas as pd

Times = NDArray[np.floating[Any]]
FITTED = (*FREE, *VALVE)
SKEW, ZERO = 5e-3, {"one": 2e3, "two": -3e3}  # [s] of the position, [Pa] of pressure_a in each log
WIRE_SPAN, WIRE_CENTRE = 5.0, 5.07  # of a valve for 0 to 10 V [V]
GAINS = {
    "pid.Kp": 4.0,
    "pid.Ki": 2.0,
    "pid.Kd": 0.15,
    "pid.Tf": 2e-3,
    "pid.c": 0.0,
    "pid.lower": -0.2,
    "pid.upper": 0.2,
}
SPEED_GAINS = {"pid.Kp": 1.5, "pid.Ki": 8.0, "pid.Kd": 0.002, "pid.Tf": 5e-3, "pid.lower": -0.15, "pid.upper": 0.15}
SPEEDS = ((0.1, 0.5, 0.3), (0.7, 1.1, -0.25), (1.3, 1.9, 0.1), (2.0, 2.5, -0.12), (2.6, 2.9, 0.2))  # from, to, m/s


def main() -> "pd.DataFrame":
    claims = position_loop() + speed_loop() + skewed() + zero_to_ten() + outliers() + wrong_noise() + mixed()
    return frame(claims + wrong_logs() + two_drives())


def position_loop() -> list[Claim]:
    """The rig's controller reads its own noisy sensor; the log holds reference, position and pressures."""
    drive, truth = po.catalog.b32()
    loop = po.ClosedLoop(drive.system(), po.PID(sample_time=1e-3), measured="position")
    given = (loop.parameters | truth).with_values(GAINS)
    t = np.arange(4000) * 1e-3
    wanted = np.array([reference(s) if s < 2.5 else reference(s + 2.5) for s in np.maximum(t - 0.1, 0.0)])
    sensors = {n: po.Sensor(noise=NOISE[n]) for n in ("position", "pressure_a", "pressure_b")}
    begin = {**START, "pid.previous_error": -START["position"], "pid.integral": 0.0, "pid.derivative": 0.0}
    run = po.record(po.Rig(loop, sensors), po.Trajectory(t, {"reference": wanted}), given, initial=begin)
    saturated = float(np.mean(np.abs(run.experiment.trajectory["valve_voltage"]) >= GAINS["pid.upper"]))
    log = run.experiment.select(["position_reference", *sensors])
    fit = po.identify(loop, [log], _blind(given, FITTED), throw=False)
    shown = Claim("position_loop.saturated", 100 * saturated, "%", None, ">= 5")
    return [shown, *_percent("position_loop", fit, truth, 2.0)]


def speed_loop() -> list[Claim]:
    """A controller of 2 ms in a log of 1 ms, with integral action; position and pressures logged."""
    drive, truth = po.catalog.b32()
    loop = po.ClosedLoop(drive.system(), po.PID(sample_time=2e-3))
    given = (loop.parameters | truth).with_values(SPEED_GAINS)
    t = np.arange(3000) * 1e-3
    wanted = np.zeros(t.size)
    for begin, end, speed in SPEEDS:
        wanted[(t >= begin) & (t < end)] = speed
    run = po.simulate(loop, po.Trajectory(t, {"reference": wanted}), given, initial={"position": 0.05})
    log = _noisy(run.select(["position", "pressure_a", "pressure_b"]).with_columns({"speed_reference": wanted}), 0)
    fit = po.identify(loop, [log], _blind(given, FITTED), throw=False)
    saturated = float(np.mean(np.abs(run["control"]) >= SPEED_GAINS["pid.upper"]))
    shown = Claim("speed_loop.saturated", 100 * saturated, "%", None, ">= 5")
    return [shown, *_percent("speed_loop", fit, truth, 2.0)]


def skewed() -> list[Claim]:
    """One log with position and pressure_a, one with position and both pressures; the position comes 5 ms late."""
    drive, truth = po.catalog.b32()
    channels = {"one": ("position", "pressure_a"), "two": ("position", "pressure_a", "pressure_b")}
    logs = []
    for seed, (name, kept) in enumerate(channels.items()):
        run = integrate_loop(drive.system(), np.arange(2100) * 1e-3, truth, late=SKEW)
        run = run.with_columns({"pressure_a": run["pressure_a"] + ZERO[name]}).rows(100, 2100)
        logs.append(replace(_noisy(run, seed), name=name).select(["valve_voltage", *kept]))
    system = po.with_sensors(drive.system(), offset=["pressure_a"], delay=["position"])
    given = _blind(system.parameters | truth, FITTED).freed("sensor.*").per_log("sensor.pressure_a.offset")
    fit = po.identify(system, logs, given, throw=False)
    claims = _percent("skew", fit, truth, 2.0)
    delay, deviation = (1e3 * float(fit.estimates[column]["sensor.position.delay"]) for column in ("value", "stderr"))
    claims.append(Claim("skew.delay", delay, "ms", 1e3 * SKEW, f"{1e3 * SKEW:g} +- 0.5"))
    claims.append(Claim("skew.delay.sd", deviation, "ms"))
    for name, zero in ZERO.items():
        found = float(fit.estimates["value"][f"sensor.pressure_a.offset[{name}]"])
        claims.append(Claim(f"skew.offset_{name}", found, "Pa", zero, f"{zero:g} +- 150"))
    return claims


def zero_to_ten() -> list[Claim]:
    """A valve for 0 to 10 V: its command on the wire, and with the data sheet's 5 V taken off, its centre held or not.

    What is integrated is the benchmark's own valve, of 1 V to both sides; another span and centre are another scale.
    """
    drive, truth = po.catalog.b32()
    log = _noisy(integrate_loop(drive.system(), np.arange(4000) * 1e-3, truth), 4)
    log = log.select(["valve_voltage", "position", "pressure_a", "pressure_b"])
    on_wire = WIRE_SPAN * log.trajectory["valve_voltage"] + WIRE_CENTRE
    claims = []
    for name, off, free in (("wire", 0.0, ()), ("taken_off", 5.0, ("valve.centre",)), ("held", 5.0, ())):
        own = replace(log, trajectory=log.trajectory.with_columns({"valve_voltage": np.round(on_wire - off, 3)}))
        scaled = truth.with_values({"valve.span": WIRE_SPAN})
        fit = po.identify(drive.system(), [own], _blind(scaled, FITTED).freed(*free), throw=False)
        true = scaled.with_values({"valve.centre": WIRE_CENTRE - off})
        if name == "held":
            error = 100 * (fit.parameters.value("valve.conductance") / true.value("valve.conductance") - 1)
            claims.append(Claim("zero_to_ten.held.conductance", error, "%"))
            told = float("not explain" in fit.status.message)
            claims.append(Claim("zero_to_ten.held.told", told, "1", None, ">= 1"))
        else:
            claims += _percent(f"zero_to_ten.{name}", fit, true, 2.0)
            claims.append(
                Claim(f"zero_to_ten.{name}.centre_off", _off(fit, true, "valve.centre"), "sd", None, "0 +- 4")
            )
    return claims


def outliers() -> list[Claim]:
    """1 % of the positions 20 to 50 standard deviations off."""
    drive, truth = po.catalog.b32()
    log = _noisy(integrate_loop(drive.system(), np.arange(4000) * 1e-3, truth), 1)
    log = log.select(["valve_voltage", "position", "pressure_a", "pressure_b"])
    random, x = np.random.default_rng(5), log.trajectory["position"].copy()
    hit = random.random(x.size) < 0.01
    x[hit] += random.choice([-1, 1], hit.sum()) * random.uniform(20, 50, hit.sum()) * NOISE["position"]
    log, claims = replace(log, trajectory=log.trajectory.with_columns({"position": x})), []
    for name, loss in {"plain": None, "huber": po.Huber(), "soft_l1": po.SoftL1()}.items():
        fit = po.identify(drive.system(), [log], _blind(truth, FITTED), loss=loss, throw=False)
        explained = fit.status.converged and "not explain" not in fit.status.message
        claims.append(Claim(f"outliers.{name}.explained", float(explained), "1", None, f"{'>= 1' if loss else '<= 0'}"))
        claims.append(Claim(f"outliers.{name}.worst", _worst(fit, truth), "sd", None, "<= 3" if loss else ""))
        width = float(fit.estimates["stderr"]["friction.static"])
        claims.append(Claim(f"outliers.{name}.static_sd", width, "N", None, "<= 0.05" if loss else ""))
    return claims


def wrong_noise(draws: int = 40) -> list[Claim]:
    """A force-driven load; the position's noise is stated ten times too large, or too small."""
    system = po.ForceDrive(po.Coulomb()).system()
    truth = system.parameters.with_values({"load.mass": 3.0, "friction.coulomb": 30.0, "friction.viscous": 60.0})
    free, t = ("load.mass", "friction.coulomb", "friction.viscous"), np.arange(1000) * 1e-3
    push = 50 * np.sin(2 * np.pi * t) + 40 * np.sin(2 * np.pi * 2.3 * t)
    linear = {"force": po.Intersample.LINEAR}  # as a measured force is read
    run = po.simulate(system, po.Trajectory(t, {"force": push}), truth, intersample=linear).select(
        ["position", "speed"]
    )
    run, claims = run.with_columns({"force": push}), []
    cases = {"right": (1.0, False), "too_large": (10.0, False), "too_small": (0.1, False), "estimated": (10.0, True)}
    for name, (factor, estimated) in cases.items():
        off = []
        for seed in range(draws):
            log = _noisy(run, seed)
            log = log.with_noise({"position": factor * NOISE["position"]})
            fit = po.identify(system, [log], system.parameters.freed(*free), estimate_noise=estimated, throw=False)
            off += [_off(fit, truth, n) for n in free]
        inside = 100 * float(np.mean(np.abs(off) <= 1.96))
        claims.append(Claim(f"wrong_noise.{name}.coverage", inside, "%", 95.0, "95 +- 5" if estimated else ""))
        width = float(fit.estimates["stderr"]["friction.coulomb"])
        claims.append(Claim(f"wrong_noise.{name}.coulomb_sd", width, "N"))
    return claims


def mixed() -> list[Claim]:
    """All channels at 1 kHz; the position alone at 500 Hz, 5 % missing; speed and one pressure at 1 kHz with jitter."""
    drive, truth = po.catalog.b32()
    system, random = drive.system(), np.random.default_rng(3)
    full = replace(_noisy(integrate_loop(system, np.arange(2000) * 1e-3, truth), 1), name="full")
    slow = replace(_noisy(integrate_loop(system, np.arange(1500) * 2e-3, truth), 2), name="slow")
    x = np.where(random.random(1500) < 0.05, np.nan, slow.trajectory["position"])
    slow = replace(slow, trajectory=slow.trajectory.with_columns({"position": x}))
    t = np.arange(2000) * 1e-3 + np.append(0.0, random.uniform(-3e-4, 3e-4, 1999))
    jittered = replace(_noisy(integrate_loop(system, t, truth), 3), name="jittered").with_conditions(
        {"cylinder.start": 0.5}
    )
    kept = {"slow": ("position",), "jittered": ("speed", "pressure_a")}
    logs = [full, *(log.select(["valve_voltage", *kept[log.name]]) for log in (slow, jittered))]
    fit = po.identify(system, logs, _blind(truth, FITTED), throw=False)
    return [*_percent("mixed", fit, truth, 1.0), Claim("mixed.worst", _worst(fit, truth), "sd", None, "<= 4")]


def wrong_logs() -> list[Claim]:
    """A position with the wrong sign, and pressures whose gauge readings are taken for absolute: refused, in words."""
    drive, truth = po.catalog.b32()
    log = _noisy(integrate_loop(drive.system(), np.arange(1200) * 1e-3, truth), 1)
    log = log.select(["valve_voltage", "position", "pressure_a", "pressure_b"])
    read = log.trajectory
    wrong = {
        "sign": {"position": truth.value("cylinder.stroke") - read["position"]},
        "gauge": {n: read[n] - 101325.0 for n in ("pressure_a", "pressure_b")},
        "exchanged": {"pressure_a": read["pressure_b"], "pressure_b": read["pressure_a"]},
    }
    claims = []
    for name, columns in wrong.items():
        said = _refused(drive.system(), replace(log, trajectory=read.with_columns(columns)), truth)
        claims.append(Claim(f"wrong_log.{name}.said", float(said), "1", None, ">= 1"))
    gauge = replace(log, trajectory=read.with_columns(wrong["gauge"]))
    both = ("pressure_a", "pressure_b")
    system = po.with_sensors(drive.system(), offset=both)
    fit = po.identify(system, [gauge], _blind(system.parameters | truth, FITTED).freed("sensor.*"), throw=False)
    offsets = {n: float(fit.estimates["value"][f"sensor.{n}.offset"]) for n in both}
    return [*claims, *(Claim(f"wrong_log.{n}.zero", v, "Pa", -101325.0, "-101325 +- 500") for n, v in offsets.items())]


def two_drives() -> list[Claim]:
    """Two logs, one of a drive with 15 % more Coulomb friction: the joint fit says no, the comparison names it."""
    drive, truth = po.catalog.b32()
    logs = []
    for seed, (name, coulomb) in enumerate({"mine": 40.0, "other": 46.0}.items()):
        run = integrate_loop(drive.system(), np.arange(2000) * 1e-3, truth.with_values({"friction.coulomb": coulomb}))
        logs.append(
            replace(_noisy(run, seed), name=name).select(["valve_voltage", "position", "pressure_a", "pressure_b"])
        )
    given = _blind(truth, FITTED)
    joint = po.identify(drive.system(), logs, given, throw=False)
    found = po.compare_logs(drive.system(), logs, given)
    same = po.compare_logs(drive.system(), [logs[0], replace(_noisy(logs[0].trajectory, 7), name="again")], given)
    print(f"two drives, jointly: {joint.status}\ntwo drives, compared: {found.reason}\none drive: {same.reason}")
    told = "not explain" in joint.status.message or not joint.status.converged
    named = not found.agree and found.reason.startswith("the logs disagree in friction.coulomb,")
    rows = {"joint_fit_doubts": told, "coulomb_named": named, "one_drive_agrees": same.agree}
    return [Claim(f"two_drives.{n}", float(v), "1", None, ">= 1") for n, v in rows.items()]


def _noisy(run: po.Trajectory, seed: int) -> po.Experiment:
    """With noise on every channel that has some; the inputs as they are."""
    random = np.random.default_rng(seed)
    noise = {n: NOISE[n] for n in run if n in NOISE}
    noisy = {n: run[n] + sigma * random.standard_normal(len(run)) for n, sigma in noise.items()}
    return po.Experiment(run.with_columns(noisy), noise, name=f"run {seed}")


def _blind(truth: po.ParameterSet, free: tuple[str, ...]) -> po.ParameterSet:
    """The truth but for what is to be found, which stands at a drive's defaults."""
    defaults = po.catalog.b32()[0].parameters
    return truth.with_values({n: defaults.value(n) for n in free}).freed(*free)


def _percent(name: str, fit: po.IdentificationResult, truth: po.ParameterSet, within: float) -> list[Claim]:
    claims = [Claim(f"{name}.converged", float(fit.status.converged), "1", None, ">= 1")]
    for n, value in fit.estimates["value"].items():
        if str(n) in truth:
            true = truth.value(str(n))
            error = 100 * (float(value) / true - 1)
            claims.append(Claim(f"{name}.{str(n).split('.')[1]}", error, "%", None, f"0 +- {within:g}"))
    return claims


def _off(fit: po.IdentificationResult, truth: po.ParameterSet, name: str) -> float:
    value, stderr = (float(fit.estimates[column][name]) for column in ("value", "stderr"))
    return (value - truth.value(name)) / stderr


def _worst(fit: po.IdentificationResult, truth: po.ParameterSet) -> float:
    return max(abs(_off(fit, truth, str(n))) for n in fit.estimates.index)


def _refused(system: po.System, log: po.Experiment, truth: po.ParameterSet) -> bool:
    try:
        fit = po.identify(system, [log], _blind(truth, FITTED), throw=False)
    except po.InputError as error:
        print(error)
        return True
    print(fit.status)
    return not fit.status.converged or "not explain" in fit.status.message


if __name__ == "__main__":
    options = arguments(__doc__).parse_args()
    sys.exit(finish(main(), options))
