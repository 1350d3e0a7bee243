"""The [[reference]] sections of a tuning.toml: steps, moves, paths and disturbances."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os.path import relpath
from pathlib import Path
from typing import Any

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.moves import Move, MoveSequence
from pneuopt.control.reference import Reference, Step
from pneuopt.files.path import read_path_of
from pneuopt.files.reference_keys import MOVE_KEYS, OWN_MOVE_KEYS, PATH_KEYS, REFERENCE_KEYS, STEP_KEYS
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
    found = tuple(_reference(e, loop, Path(path), k) for k, e in enumerate(entries, 1))
    told = "two references step between the same values; tables tell them by that"
    require(len({r.label for r in found}) == len(found), f"{path}: {told}")
    return found


@dataclass(frozen=True)
class _Kind:
    """A kind of reference: its name, its keys, the key by which it ends, and those without which it is none."""

    name: str
    keys: Mapping[str, Key]
    end: str
    needed: tuple[str, ...] = ()


_STEP, _PATH = _Kind("step", STEP_KEYS, "horizon", ("step", "horizon")), _Kind("path", PATH_KEYS, "dwell")
_MOVE = _Kind("move", MOVE_KEYS, "dwell", ("speed", "acceleration"))
_REFERENCE_KINDS: Mapping[str, _Kind] = {"step": _STEP, "move": _MOVE, "moves": _MOVE, "path": _PATH}


def move_paths(entries: Any, old: Path, new: Path) -> None:
    """Rewrite the tables that [[reference]] sections name, beside a file in one folder, for a file in another.

    Parameters
    ----------
    entries : list of dict
        Of a TOML document, changed in place.
    old, new : Path
        The folders.
    """
    if old.resolve() == new.resolve():
        return
    for entry in entries:
        if isinstance(entry.get("path"), str):
            table = (old / entry["path"]).resolve()
            try:
                entry["path"] = Path(relpath(table, new.resolve())).as_posix()
            except ValueError:  # on another drive of Windows
                entry["path"] = table.as_posix()


def _reference(entry: Mapping[str, Any], loop: ClosedLoop, file: Path, number: int) -> Reference:
    """Read one [[reference]]."""
    where = f"{file}: [[reference]] {number}"
    check_names("key", entry, REFERENCE_KEYS, where)
    given = [key for key in _REFERENCE_KINDS if key in entry]
    told = f"{where} has more than one of step, move, moves and path; write a section [[reference]] for each"
    require(len(given) <= 1, told)
    kind = _REFERENCE_KINDS[given[0]] if given else _STEP
    for key in entry:
        message = f"{where} {key} does not belong to a {kind.name}, which ends by {kind.end}"
        message += f"; a {kind.name} has {', '.join(kind.keys)}"
        require(key in kind.keys, message)
    for key in ("horizon",) if "disturbance" in entry and kind is _STEP else kind.needed:
        require(key in entry, f"{where} has no {key}")
    known = _numbers(entry, kind.keys, loop, where) | _circumstances(entry, loop, where)
    if kind is _PATH:
        require(isinstance(entry["path"], str), f'{where} path must name a file, path = "path.csv"')
        table = file.parent / entry["path"]
        known = {"dwell": Move.dwell, **known}
        return construct_at(lambda: read_path_of(loop.feedback.name, table, **known), f"{where} path")
    if kind is _MOVE:
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
