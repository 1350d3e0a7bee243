"""The [[reference]] sections of a tuning.toml: steps, moves and disturbances."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.move_sequence import MoveSequence
from pneuopt.control.moves import Move
from pneuopt.control.reference import Reference, Step
from pneuopt.files.reference_keys import MOVE_KEYS, OWN_MOVE_KEYS, REFERENCE_KEYS, STEP_KEYS
from pneuopt.files.toml import construct_at, read_fixed_value
from pneuopt.files.tuning_keys import signal_units
from pneuopt.quantities.errors import check_names, require
from pneuopt.quantities.keys import Key, Takes
from pneuopt.quantities.unit_algebra import difference_unit
from pneuopt.quantities.units import read_value


def read_references(entries: Any, loop: ClosedLoop, path: str | Path) -> tuple[Reference, ...]:
    """Read the [[reference]] sections, in the units of the loop's signals.

    Raises
    ------
    InputError
        Or its kind; the message names file, section and key.
    """
    several = isinstance(entries, list) and all(isinstance(e, dict) for e in entries)
    require(several, f"{path}: write each reference as a section of its own, [[reference]]")
    require(bool(entries), f'{path}: no reference; add [[reference]] with step = "0.2 m/s" and horizon = "1 s"')
    found = tuple(_reference(e, loop, f"{path}: [[reference]] {k}") for k, e in enumerate(entries, 1))
    told = "two references step between the same values; tables tell them by that"
    require(len({r.label for r in found}) == len(found), f"{path}: {told}")
    return found


def _reference(entry: Mapping[str, Any], loop: ClosedLoop, where: str) -> Reference:
    """Read one [[reference]]."""
    check_names("key", entry, REFERENCE_KEYS, where)
    moves = "move" in entry or "moves" in entry
    keys, kind, end = (MOVE_KEYS, "move", "dwell") if moves else (STEP_KEYS, "step", "horizon")
    one = sum(key in entry for key in ("step", "move", "moves")) <= 1
    require(one, f"{where} has more than one of step, move and moves; write a section [[reference]] for each")
    for key in entry:
        message = f"{where} {key} does not belong to a {kind}, which ends by {end}; a {kind} has {', '.join(keys)}"
        require(key in keys, message)
    needed = ("speed", "acceleration") if moves else ("horizon",) if "disturbance" in entry else ("step", "horizon")
    for key in needed:
        require(key in entry, f"{where} has no {key}")
    known = _numbers(entry, keys, loop, where) | _circumstances(entry, loop, where)
    if moves:
        known |= _profile(entry, where)
        each = _each_move(entry, loop, where) if "moves" in entry else [{"distance": known.pop("move")}]
        return construct_at(lambda: _chain_moves(each, known), where)
    return construct_at(lambda: Step(known.pop("step", 0.0), **known), where)


def _each_move(entry: Mapping[str, Any], loop: ClosedLoop, where: str) -> list[dict[str, Any]]:
    """Read several moves: the distance of each, and the settings that it has for itself."""
    given, unit = entry["moves"], difference_unit(loop.feedback.unit)
    require(isinstance(given, list) and len(given) > 0, f'{where} moves must be a list, ["200 mm", "-200 mm"]')
    found = []
    for k, move in enumerate(given, 1):
        if not isinstance(move, dict):
            found.append({"distance": read_value(move, unit, where=f"{where} moves")})
            continue
        spot = f"{where} moves {k}"
        check_names("key", move, OWN_MOVE_KEYS, spot)
        require("distance" in move, f'{spot} has no distance; write {{ distance = "200 mm", speed = "0.1 m/s" }}')
        found.append(_numbers(move, OWN_MOVE_KEYS, loop, spot) | _profile(move, spot))
    return found


def _chain_moves(each: Sequence[Mapping[str, Any]], settings: Mapping[str, Any]) -> Reference:
    """One move, or a sequence of moves that share the limits and the dwell that they have not for themselves."""
    first, *others = each
    if not others:
        return Move(**{**settings, **first})
    begins = {n: settings[n] for n in ("at", "initial", "start") if n in settings}
    shared = {n: value for n, value in settings.items() if n not in begins and n != "disturbance"}
    last = {"disturbance": settings.get("disturbance", {})}
    moves = [Move(**{**shared, **own, **(last if k == len(others) else {})}) for k, own in enumerate(others, 1)]
    return MoveSequence([Move(**{**begins, **shared, **first}), *moves])


def _profile(entry: Mapping[str, Any], where: str) -> dict[str, Any]:
    words = MOVE_KEYS["profile"].choices or {}
    if "profile" not in entry:
        return {}
    check_names("profile", [str(entry["profile"])], words, where)
    return {"profile": words[str(entry["profile"])]}


def _numbers(entry: Mapping[str, Any], keys: Mapping[str, Key], loop: ClosedLoop, where: str) -> dict[str, Any]:
    """Read the values, each in the unit of its key."""
    signals = signal_units(loop.command.unit, loop.feedback.unit)
    units = {n: key.unit.format_map(signals) for n, key in keys.items() if key.takes is Takes.NUMBER}
    return {n: read_fixed_value(entry, n, units[n], where) for n in units if n in entry}


def _circumstances(entry: Mapping[str, Any], loop: ClosedLoop, where: str) -> dict[str, Any]:
    """Read how the plant starts, and its disturbance."""
    outputs, start = {q.name: q.unit for q in loop.plant.outputs}, entry.get("start", {})
    require(isinstance(start, dict), f'{where} start: write start = {{ position = "250 mm" }}')
    check_names("output", start, outputs, f"{where} start")
    begun = {n: read_fixed_value(start, n, outputs[n], f"{where} start") for n in start}
    return {"start": begun, "disturbance": _disturbance(entry.get("disturbance", {}), loop, f"{where} disturbance")}


def _disturbance(table: Any, loop: ClosedLoop, where: str) -> dict[str, float]:
    """Read a disturbance: the changes of parameters and inputs of the plant."""
    require(isinstance(table, dict), f'{where}: write disturbance = {{ "load.force" = "50 N" }}')
    flat = {f"{n}.{m}": v for n, e in table.items() if isinstance(e, dict) for m, v in e.items()}
    flat |= {n: v for n, v in table.items() if not isinstance(v, dict)}
    units = {q.name: q.unit for q in loop.plant.inputs} | {n: p.unit for n, p in loop.plant.parameters.items()}
    check_names("parameter or input of the plant", flat, units, where)
    return {n: read_fixed_value(flat, n, units[n].partition("(")[0], where) for n in flat}
