"""The first files of a new user: drive, tuning, study, rig and a log's sidecar; and those of an excitation run."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.moves import Move
from pneuopt.control.pid import PID
from pneuopt.control.sensor import Encoder
from pneuopt.dynamics.hooks import DEFAULT_WIDTH
from pneuopt.dynamics.system import System
from pneuopt.evaluation.moves import ExcitationRun
from pneuopt.files.drive import FIT_SECTIONS, drive_keys, usual_plant
from pneuopt.files.keys import Template, comment_lines, json_schema
from pneuopt.files.loop import signal_units_of, tuning_keys
from pneuopt.files.outputs import output_schema
from pneuopt.files.rig import RIG_KEYS
from pneuopt.files.study import STUDY_KEYS
from pneuopt.files.tolerances import SAMPLE_TIME
from pneuopt.files.tuning import TUNED_SECTIONS
from pneuopt.logs.columns import CHANNELS, plant_channels
from pneuopt.logs.read_log import SIDECAR_KEYS
from pneuopt.models.catalog import CATALOGUE_SOURCE
from pneuopt.models.declaration import DriveKind, FirstFiles
from pneuopt.models.drive_kinds import DRIVE_KINDS
from pneuopt.quantities.errors import check_names, require
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.quantities.units import write_value

BAND, OVERSHOOT, SENSITIVITY = "2 %", "5 %", 1.6  # what a first tuning asks for: usual, and within reach of most drives
_EXAMPLE_SPREAD = 'distribution = "normal", spread = "5 %"'
_RIG_TITLE = (
    "What the hardware has and its model has not; a design is certified on it, too:",
    "    pneuopt tune fit.toml tuning.toml --rig rig.toml",
    "All of it is optional: without any, the drive sticks and slips, and no more.",
)
_OTHER_FILES = ("drive", "tuning", "study", "rig")


def first_kinds() -> dict[str, FirstFiles]:
    """The kinds of drive for which there are first files."""
    return {name: kind.first for name, kind in DRIVE_KINDS.items() if kind.first is not None}


def first_files(
    name: str,
    known: ParameterSet,
    columns: Mapping[str, str],
    *,
    log: str = "log.csv",
    sample_time: float = SAMPLE_TIME,
    counts_from_zero: bool = False,
    counts: Mapping[str, float] = MappingProxyType({}),
    source: Sequence[str] = (),
    doubts: Sequence[str] = (),
) -> dict[str, str]:
    """The texts of the files, by their names within a folder.

    `columns` is what the sidecar states by channel ('"t [ms]"'), `doubts` what it states without being sure; with
    `counts_from_zero` the command goes from 0 to twice the usual limit about a centre that is estimated. `counts` are
    the steps of what sensors count [SI]: a speed that is not among `columns` is differentiated from them.
    """
    check_names("kind", [name], first_kinds(), "init")
    others = {sidecar_name(other) for other in _OTHER_FILES}
    require(sidecar_name(log) not in others, f"{log}: rename it; {sidecar_name(log)} is the name of another file")
    kind, first = DRIVE_KINDS[name], first_kinds()[name]
    plant = usual_plant(kind, first.options)
    defaults = plant.parameters
    values = defaults | defaults.with_values(first.values) | known.select(n for n in known if n in defaults)
    loop, output = ClosedLoop(plant, PID(sample_time)), plant.outputs[0]
    sensor = f'{output.name} = {{ lag = "0 s", noise = "0 {output.unit}", resolution = "0 {output.unit}" }}'
    rig = Template(_RIG_TITLE, RIG_KEYS, names={"sensors": sensor}, schema=_schema_path("rig"))
    templates = {
        "drive": _drive_template(kind, first, values, source),
        "tuning": _tuning_template(loop, first, values, counts_from_zero, _encoder_keys(loop, columns, counts)),
        "study": _study_template(loop, first, values),
        "rig": rig,
        "sidecar": _sidecar_template(loop, first, values, columns, log, doubts),
    }
    results = {"drive": FIT_SECTIONS, "tuning": TUNED_SECTIONS}
    files = {sidecar_name(log if n == "sidecar" else n): t.render() for n, t in templates.items()}
    schemas = {t.schema: json_schema(f"pneuopt {n}", t.sections, results.get(n, ())) for n, t in templates.items()}
    schemas[_schema_path("output")] = output_schema()
    return files | {path: json.dumps(schema, indent=1, ensure_ascii=False) + "\n" for path, schema in schemas.items()}


def first_channels(name: str) -> dict[str, str]:
    """The channels that a log of such a drive may hold, and their SI units."""
    return {**CHANNELS, **plant_channels(_first_plant(name))}


def unused_channels(name: str) -> frozenset[str]:
    """Channels that such a drive has no use for, as a valve's voltage where a force drives; a log leaves them out."""
    plant = _first_plant(name)
    references = (n for n in CHANNELS if n.endswith("_reference"))  # they may stay: no plant reads them
    return frozenset(CHANNELS) - {"time", *references, *plant_channels(plant)}


