"""`pneuopt init`: what it writes has every key, runs, and replaces nothing; a log's columns fill its sidecar."""

import json
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from typer.testing import CliRunner

from pneuopt.cli.app import app
from pneuopt.cli.init import Asker
from pneuopt.control.loop import ClosedLoop
from pneuopt.dynamics.simulate import simulate
from pneuopt.files.drive import FIT_SECTIONS, read_drive
from pneuopt.files.first_files import first_files, first_kinds
from pneuopt.files.keys import KeyRow, list_keys
from pneuopt.files.rig import read_rig
from pneuopt.files.study import read_axes, read_study
from pneuopt.files.tuning import TUNED_SECTIONS, Tuning, read_tuning
from pneuopt.identification.problem import check_logs
from pneuopt.logs.columns import Question
from pneuopt.logs.read_log import read_log
from pneuopt.models.drive_kinds import DRIVE_KINDS
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import Intersample, ParameterSet
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.quantities.units import read_value

KINDS = [name for name, kind in DRIVE_KINDS.items() if kind.first is not None]
FILES = ["drive.toml", "tuning.toml", "study.toml", "rig.toml", "log.toml"]
EXCLUSIVE = {
    "sensor",
    "pareto",
    "method",
    "samples",
    "corners",
    "table",
    "sensitivity",
}  # sections whose keys exclude each other, or another section
ENTRY = re.compile(r'(# )?("?[\w.]+"?) = (["\d{[-]|true|false).*')


def run(*words: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, list(words))
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.output


