"""What remains identifiable of the benchmark drive B32 when fewer channels are logged, and more is unknown.

    python problems/identify/b32_partial.py [--json FILE] [--out DIR]

The log of b32.py (generated) with one pressure, none, or the speed alone (2 mm/s noise); then with valve, mass and
supply unknown, too; three logs at different supply pressures and loads; a valve with a dead zone; LuGre friction
without pressures; and the two-step way (friction from the force that the pressures give, then all jointly). Beside each
estimate stands the half width of its 95 % interval in percent of the truth. All intervals are those of a model that is
exact but for what is free: geometry, gas and the rest are known here, and the rows "wrong_supply" show what one wrong
datum does.
"""

import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np

import pneuopt as po
from problems.shared.b32 import FREE, LOGGED, VALVE, generate
from problems.shared.claims import Claim, arguments, finish, frame

if TYPE_CHECKING:
    import pandas as pd

USEFUL = 5.0  # [%] half width up to which an interval is worth having
BLIND = {"valve.conductance": 6e-8, "valve.leak": 0.0, "load.mass": 4.0, "supply.pressure": 6.5e5}
BLIND |= {"valve.critical_ratio": 0.2, "valve.dead_zone": 0.0}
SHAPE = {"valve.dead_zone": 0.05, "valve.critical_ratio": 0.36}
CASES = {"low": (6e5, 3.0), "middle": (7e5, 5.0), "high": (8e5, 8.0)}  # supply [Pa(a)], load [kg]
BRISTLES = ("friction.bristle_stiffness", "friction.bristle_damping")
CHANNELS = {
    "pressure_a": ("position", "pressure_a"),
    "pressure_b": ("position", "pressure_b"),
    "position": ("position",),
    "speed": ("speed",),
}


def main() -> "pd.DataFrame":
    drive, truth = po.catalog.b32()
    log = generate(drive, truth)
    claims = channels(drive, truth, log) + several(drive, truth) + shaped(drive, truth)
    return frame(claims + two_steps(drive, truth, log) + wrong_supply(drive, truth, log) + bristles())


def channels(drive: po.PneumaticDrive, truth: po.ParameterSet, log: po.Experiment) -> list[Claim]:
    """Friction with fewer and fewer channels; then valve, mass and supply unknown, too."""
    claims = []
    for name, logged in CHANNELS.items():
        claims += _case(name, drive, [_kept(log, logged)], truth, FREE, 1.0)
    for name in ("position", "speed"):
        claims += _case(f"{name}_valve", drive, [_kept(log, CHANNELS[name])], truth, (*FREE, *VALVE), 1.0)
    free = (*FREE, *VALVE, "load.mass", "supply.pressure")
    return claims + _case("position_blind", drive, [_kept(log, ("position",))], truth, free, 1.0)


def several(drive: po.PneumaticDrive, truth: po.ParameterSet) -> list[Claim]:
    """Three logs of 2 s: supply and load known of each, or each log's own unknowns."""
    own = ("supply.pressure", "load.mass")
    logs = []
    for name, values in CASES.items():
        log = generate(drive, truth.with_values(dict(zip(own, values, strict=True))), seconds=2.0)
        known = dict(zip(own, values, strict=True))
        logs.append(replace(log.select(LOGGED), name=name).with_conditions(known))
    free, unknown = (*FREE, *VALVE), [replace(log, conditions={}) for log in logs]
    claims = _case("conditions", drive, logs, truth, free, 1.0)
    each = {f"{n}[{log.name}]": log.conditions[n] for n in own for log in logs}
    return claims + _case("per_log", drive, unknown, truth.per_log(*own), (*free, *own), 1.0, each)


def shaped(drive: po.PneumaticDrive, truth: po.ParameterSet) -> list[Claim]:
    """A valve with a dead zone and another critical ratio, both unknown."""
    truth = truth.with_values(SHAPE)
    log = generate(drive, truth, seconds=4.0)
    free = (*FREE, *VALVE, *SHAPE)
    claims = _case("shape", drive, [log.select(LOGGED)], truth, free, 2.0)
    return claims + _case("shape_position", drive, [_kept(log, ("position",))], truth, free, 2.0)


