"""tuning.toml: the controller, what may be tuned, the references to follow and what counts."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from os.path import relpath
from pathlib import Path
from typing import Any

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.moves import MotionPath, Move, MoveSequence
from pneuopt.control.reference import Reference, Step
from pneuopt.dynamics.runnable import command_centre
from pneuopt.dynamics.system import System
from pneuopt.dynamics.tolerances import MAX_STEPS
from pneuopt.evaluation.certificate import Defect
from pneuopt.evaluation.limit_cycle import NoHunting
from pneuopt.evaluation.metric import Requirement
from pneuopt.evaluation.scenarios import NO_SCENARIOS, Scenarios, corners, further, samples, tolerances
from pneuopt.evaluation.specification import Specification, specify_limits
from pneuopt.evaluation.tolerances import PLANT_COUNT
from pneuopt.files.loop import (
    ACCEPT_KEY,
    BUDGET_KEYS,
    LIMIT_KEYS,
    MOVE_KEYS,
    PATH_KEYS,
    REFERENCE_KEYS,
    REQUIREMENTS_BY_KEY,
    ROBUST_KEY,
    SCENARIO_KEYS,
    STEP_KEYS,
    TUNING_KEYS,
    objective_key,
    read_corner_spreads,
    read_draw,
    read_loop_sections,
    read_method,
    read_sample_spreads,
    read_spreads,
    signal_units,
)
from pneuopt.files.toml import construct_at, read_toml
from pneuopt.logs.read_log import read_log
from pneuopt.quantities.errors import InputError, check_names, require
from pneuopt.quantities.keys import Key, Takes, check_sections, read_entry, read_named, read_table
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import write_value
from pneuopt.tuning.method import Method

TUNED_SECTIONS = ("certified", "wire", "status", "provenance", "checksum")
"""Sections that a result adds to a tuning's file; reading the tuning passes over them."""


@dataclass(frozen=True, eq=False)
class Tuning:
    """A tuning.toml as read: the loop, its references and parameters, what is asked of it, and how it is tuned."""

    loop: ClosedLoop
    references: tuple[Reference, ...]
    # "pid.*", "dither.*", "sensor.*", "feedforward.*", the compensators'; the free ones within finite bounds
    parameters: ParameterSet
    # objective and limits, checked; without terms of an objective where the file only describes a loop
    specification: Specification
    # it maps the nominal parameters to the plants and tolerances beside them
    scenarios: Callable[[ParameterSet], Scenarios] = lambda _: NO_SCENARIOS
    # it maps them to other plants and tolerances from the same boxes, on which a design is validated
    validation_scenarios: Callable[[ParameterSet], Scenarios] = lambda _: NO_SCENARIOS
    method: Method | None = None  # None: the first that suits the loop
    max_steps: float = MAX_STEPS  # steps of the simulations that are refused as too many
    accept: tuple[Defect, ...] = ()  # defects with which a design is certified all the same
    robust: bool = True  # whether a design is sought that also holds on other plants
    centre: float = 0.0  # what is on the wire to the valve while the loop's command is zero [the command's unit]

    @property
    def wire(self) -> dict[str, str]:
        """What a controller adds to the loop's command for the valve, as [wire] in a tuned.toml; empty for nothing."""
        return {"centre": write_value(self.centre, self.loop.command.unit)} if self.centre else {}


def read_tuning(path: str | Path, plant: System, parameters: ParameterSet | None = None) -> Tuning:
    """Read a tuning for a plant, whose signals set the units.

    Parameters
    ----------
    path : str or Path
        A tuning.toml, or a tuned.toml made from one.
    plant : System
    parameters : ParameterSet, optional
        The plant's, whose valve's centre the limits of the command are counted from; by default its own.

    Returns
    -------
    Tuning

    Raises
    ------
    InputError
        UnitError, UnknownNameError, ModelError or other; the message names file, section and key.
    """
    return read_tuning_table(read_toml(path).unwrap(), path, plant, parameters)