@pytest.fixture(scope="module", params=KINDS)
def folder(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    place: Path = tmp_path_factory.mktemp(request.param)
    code, output = run("init", request.param, "-o", str(place))
    assert code == 0, output
    return place


def read_all(folder: Path) -> Tuning:
    drive, given = read_drive(folder / "drive.toml")
    tuning = read_tuning(folder / "tuning.toml", drive.system())
    read_axes(read_study(folder / "study.toml"), given | tuning.parameters)
    read_rig(folder / "rig.toml", drive, tuning.loop)
    assert given.free_names
    assert tuning.parameters.free_names
    return tuning


def test_what_it_writes_is_read(folder: Path) -> None:
    tuning = read_all(folder)
    assert isinstance(tuning.loop, ClosedLoop)
    assert len(tuning.references) == 2


def rows_of(file: str, kind: str) -> list[KeyRow]:
    """The list's rows that concern a kind of drive."""
    heads = {r.section: r.kinds for r in list_keys() if r.file == file and not r.name}
    rows = [r for r in list_keys() if r.file == file]
    return [r for r in rows if all(not kinds or kind in kinds for kinds in (r.kinds, heads.get(r.section, ())))]


def sections(text: str) -> dict[str, list[str]]:
    """The lines of each section, whether it is stated or a comment."""
    found: dict[str, list[str]] = {"": []}
    name = ""
    for line in text.splitlines():
        head = re.fullmatch(r"(?:# )?\[+([\w.]+)\]+", line)
        name = head[1] if head else name
        found.setdefault(name, []).append(line)
    return found


@pytest.mark.parametrize("file", FILES)
def test_every_key_stands_in_it(folder: Path, file: str) -> None:
    text = (folder / file).read_text("utf-8")
    lines, missing = sections(text), []
    for row in rows_of(file, folder.name.rstrip("0123456789")):
        key = row.name.rpartition(".")[2]
        if row.section == "limits" and key in ("max", "min"):
            continue  # a limit alone is written without them
        where = text if "*" in row.name else "\n".join(lines.get(row.section, lines[""]))
        if not (key.startswith("<") or not key or re.search(rf'(^|[ {{])"?{key}"? = ', where, re.MULTILINE)):
            missing.append(row.full_name)
        if not key and row.section not in lines and f"# {row.section} = " not in text:
            missing.append(row.section)
    assert missing == []


class Comment(NamedTuple):
    """A line of a file that is a key behind a mark, with the lines that it needs: its section's head, and its size."""

    section: str
    key: str
    lines: frozenset[int]


def comments(text: str) -> list[Comment]:
    found, head, section, needed = [], -1, "", dict[int, set[int]]()
    for i, line in enumerate(text.splitlines()):
        if name := re.match(r"(?:# )?\[+(\w+)\]+$", line):
            head, section = i, name[1]
        entry = ENTRY.match(line)
        if entry and entry[1]:
            key = entry[2].strip('"')
            own = needed.setdefault(head, {head})
            own |= {i} if key in ("gain", "level", "amplitude", "width", "frequency", "model") else set()
            found.append((section, key, head, i))
    return [Comment(s, key, frozenset({i, *needed[h]} - {-1})) for s, key, h, i in found]


def without_marks(text: str, lines: Iterable[int]) -> str:
    edited = set(lines)
    return "\n".join(t.removeprefix("# ") if k in edited else t for k, t in enumerate(text.splitlines()))


def refusal(read: Callable[[Path], Any], path: Path) -> list[str]:
    try:
        read(path)
    except InputError as error:
        return [str(error)]
    return []


def test_every_commented_line_counts_without_its_mark(folder: Path, tmp_path: Path) -> None:
    """A line that its file, as it is, does not allow says its condition."""
    kind, drive = folder.name.rstrip("0123456789"), read_drive(folder / "drive.toml")[0]
    readers: dict[str, Callable[[Path], Any]] = {
        "drive.toml": read_drive,
        "tuning.toml": lambda path: read_tuning(path, drive.system()),
        "study.toml": read_study,
    }
    for file, read in readers.items():
        text, path = (folder / file).read_text("utf-8"), tmp_path / file
        conditions = {(r.section, r.name): r.key.condition for r in rows_of(file, kind)}
        free = [c for c in comments(text) if not conditions.get((c.section, c.key)) and c.section not in EXCLUSIVE]
        path.write_text(without_marks(text, frozenset().union(*(c.lines for c in free))), encoding="utf-8")
        if not refusal(read, path):
            continue
        for comment in free:  # which of them
            path.write_text(without_marks(text, comment.lines), encoding="utf-8")
            assert refusal(read, path) == [], f"{file} [{comment.section}] {comment.key}"
        pytest.fail(f"{file}: its lines count one by one, not together: {refusal(read, path)}")


def test_a_schema_knows_what_the_file_says(folder: Path) -> None:
    import tomllib

    for file in FILES:
        text = (folder / file).read_text("utf-8")
        place = re.match("#:schema (.*)\n", text)
        assert place is not None
        schema = json.loads((folder / place[1]).read_text("utf-8"))
        for name, entries in tomllib.loads(text).items():
            known = schema["properties"][name]
            known = known.get("items", known)
            if isinstance(entries, dict):
                assert set(known.get("required", [])) <= set(entries)
                assert known["additionalProperties"] or set(entries) <= set(known["properties"])


def names_in(schema: dict[str, Any], prefix: str = "") -> Iterator[str]:
    """The full names of the keys that a schema knows."""
    for part in (schema, schema.get("items", {}), *schema.get("anyOf", [])):
        for name, entry in part.get("properties", {}).items():
            yield f"{prefix}{name}"
            yield from names_in(entry, f"{prefix}{name}.")


@pytest.mark.parametrize("file", FILES)
def test_a_schema_has_every_key(folder: Path, file: str) -> None:
    name = "sidecar" if file == "log.toml" else file.removesuffix(".toml")
    known = set(names_in(json.loads((folder / "schemas" / f"{name}.json").read_text("utf-8"))))
    known |= {re.sub(r"\.\w+\.", ".*.", n) for n in known}
    rows = {r.full_name for r in rows_of(file, folder.name.rstrip("0123456789")) if "<" not in r.full_name}
    assert rows - known == set()
    results = {"drive.toml": {*FIT_SECTIONS}, "tuning.toml": {*TUNED_SECTIONS}}.get(file, set())
    assert {n.partition(".")[0] for n in known} - {r.partition(".")[0] for r in rows} == results


def test_the_loop_that_it_writes_runs(folder: Path) -> None:
    code, output = run("simulate", str(folder / "drive.toml"), str(folder / "tuning.toml"))
    assert code == 0, output
    assert "SettlingTime" in output


def write_log(folder: Path, path: Path) -> dict[str, float]:
    """A log of the drive with some parameters off, driven by its command in steps; what was changed."""
    drive, given = read_drive(folder / "drive.toml")
    system = drive.system()
    changed = {n: 1.2 * given.value(n) for n in given.free_names if given.value(n) > 0}
    t = np.arange(0.0, 2.0, 1e-3)
    command = system.inputs[0]
    size = {"V": 0.4, "N": 120.0, "N*m": 1.2}[command.unit]
    wave = size * np.sign(np.sin(2 * np.pi * 1.7 * t) + 0.3 * np.sin(2 * np.pi * 4.1 * t)) * (0.5 + 0.5 * np.sin(3 * t))
    run = simulate(system, Trajectory(t, {command.name: wave}), given.with_values(changed))
    names = [command, *system.outputs]
    head = ",".join(["time [s]", *(f"{q.name} [{q.unit}]" for q in names)])
    values = {**run.values, command.name: wave}
    rows = np.column_stack([t, *(values[q.name] for q in names)])
    path.write_text(head + "\n" + "\n".join(",".join(f"{v:.9g}" for v in row) for row in rows), encoding="utf-8")
    return changed


@pytest.mark.slow
def test_a_log_is_identified_and_the_loop_tuned(folder: Path, tmp_path: Path) -> None:
    fit, changed = tmp_path / "fit.toml", write_log(folder, tmp_path / "run.csv")
    code, output = run("identify", str(folder / "drive.toml"), str(tmp_path / "run.csv"), "-o", str(fit))
    assert code == 0, output
    found = read_drive(fit)[1]
    close = [n for n, value in changed.items() if abs(found.value(n) / value - 1) < 0.1]
    assert len(close) >= 0.5 * len(changed), output
    tuning = (folder / "tuning.toml").read_text("utf-8") + '[method]\nkind = "racing"\nmembers = 8\ntrials = 40\n'
    (tmp_path / "tuning.toml").write_text(tuning, encoding="utf-8")
    code, output = run("tune", str(fit), str(tmp_path / "tuning.toml"))
    assert code == 0, output


def test_old_files_stay_unless_forced(tmp_path: Path) -> None:
    (tmp_path / "tuning.toml").write_text("# mine\n", encoding="utf-8")
    code, output = run("init", "force", "-o", str(tmp_path))
    assert (code, "--force replaces it" in output) == (2, True)
    assert [p.name for p in tmp_path.iterdir()] == ["tuning.toml"]
    assert (tmp_path / "tuning.toml").read_text("utf-8") == "# mine\n"
    assert run("init", "force", "-o", str(tmp_path), "--force")[0] == 0
    assert run("init", "force", "-o", str(tmp_path))[0] == 0  # the same text is no loss
    read_all(tmp_path)


def test_the_catalogue_gives_cylinder_and_valve(tmp_path: Path) -> None:
    assert run("init", "pneumatic", "--size", "s25", "--valve", "1400", "-o", str(tmp_path))[0] == 0
    given = read_drive(tmp_path / "drive.toml")[1]
    assert (given.value("cylinder.bore"), given.value("valve.conductance")) == (0.025, 5.5e-8)
    assert given["valve.rounding"].source.startswith("default")  # the logs choose it
    assert "no single product" in (tmp_path / "drive.toml").read_text("utf-8")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "say what drives the load: pneuopt init KIND"),
        (["pneumtic"], "did you mean 'pneumatic'"),
        (["motion"], "unknown kind 'motion'"),
        (["force", "--size", "s25"], "--size is of the catalogue of pneumatic drives"),
        (["pneumatic", "--valve", "100"], "catalogue: unknown valve '100'"),
    ],
)
def test_what_cannot_be_written_is_said(words: list[str], message: str, tmp_path: Path) -> None:
    code, output = run("init", *words, "-o", str(tmp_path / "new"))
    assert (code, message in output) == (2, True), output
    assert not (tmp_path / "new").exists()