def _first_plant(name: str) -> System:
    return usual_plant(DRIVE_KINDS[name], first_kinds()[name].options)


def sidecar_name(log: str) -> str:
    """The name of a log's sidecar."""
    return Path(log).with_suffix(".toml").name


def _schema_path(name: str) -> str:
    return f"schemas/{name}.json"


def _drive_template(kind: DriveKind, first: FirstFiles, values: ParameterSet, source: Sequence[str]) -> Template:
    sections = {n: replace(key, keys=dict(key.keys)) for n, key in drive_keys(kind.name).items()}
    stated = {"drive.kind": f'"{kind.name}"'}
    stated |= {f"{section}.{key}": f'"{word}"' for section, keys in first.options.items() for key, word in keys.items()}
    for name, p in values.items():
        section, _, key = name.partition(".")
        declared = sections[section].keys[key]
        if declared.source != DEFAULT_WIDTH:  # a stated width is not chosen by the logs any more
            declared = replace(declared, source="catalogue") if p.source == CATALOGUE_SOURCE else declared
            sections[section] = replace(sections[section], keys={**sections[section].keys, key: declared})
            stated[name] = _value_text(p, free=True) if name in first.unknowns else _value_text(p)
    title = (
        f"A {kind.name} drive: its hardware. Put in what you know; what is free is identified from logs:",
        f"    pneuopt identify drive.toml LOG -o fit.toml      ({', '.join(first.unknowns[:2])}, ... are free)",
        "Lines that begin with # say what else there is; without the # they count.",
        *source,
    )
    return Template(title, sections, stated, schema=_schema_path("drive"))


def _tuning_template(
    loop: ClosedLoop,
    first: FirstFiles,
    values: ParameterSet,
    counts_from_zero: bool,
    encoder: Mapping[str, str],
    *,
    dither_samples: int = 5,  # least a period: fewer bend its wave; more slow it down for a slow controller
) -> Template:
    command, measured = loop.command.unit, loop.feedback.unit
    given = loop.parameters.with_values({f"pid.{n}": value for n, (value, _, _) in first.gains.items()})
    given = given.with_bounds({f"pid.{n}": (low, high) for n, (_, low, high) in first.gains.items()})
    ends = (0.0, 2 * first.limit) if counts_from_zero else (-first.limit, first.limit)
    sample_time = write_value(loop.pid.sample_time or 0.0, "s")
    stated = {"pid.form": '"parallel"', "pid.sample_time": _quote(sample_time)}
    stated |= {f"pid.{n}": _value_text(given[f"pid.{n}"], free=True, bounds=True) for n in first.gains}
    stated["pid.limits"] = "[" + ", ".join(_quote(write_value(end, command)) for end in ends) + "]"
    stated |= encoder
    if first.dither is not None:
        frequency, most = first.dither
        frequency = min(frequency, 1.0 / (dither_samples * (loop.pid.sample_time or SAMPLE_TIME)))
        stated |= {"dither.waveform": '"sine"', "dither.frequency": _quote(write_value(frequency, "Hz"))}
        least = {"amplitude": 0.0, "offset": -most}
        free = {n: Parameter(0.0, command, lower, most) for n, lower in least.items()}
        stated |= {f"dither.{n}": _value_text(p, free=True, bounds=True) for n, p in free.items()}
    stated["minimise.settling_time"] = f'{{ band = "{BAND}", weight = 1.0, mean = false }}'
    stated |= {"limits.overshoot": _quote(OVERSHOOT), "limits.max_sensitivity": f"{SENSITIVITY:g}"}
    examples = {"loop.measured": _quote(loop.feedback.name), "loop.actuated": _quote(loop.command.name)}
    examples["pid.fault_output"] = _quote(write_value(0.5 * sum(ends), command))
    horizon = _quote(write_value(first.horizon, "s"))
    steps = [{"step": _quote(write_value(step, measured)), "horizon": horizon} for step in first.steps]
    title = (
        f"A PID of the {loop.feedback.name}, tuned together with what else is free in this file:",
        "    pneuopt tune fit.toml tuning.toml -o tuned.toml      (or drive.toml, where there is no fit yet)",
        "Lines that begin with # say what else there is; without the # they count.",
    )
    return Template(
        title,
        tuning_keys(command, measured),
        stated,
        {"reference": steps},
        signal_units_of(loop),
        examples,
        _tuning_names(loop, first, values),
        _schema_path("tuning"),
    )