def read_tuning_table(
    document: Mapping[str, Any], path: str | Path, plant: System, parameters: ParameterSet | None = None
) -> Tuning:
    """Read a tuning from the table that its file holds; parameters and errors as for `read_tuning`."""
    table = {name: entry for name, entry in document.items() if name not in TUNED_SECTIONS}
    check_sections(TUNING_KEYS, table, path)
    centre = command_centre(plant, parameters or plant.parameters)
    loop, own = read_loop_sections(table, plant, path, centre)
    # units without (a) or (g): those of bounds and bands, which are differences
    units = signal_units(loop.command.unit, loop.feedback.unit.partition("(")[0])
    where, weights = f"{path}: [minimise]", dict[Requirement, float]()
    check_names("requirement", table.get("minimise", {}), REQUIREMENTS_BY_KEY, where)
    for key, entry in table.get("minimise", {}).items():
        spot = f"{where} {key}"
        require(isinstance(entry, dict), f"{spot}: write {key} = {{ weight = 1.0 }}; a limit belongs under [limits]")
        stated = read_table(objective_key(key).keys, entry, spot, units=units)
        weight, limit = stated.pop("weight"), {"max": None} if key == "step_envelope" else {}
        weights[construct_at(partial(REQUIREMENTS_BY_KEY[key], **limit, **stated), spot)] = weight
    where, limits = f"{path}: [limits]", list[Requirement | NoHunting]()
    check_names("requirement", table.get("limits", {}), LIMIT_KEYS, where)
    for key, entry in table.get("limits", {}).items():
        spot = f"{where} {key}"
        kind: Callable[..., Requirement | NoHunting] = REQUIREMENTS_BY_KEY.get(key, NoHunting)
        values = read_entry(LIMIT_KEYS[key], entry, spot, units)
        limits.append(construct_at(partial(kind, **{n: v for n, v in values.items() if v is not None}), spot))
    spec = construct_at(lambda: specify_limits(limits, weights), f"{path}: [minimise] and [limits]")
    section = table.get("scenarios", {}), str(path)
    scenarios, validation = (partial(read, *section) for read in (read_scenarios, read_validation_scenarios))
    method = read_method(table.get("method", {}), f"{path}: [method]")
    references = read_references(table.get("reference", []), loop, path)
    max_steps = read_table(BUDGET_KEYS, table.get("budget", {}), f"{path}: [budget]")["steps"]
    accept = read_entry(TUNING_KEYS[ACCEPT_KEY], table.get(ACCEPT_KEY, []), f"{path}: {ACCEPT_KEY}")
    robust = read_entry(TUNING_KEYS[ROBUST_KEY], table.get(ROBUST_KEY, True), f"{path}: {ROBUST_KEY}")
    return Tuning(loop, references, own, spec, scenarios, validation, method, max_steps, accept, robust, centre)


def read_scenarios(table: Mapping[str, Any], where: str, parameters: ParameterSet) -> Scenarios:
    """Read [scenarios]: corners and samples of the plant, and tolerances of the gains, in one mapping."""
    return {name: values for part in _read_kinds(table, where, parameters, None) for name, values in part.items()}


def read_validation_scenarios(table: Mapping[str, Any], where: str, parameters: ParameterSet) -> Scenarios:
    """Draw plants from the boxes of [scenarios], others than `read_scenarios` gives, each with all that it varies.

    The second half, as many as the first, is independent of it: for vetting.
    """
    halves = [
        zip(*(list(part.values()) for part in _read_kinds(table, where, parameters, stream)), strict=True)
        for stream in ("validation", "vetting")
    ]
    rows = enumerate((own for half in halves for own in half), 1)
    return {f"new {k}": {n: value for part in own for n, value in part.items()} for k, own in rows}


def _read_kinds(
    table: Mapping[str, Any], where: str, parameters: ParameterSet, stream: str | None
) -> Iterator[Scenarios]:
    """The scenarios of each kind, as stated; those of a `stream` are `PLANT_COUNT` draws instead."""
    new_count = None if stream is None else PLANT_COUNT
    check_names("kind", table, SCENARIO_KEYS, f"{where}: [scenarios]")
    for kind, given in table.items():
        spot = f"{where}: [scenarios.{kind}]"
        require(isinstance(given, dict), f'{spot} must be a section, with "load.mass" = "30 %" in it')
        entries = dict(given)
        draw = read_draw({key: entries.pop(key) for key in SCENARIO_KEYS[kind].keys if key in entries}, spot)
        seed = draw.seed if stream is None else further(draw.seed, stream, kind)
        try:
            if kind == "samples":
                own = read_sample_spreads(entries, spot, parameters)
                yield samples(parameters, own, new_count or draw.count, seed=seed, sampling=draw.sampling)
            elif kind == "corners":
                box = read_corner_spreads(entries, spot, parameters)
                yield corners(parameters, box) if new_count is None else samples(parameters, box, new_count, seed=seed)
            else:
                spreads = read_spreads(entries, spot, parameters)
                pairs = [n for n, spread in spreads.items() if isinstance(spread, tuple)]
                require(not pairs, f'{", ".join(pairs)}: a tolerance is a fraction, "1 %"')
                shares = {n: spread for n, spread in spreads.items() if not isinstance(spread, tuple)}
                yield tolerances(parameters, shares, new_count, seed=seed)
        except InputError as error:
            raise error if spot in str(error) else InputError(f"{spot} {error}") from None