def test_a_quoted_value_stands_on_one_line(folder: Path) -> None:
    """Broken in two, "20 mm/s" can be neither read nor copied."""
    for file in sorted(folder.glob("*.toml")):
        torn = [line for line in file.read_text(encoding="utf-8").splitlines() if line.count('"') % 2]
        assert torn == [], file.name


def test_units_of_examples_read(folder: Path) -> None:
    for file in ("drive.toml", "tuning.toml"):
        for value in re.findall(r'^#? ?\w+ = "([-\d.e+]+ [^"(]+)"', (folder / file).read_text("utf-8"), re.MULTILINE):
            unit = value.partition(" ")[2]
            read_value(value, unit)


def test_the_sidecar_as_written_changes_nothing(folder: Path, tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_text("time [s],speed [m/s]\n" + "".join(f"{0.1 * i:.1f},{i}\n" for i in range(20)), encoding="utf-8")
    alone = read_log(log).trajectory
    (tmp_path / "log.toml").write_text((folder / "log.toml").read_text("utf-8"), encoding="utf-8")
    assert list(read_log(log).trajectory.values) == list(alone.values)


def test_on_a_terminal_the_user_is_asked(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    asked: list[str] = []
    answers = iter(["furlong", "m"])

    def prompt(text: str, default: str) -> str:
        asked.append(f"{text} {default}")
        return next(answers)

    monkeypatch.setattr("pneuopt.cli.init.typer.prompt", prompt)
    ask = Asker(interactive=True)
    assert ask(Question("position", "In which unit?", ("mm", "m"))) == "m"
    assert (asked, ask.assumed) == (["In which unit?\n  mm / m mm"] * 2, [])
    assert capsys.readouterr().out == "answer one of mm, m\n"


@pytest.mark.parametrize("answer", ["g", "(g)", " bar(g) "])
def test_a_question_takes_the_letter_that_it_names(answer: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pneuopt.cli.init.typer.prompt", lambda *_, **__: answer)
    ask = Asker(interactive=True)
    assert ask(Question("pressure_a", "Absolute (a), or gauge (g)?", ("bar(a)", "bar(g)"))) == "bar(g)"


def test_a_run_is_written_and_replaces_nothing(tmp_path: Path) -> None:
    drive = str(Path(__file__).parents[2] / "data" / "pneumatic_rig" / "drive.toml")
    limits = ("--between", "60mm..140mm", "--speed", "0.2m/s")
    code, said = run("init", "--run", drive, *limits, "-o", str(tmp_path))
    assert code == 0, said
    assert "between 60 mm and 140 mm, at 0.2 m/s at most" in said
    assert "Log valve_voltage, position, pressure_a, pressure_b" in said
    model, known = read_drive(drive)
    assert read_tuning(tmp_path / "run.toml", model.system(), known).loop.feedback.name == "position"
    assert read_log(tmp_path / "moves.csv").trajectory["position_reference"].max() == pytest.approx(0.14)
    (tmp_path / "moves.csv").write_text("mine", encoding="utf-8")
    code, said = run("init", "--run", drive, *limits, "-o", str(tmp_path))
    assert (code, "--force replaces it" in said) == (2, True)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("pneumatic", "--run", "d.toml"), "--run reads the drive from its file: leave out KIND"),
        (("--between", "1mm..2mm", "pneumatic"), "limits of a run: give --run DRIVE"),
        (("--run", "{drive}", "--between", "20mm"), "--between 20mm: give both ends, as in 20mm..180mm"),
        (("--run", "{drive}", "--between", "2mm..1mm"), "the first end must be below the second"),
        (("--run", "{drive}", "--sample-time", "0ms"), "--sample-time 0ms: give the controller's"),
        (("--run", "{drive}", "--speed", "1mm/s"), "does not tell viscous friction from Coulomb's; allow 50 mm/s"),
    ],
)
def test_a_run_that_cannot_be_is_refused_in_a_line(tmp_path: Path, words: tuple[str, ...], said: str) -> None:
    drive = Path(__file__).parents[2] / "data" / "pneumatic_rig" / "drive.toml"
    given = [word.format(drive=drive) for word in words]
    code, told = run("init", *given, "-o", str(tmp_path))
    assert (code, said in told.replace("\n", " ")) == (2, True), told
    assert not list(tmp_path.iterdir())