def _encoder_keys(loop: ClosedLoop, columns: Mapping[str, str], counts: Mapping[str, float]) -> dict[str, str]:
    """The sensor of a loop whose log counts a position and has no speed: the controller's speed comes from there."""
    axis = loop.plant.axis
    if axis is None or loop.feedback.name != axis.speed or axis.speed in columns or axis.position not in counts:
        return {}
    unit = next(q.unit for q in loop.plant.outputs if q.name == axis.position)
    lag = write_value(Encoder.filter, "s")
    return {"sensor.resolution": _quote(write_value(counts[axis.position], unit)), "sensor.filter": _quote(lag)}


def _tuning_names(loop: ClosedLoop, first: FirstFiles, values: ParameterSet) -> dict[str, str]:
    """Entries that stand for what a user names."""
    swept, output = values[first.swept], loop.plant.outputs[0]
    tenth = _value_text(replace(swept, value=0.1 * swept.value))
    return {
        "reference.start": f'{output.name} = "0 {output.unit}"',
        "reference.disturbance": f'"{first.swept}" = {tenth}',
        "scenarios.corners": f'"{first.swept}" = "30 %"',
        "scenarios.samples": f'"{first.swept}" = {{ {_EXAMPLE_SPREAD} }}',
        "scenarios.tolerances": '"pid.Kp" = "1 %"',
    }


def _study_template(loop: ClosedLoop, first: FirstFiles, values: ParameterSet) -> Template:
    swept = values[first.swept]
    axis = ", ".join(_value_text(replace(swept, value=share * swept.value)) for share in (0.8, 1.0, 1.2))
    stated = {"study.drive": '"drive.toml"', "study.tuning": '"tuning.toml"', f'axes."{first.swept}"': f"[{axis}]"}
    limits, unit = {"lower": 0.5 * first.limit, "upper": first.limit}, loop.command.unit
    ends = {f"pareto.{n}": _quote(write_value(limit, unit)) for n, limit in limits.items()}
    title = (
        "How the loop does on other plants; name fit.toml and tuned.toml, once there are such:",
        "    pneuopt study study.toml -o cases.csv --plot map.png",
        "[samples], [corners] or [table] ask for other cases in place of [axes]; [sensitivity]",
        "asks which tolerances matter;",
        "[pareto] asks for a front instead; leave out [axes] and [metrics] then.",
    )
    names = {"axes": '"supply.pressure" = { from = "5 bar(g)", to = "7 bar(g)", steps = 3 }'}
    names = names if "supply.pressure" in values else {"axes": '"pid.Kp" = { from = 0.5, to = 1.5, steps = 3 }'}
    names |= dict.fromkeys(("samples", "sensitivity"), f'"{first.swept}" = {{ {_EXAMPLE_SPREAD} }}')
    names |= {"corners": f'"{first.swept}" = "30 %"'}
    return Template(title, STUDY_KEYS, stated, examples=ends, names=names, schema=_schema_path("study"))


def _sidecar_template(
    loop: ClosedLoop,
    first: FirstFiles,
    values: ParameterSet,
    columns: Mapping[str, str],
    log: str,
    doubts: Sequence[str],
) -> Template:
    signals, channels = (*loop.plant.inputs, *loop.plant.outputs), SIDECAR_KEYS["columns"].keys
    own = next((q for q in signals if q.name not in channels), None)
    output, swept = loop.feedback, values[first.swept]
    names = {
        "noise": f'{output.name} = "0.001 {output.unit}"',
        "conditions": f'"{first.swept}" = {_value_text(swept)}',
        "intersample": f'{loop.command.name} = "held"',
    }
    names |= {} if own is None else {"columns": f'{own.name} = "{own.name} [{own.unit}]"'}
    title = (
        f"The sidecar of {log}: what the log's columns are. It has the log's name.",
        'A column may be a table, too: { column = "U valve", unit = "V", centre = "5 V", scale = "1 V/V" }.',
        "Without [columns] the header says it: position [mm], or position_mm.",
        *(f"Assumed, check it: {doubt}" for doubt in doubts),
    )
    stated = {f"columns.{channel}": text for channel, text in columns.items()}
    return Template(title, SIDECAR_KEYS, stated, names=names, schema=_schema_path("sidecar"))