def two_steps(drive: po.PneumaticDrive, truth: po.ParameterSet, log: po.Experiment) -> list[Claim]:
    """Friction of a `ForceDrive` under the force of the logged pressures, their noise taken for force; then jointly."""
    pushed = log.trajectory.with_columns({"force": drive.air_force(log.trajectory, truth)})
    first = replace(log, trajectory=pushed).select(["force", "position"])
    load = po.ForceDrive(drive.friction, drive.load)
    claims = _case("force", load, [first], truth.select(load.parameters), FREE, None)
    return claims + _case("joint", drive, [log.select(LOGGED)], truth, (*FREE, *VALVE), 1.0)


def wrong_supply(drive: po.PneumaticDrive, truth: po.ParameterSet, log: po.Experiment) -> list[Claim]:
    """Friction with a supply pressure taken 0.5 % too high: as given, and as one more unknown."""
    logged, wrong = _kept(log, ("position",)), truth.with_values({"supply.pressure": 7.035e5})
    claims = _case("wrong_supply", drive, [logged], wrong, FREE, None)
    return claims + _case("freed_supply", drive, [logged], truth, (*FREE, "supply.pressure"), 1.0)


def bristles() -> list[Claim]:
    """LuGre friction from the position alone; then valve, mass and supply unknown, too."""
    drive, truth = po.catalog.b32(lugre=True)
    log, free = _kept(generate(drive, truth), ("position",)), (*FREE, *BRISTLES)
    claims = _case("lugre_position", drive, [log], truth, free, None)
    blind = (*free, *VALVE, "load.mass", "supply.pressure")
    return claims + _case("lugre_blind", drive, [log], truth, blind, None)


def _kept(log: po.Experiment, channels: tuple[str, ...]) -> po.Experiment:
    """The named channels; a log without position begins where the piston was known to stand."""
    kept = log.select(("valve_voltage", *channels))
    stroke = po.catalog.b32()[1].value("cylinder.stroke")
    begin = {"cylinder.start": float(log.trajectory["position"][:20].mean()) / stroke}
    return kept if "position" in channels else kept.with_conditions(begin)


def _case(
    name: str,
    drive: po.PneumaticDrive | po.ForceDrive,
    logs: list[po.Experiment],
    truth: po.ParameterSet,
    free: tuple[str, ...],
    within: float | None,
    own: dict[str, float] | None = None,
) -> list[Claim]:
    """Estimates beside the truth, claimed to some percent; half widths, and the worst correlation."""
    blind = {n: BLIND[n] if n in BLIND else drive.parameters.value(n) for n in free}
    fit = po.identify(drive.system(), logs, truth.with_values(blind).freed(*free), throw=False)
    print(f"{name}: {fit.status}")
    claims = [Claim(f"{name}.converged", float(fit.status.converged), "1", None, ">= 1" if within else "")]
    for n, row in fit.estimates.iterrows():
        true = (own or {}).get(str(n)) or truth.value(str(n))
        bound = f"{true:g} +- {within / 100 * (abs(true)):.6g}" if within else ""
        short = f"{name}.{str(n).split('.', 1)[1]}"
        claims.append(Claim(short, row["value"], row["unit"], true, bound))
        claims.append(Claim(f"{short}.half_width", 50 * (row["ci_high"] - row["ci_low"]) / true, "%"))
    covariance = fit.covariance.to_numpy()
    deviation = np.sqrt(np.diag(covariance))
    matrix = np.abs(covariance / np.outer(deviation, deviation))
    return [*claims, Claim(f"{name}.correlation", float(np.max(matrix - np.eye(len(matrix)))), "1")]


def told(rows: "pd.DataFrame") -> str:
    """In words: which intervals of each case are worth having."""
    wide = rows[rows["name"].str.endswith(".half_width")]
    lines = []
    for case in dict.fromkeys(n.split(".")[0] for n in wide["name"]):
        own = wide[wide["name"].str.startswith(f"{case}.")]
        good = own["value"] <= USEFUL
        useful, vague = (", ".join(n.split(".")[1] for n in own["name"][side]) for side in (good, ~good))
        lines.append(f"{case}: known to {USEFUL:g} %: {useful or 'nothing'}; not: {vague or 'nothing'}")
    return "\n".join(lines)


if __name__ == "__main__":
    options = arguments(__doc__).parse_args()
    found = main()
    print(told(found))
    sys.exit(finish(found, options))