def write_foreign_log(path: Path, columns: str = "t_ms;U Ventil;x ist;p1 [bar];p2 [bar]") -> Path:
    t = np.arange(0.0, 400.0, 2.0)
    kinds = {
        "t_ms": t, "U Ventil": 5 + np.sign(np.sin(t / 30)), "x ist": 150 + 20 * np.sin(t / 60),
        "p1 [bar]": 4 + np.sin(t / 40), "p2 [bar]": 4 - np.sin(t / 40), "Kraft [N]": t, "M [N*m]": t, "v [m/s]": t,
    }  # fmt: skip
    rows = np.column_stack([kinds[name] for name in columns.split(";")])
    path.write_text("\n".join([columns, *(";".join(f"{v:.6g}" for v in row) for row in rows)]), encoding="utf-8")
    return path


def test_a_log_fills_its_sidecar_and_says_what_was_assumed(tmp_path: Path) -> None:
    log = write_foreign_log(tmp_path / "run.csv")
    code, output = run("init", "--from", str(log), "-o", str(tmp_path / "files"))
    assert code == 0, output
    assert max(map(len, output.replace(str(tmp_path), "").splitlines())) <= 80
    said = " ".join(output.split())
    assert "valve_voltage: column 'U Ventil' [V], less 5 V" in said
    assert "assumed, check it in [columns] of run.toml: position: 'x ist' reaches 170. In which unit? Taken: mm" in said
    assert "# Assumed, check it: position:" in (tmp_path / "run.toml").read_text("utf-8")
    drive, _ = read_drive(tmp_path / "files/drive.toml")
    read = read_log(log, plant=drive.system()).trajectory
    assert drive.kind == "pneumatic"
    assert [float(read[n].max()) for n in ("position", "pressure_a")] == pytest.approx([0.17, 5e5], rel=1e-3)
    tuning = read_tuning(tmp_path / "files/tuning.toml", drive.system())
    assert tuning.loop.pid.sample_time == 2e-3
    place = re.match("#:schema (.*)\n", (tmp_path / "run.toml").read_text("utf-8"))
    assert place is not None
    assert (tmp_path / place[1]).resolve() == (tmp_path / "files/schemas/sidecar.json").resolve()