def _value_text(p: Parameter, *, free: bool = False, bounds: bool = False) -> str:
    """A parameter's value, or a table with its bounds where it is free."""
    value = _number_text(p.value, p.unit)
    if not free:
        return value
    ends = f", lower = {_number_text(p.lower, p.unit)}, upper = {_number_text(p.upper, p.unit)}" if bounds else ""
    return f"{{ value = {value}{ends}, free = true }}"


def _number_text(value: float, unit: str) -> str:
    text = write_value(value, unit)
    return text if unit == "1" else _quote(text)


def _quote(text: str) -> str:
    return f'"{text}"'


PLAYED_FILE, RUN_FILE = "moves.csv", "run.toml"  # not one name: run.toml would be taken for the sidecar of run.csv


def run_files(run: ExcitationRun, drive: str = "drive.toml") -> dict[str, str]:
    """The texts of both files, by their names; `drive` is the name of the drive's file."""
    columns = run.moves.trajectory(run.loop.pid.sample_time or 0.0)
    rows = zip(columns.t.tolist(), columns["reference"].tolist(), columns["reference_speed"].tolist(), strict=True)
    header = "time [s],position_reference [mm],speed_reference [m/s]"
    played = "\n".join([header, *(f"{t:.9g},{1e3 * r:.9g},{v:.6g}" for t, r, v in rows)]) + "\n"
    low, high = (write_value(x, "m", 3) for x in run.between)
    fast = write_value(run.fastest, "m/s", 3)
    trail = write_value(run.following_error, "m", 2)
    text = (
        f"An excitation run of {run.duration:.3g} s for the drive of {drive}, between {low} and {high}, at {fast} at "
        "most, made by pneuopt init --run. From its log alone friction (static, Coulomb, Stribeck, viscous), the "
        "valve's conductance and dead zone, and the mass are identified.",
        f"Play it: a plain position controller (below: proportional, no integral, which would hunt) follows "
        f"{PLAYED_FILE} from rest at its first position. Begin with a tenth of the gain, raise it while the axis does "
        f"not swing, and keep the end stops free. The axis trails by up to {trail}: that does no harm.",
        f"Log {', '.join(logged_channels(run))} at the controller's samples, from before the first move on.",
        f"Then: pneuopt identify {drive} LOG -o fit.toml",
        f"Simulated on the drive as guessed: pneuopt simulate {drive} {RUN_FILE} -o predicted.csv",
    )
    head = [line for part in text for line in comment_lines(part)]
    return {PLAYED_FILE: played, RUN_FILE: "\n".join([*head, *_run_sections(run)]) + "\n"}


def logged_channels(run: ExcitationRun) -> tuple[str, ...]:
    """What the run's log has to hold: the command, the position, and what pushes."""
    axis = run.loop.plant.axis
    assert axis is not None
    assert axis.final_element is not None
    return run.loop.command.name, run.loop.feedback.name, *axis.final_element.pushing


def _run_sections(run: ExcitationRun) -> Iterator[str]:
    """The lines of a run's loop and of its moves."""
    p, unit, loop = run.parameters, run.loop.command.unit, run.loop
    limits = (write_value(p.value(f"pid.{end}") + run.centre, unit) for end in ("lower", "upper"))
    gain = write_value(p.value("pid.Kp"), p["pid.Kp"].unit)
    yield from ["", "[loop]", f'measured = "{loop.feedback.name}"', "", "[pid]", 'form = "parallel"']
    yield f'sample_time = "{write_value(loop.pid.sample_time or 0.0, "s")}"'
    yield f'Kp = "{gain}"'
    yield "limits = [" + ", ".join(f'"{end}"' for end in limits) + "]"
    moves: Sequence[Move] = run.moves.moves
    first = moves[0]
    shared = {"speed": ("m/s", run.fastest), "acceleration": ("m/s^2", first.acceleration), "at": ("s", first.at)}
    yield from ["", "[[reference]]"]
    for name, (unit, value) in shared.items():
        yield f'{name} = "{write_value(value, unit)}"'
    yield f'initial = "{write_value(first.initial, "m")}"'
    yield "moves = ["
    for move in moves:
        own = {"distance": (move.distance, "m"), "speed": (move.speed, "m/s"), "dwell": (move.dwell, "s")}
        cells = ", ".join(f'{n} = "{write_value(value, unit)}"' for n, (value, unit) in own.items())
        yield f"  {{ {cells} }},"
    yield "]"