def read_references(entries: Any, loop: ClosedLoop, path: str | Path) -> tuple[Reference, ...]:
    """Read the [[reference]] sections, in the units of the loop's signals."""
    several = isinstance(entries, list) and all(isinstance(e, dict) for e in entries)
    require(several, f"{path}: write each reference as a section of its own, [[reference]]")
    require(bool(entries), f'{path}: no reference; add [[reference]] with step = "0.2 m/s" and horizon = "1 s"')
    found = tuple(_reference(e, loop, Path(path), k) for k, e in enumerate(entries, 1))
    message = "two references step between the same values; tables tell them by that"
    require(len({r.label for r in found}) == len(found), f"{path}: {message}")
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
    """Rewrite the tables that [[reference]] sections name, beside a file in one folder, for a file in another."""
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
    units, outputs = signal_units(loop.command.unit, loop.feedback.unit), {q.name: q.unit for q in loop.plant.outputs}
    plain = {n: key for n, key in kind.keys.items() if key.takes is not Takes.TABLE}
    values = read_table(plain, entry, where, units=units, partial=True)
    if "moves" in entry:  # of each only what it states, for the rest is shared
        own = [move if isinstance(move, dict) else {"distance": move} for move in entry["moves"]]
        values["moves"] = [{n: all_[n] for n in stated} for all_, stated in zip(values["moves"], own, strict=True)]
    known = {n: values[n] for n in plain if n in entry}
    known["start"] = read_named(REFERENCE_KEYS["start"], entry.get("start", {}), outputs, f"{where} start")
    changes = entry.get("disturbance", {})
    if isinstance(changes, dict):  # of parameters and inputs; "load.force" without quotes is a table in a table
        parts = {n: v if isinstance(v, dict) else {"": v} for n, v in changes.items()}
        changes = {f"{n}.{m}".removesuffix("."): v for n, part in parts.items() for m, v in part.items()}
    moved = {q.name: q.unit for q in loop.plant.inputs} | {n: p.unit for n, p in loop.plant.parameters.items()}
    moved = {n: unit.partition("(")[0] for n, unit in moved.items()}
    known["disturbance"] = read_named(REFERENCE_KEYS["disturbance"], changes, moved, f"{where} disturbance")
    if kind is _PATH:
        table = file.parent / known.pop("path")
        known = {"dwell": Move.dwell, **known}
        channels = f"{loop.feedback.name}_reference", loop.feedback.name
        return construct_at(lambda: _make_path(table, read_log(table).trajectory, channels, known), f"{where} path")
    if kind is _MOVE:
        each = known.pop("moves", None) or [{"distance": known.pop("move")}]
        return construct_at(lambda: _chain_moves(each, known), where)
    return construct_at(lambda: Step(known.pop("step", 0.0), **known), where)


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


PATH_CHANNELS = ("position_reference", "position", "speed_reference", "speed")
"""Channels that may hold a path, the likelier first."""


def read_path(path: str | Path, *, channel: str | None = None, **settings: Any) -> MotionPath:
    """Read a path from a table of time and position, in any format and with any units that `read_log` takes.

    Parameters
    ----------
    path : str or Path
        Ten points at least; time may begin anywhere.
    channel : str, optional
        The channel that holds the points; by default the first of `PATH_CHANNELS` that the table has.
    **settings
        Fields of `MotionPath`: dwell, start, disturbance; its name is the file's.

    Returns
    -------
    MotionPath

    Raises
    ------
    InputError
        Or its kind; the message names file, row and column.
    """
    log = read_log(path).trajectory
    if channel is not None:
        check_names("channel", [channel], log.names, str(path))
    return _make_path(path, log, PATH_CHANNELS if channel is None else (channel,), settings)


def _make_path(path: str | Path, log: Trajectory, channels: Sequence[str], settings: Mapping[str, Any]) -> MotionPath:
    """The path in the first of the channels that the table has."""
    found = [n for n in channels if n in log]
    named = PATH_CHANNELS[1] if PATH_CHANNELS[1] in channels else channels[-1]
    unit = {"position": " [mm]", "speed": " [m/s]"}.get(named, "")
    require(bool(found), f"{path}: no column of a path; name one {named}{unit}")
    points = log[found[0]]
    return construct_at(lambda: MotionPath(log.t - log.t[0], points, name=Path(path).stem, **settings), str(path))