def test_a_valve_of_0_to_10_v_gets_the_limits_of_its_wire(tmp_path: Path) -> None:
    log = write_foreign_log(tmp_path / "run.csv")
    assert run("init", "--from", str(log), "-o", str(tmp_path / "five"))[0] == 0
    assert 'limits = ["-5 V", "5 V"]' in (tmp_path / "five" / "tuning.toml").read_text("utf-8")
    log.write_text(log.read_text("utf-8").replace(";6;", ";5.5;").replace(";4;", ";4.6;"), encoding="utf-8")
    code, output = run("init", "--from", str(log), "-o", str(tmp_path / "wire"), "--force")
    assert (code, "its centre, near 5 V, is estimated" in " ".join(output.split())) == (0, True)
    assert 'limits = ["0 V", "10 V"]' in (tmp_path / "wire" / "tuning.toml").read_text("utf-8")


def test_a_second_log_gets_its_sidecar_beside_files_that_were_edited(tmp_path: Path) -> None:
    logs = [write_foreign_log(tmp_path / f"run_{k}.csv") for k in (1, 2)]
    assert run("init", "--from", str(logs[0]), "-o", str(tmp_path))[0] == 0
    (tmp_path / "drive.toml").write_text("# mine\n", encoding="utf-8")
    code, output = run("init", "--from", str(logs[1]), "-o", str(tmp_path))
    assert code == 0, output
    assert "wrote run_2.toml in" in output
    assert (tmp_path / "drive.toml").read_text("utf-8") == "# mine\n"
    (tmp_path / "run_2.toml").write_text("# mine\n", encoding="utf-8")
    code, output = run("init", "--from", str(logs[1]), "-o", str(tmp_path))
    assert (code, "run_2.toml: is there already" in output) == (2, True)


@pytest.mark.parametrize(
    ("columns", "kind"),
    [
        ("t_ms;Kraft [N];x ist", "force"),
        ("t_ms;Kraft [N];U Ventil;x ist", "force"),
        ("t_ms;M [N*m]", "rotary"),
        ("t_ms;U Ventil;v [m/s]", "linear"),
        ("t_ms;U Ventil;x ist", "pneumatic"),  # the linear kind reads no position
    ],
)
def test_a_log_says_what_drives_the_load(columns: str, kind: str, tmp_path: Path) -> None:
    log = write_foreign_log(tmp_path / "run.csv", columns)
    code, output = run("init", "--from", str(log), "-o", str(tmp_path))
    assert code == 0
    assert f"by the log's columns a {kind} drive" in " ".join(output.split())
    assert read_drive(tmp_path / "drive.toml")[0].kind == kind


def test_another_kind_than_the_guessed_one_is_written_as_the_screen_says(tmp_path: Path) -> None:
    """A voltage and a position may be a motor's, too: the command that is shown replaces the files of the guess."""
    log = write_foreign_log(tmp_path / "run.csv", "t_ms;U Ventil;x ist")
    _, output = run("init", "--from", str(log), "-o", str(tmp_path))
    shown = next(line for line in output.splitlines() if "pneuopt init KIND" in line).split()
    code, output = run("init", "force", *shown[shown.index("--from") :], "-o", str(tmp_path))
    assert code == 0, output
    assert read_drive(tmp_path / "drive.toml")[0].kind == "force"


def test_a_channel_that_the_drive_does_not_use_is_left_out(tmp_path: Path) -> None:
    log = write_foreign_log(tmp_path / "run.csv", "t_ms;Kraft [N];U Ventil;x ist;p1 [bar]")
    code, output = run("init", "force", "--from", str(log), "-o", str(tmp_path))
    assert code == 0, output
    assert "valve_voltage: left out, column 'U Ventil': this kind of drive does not use it" in output
    drive, _ = read_drive(tmp_path / "drive.toml")
    system = drive.system()
    check_logs(system, read_log(log, plant=system), system.parameters)
    assert "valve_voltage = false" in log.with_suffix(".toml").read_text("utf-8")


@pytest.mark.parametrize(("kind", "command", "scale"), [("force", "force", "1 N/V"), ("rotary", "torque", "1 N*m/V")])
def test_a_voltage_beside_no_force_is_said_to_be_its_command(
    kind: str, command: str, scale: str, tmp_path: Path
) -> None:
    log = write_foreign_log(tmp_path / "run.csv", "t_ms;U Ventil;x ist")
    code, output = run("init", kind, "--from", str(log), "-o", str(tmp_path))
    entry = f'{command} = {{ column = "U Ventil", unit = "V", scale = "{scale}" }}'
    assert (code, entry in " ".join(output.split())) == (0, True), output
    assert f'[intersample] {command} = "held"' in output
    sidecar = log.with_suffix(".toml").read_text("utf-8").replace("\n[columns]", f"\n[columns]\n{entry}")
    log.with_suffix(".toml").write_text(f'{sidecar}\n[intersample]\n{command} = "held"\n', encoding="utf-8")
    system = read_drive(tmp_path / "drive.toml")[0].system()
    assert read_log(log, plant=system).intersample[command] is Intersample.HELD
    beside = write_foreign_log(tmp_path / "beside.csv", "t_ms;Kraft [N];U Ventil;x ist")
    assert "commands it" not in run("init", "force", "--from", str(beside), "-o", str(tmp_path))[1]


def test_a_log_that_does_not_is_met_with_a_question(tmp_path: Path) -> None:
    log = write_foreign_log(tmp_path / "run.csv", "t_ms;x ist")
    code, output = run("init", "--from", str(log))
    assert (code, "do not say what drives the load; say it before --from" in output) == (2, True)
    log = write_foreign_log(tmp_path / "drive.csv")
    code, output = run("init", "--from", str(log), "-o", str(tmp_path))
    assert (code, "rename it; drive.toml is the name of another file" in output) == (2, True)
    assert not (tmp_path / "drive.toml").exists()


@pytest.mark.parametrize("kind", sorted(first_kinds()))
@pytest.mark.parametrize("sample_time", [1e-4, 1e-3, 5e-3, 0.02])
def test_the_first_dither_can_be_sampled_by_a_controller_as_slow_as_the_log(
    kind: str, sample_time: float, tmp_path: Path
) -> None:
    files = first_files(kind, ParameterSet({}), {}, sample_time=sample_time)
    for name in ("drive.toml", "tuning.toml"):
        (tmp_path / name).write_text(files[name], encoding="utf-8")
    loop = read_tuning(tmp_path / "tuning.toml", read_drive(tmp_path / "drive.toml")[0].system()).loop
    if loop.dither is not None:
        loop.dither.check(loop.parameters.value("dither.frequency"), loop.pid.sample_time)


def _write_counted(path: Path, *, step: float, noise: float = 0.0, speed: bool = False) -> None:
    """A log of a force drive, its position in whole steps [mm], or noisy, and its speed beside on request."""
    t = np.arange(600) * 2e-3
    true = 40 + 20 * np.sin(2 * np.pi * 0.7 * t) + noise * np.random.default_rng(1).standard_normal(t.size)
    rows = zip(t, 30 * np.cos(9 * t), step * np.round(true / step) if step else true, strict=True)
    head = "t [s],force [N],position [mm]" + (",speed [m/s]" if speed else "")
    tail = ",0.1" if speed else ""
    path.write_text("\n".join([head, *(f"{a:.4f},{f:.3f},{x:.6f}{tail}" for a, f, x in rows)]) + "\n")


def test_a_loop_sees_its_speed_through_the_encoder_that_the_log_shows(tmp_path: Path) -> None:
    """One count of 20 um; where the position is noisy, or the speed was logged, no encoder is assumed."""
    _write_counted(tmp_path / "counted.csv", step=0.02)
    _write_counted(tmp_path / "noisy.csv", step=0.0, noise=0.05)
    _write_counted(tmp_path / "tacho.csv", step=0.02, speed=True)
    for name in ("counted", "noisy", "tacho"):
        code, output = run("init", "force", "--from", str(tmp_path / f"{name}.csv"), "-o", str(tmp_path / name))
        assert code == 0, output
    found = {name: read_all(tmp_path / name) for name in ("counted", "noisy", "tacho")}
    assert {name: task.loop.sensor is not None for name, task in found.items()} == {
        "counted": True,
        "noisy": False,
        "tacho": False,
    }
    assert found["counted"].parameters.value("sensor.resolution") == pytest.approx(20e-6)


def test_a_speed_that_no_log_holds_is_said_to_have_no_sensor(tmp_path: Path) -> None:
    """The controller would differentiate the position; of a logged speed, and of a stated sensor, nothing is said."""
    assert run("init", "force", "-o", str(tmp_path))[0] == 0
    drive, tuning = ((tmp_path / n).read_text("utf-8") for n in ("drive.toml", "tuning.toml"))
    seen = tuning.replace("# [sensor]", "[sensor]").replace('# lag = "5 ms"', 'lag = "5 ms"')
    said = []
    for logged, text in (("position", tuning), ("speed", tuning), ("position", seen)):
        (tmp_path / "fit.toml").write_text(f"{drive}\n[agreement.run]\n{logged} = {{ rmse = 1e-5 }}\n", "utf-8")
        (tmp_path / "tuning.toml").write_text(text, "utf-8")
        _, output = run("certify", str(tmp_path / "fit.toml"), str(tmp_path / "tuning.toml"))
        said.append("no sensor may give it" in " ".join(output.split()))
    assert said == [True, False, False]
