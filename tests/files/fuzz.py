"""Reads mutated TOML files: ``python -m tests.files.fuzz CASES [SEED]`` prints what came of them.

The files that `pneuopt init` writes for each kind of drive, and results made of them, are mutated in values, keys,
nesting and bytes. A case passes if it is read, or refused by one of our own errors in one line.
"""

import io
import random
import re
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import tomlkit

from pneuopt.cli.init import run_init
from pneuopt.control.loop import ClosedLoop
from pneuopt.files.drive import read_drive, read_fit
from pneuopt.files.loop import bound_units
from pneuopt.files.rig import read_rig
from pneuopt.files.study import read_axes, read_pareto, read_study
from pneuopt.files.tuned import check_certificate, checksum_section
from pneuopt.files.tuning import Tuning, read_tuning
from pneuopt.models.declaration import Drive
from pneuopt.quantities.parameters import ParameterSet
from tests.fuzzing import Report

KINDS = ("pneumatic", "force", "rotary", "linear")
RESULT = """
[estimates]
"friction.coulomb" = { value = 40.0, stderr = 1.0, dof = 30.0, bias = 3.0, mark = "exact" }
[covariance]
"friction.coulomb" = [1.0]
[status]
code = "converged"
message = "converged"
[verdict]
sentences = []
[provenance]
pneuopt = "0.2"
"""
SCENARIOS = """
[scenarios.corners]
"load.mass" = "30 %"
[scenarios.samples]
count = 3
seed = 1
"load.mass" = "30 %"
"""
CERTIFICATE = """
[certified]
"0 to 0.1" = { SettlingTime = 0.3, Overshoot = 2.0 }
[wire]
centre = "5 V"
[status]
code = "converged"
message = "certified objective 0.3"
[provenance]
pneuopt = "0.2"
"""
VALUES = (
    *('"1e999 N"', '"-1e-999 m"', '"inf m/s"', '"nan"', "nan", "inf", "-inf", "1e308", "0", "-1", "1", "true", "[1]"),
    *("[]", "{}", '""', '"1 bar"', '"1 mm**9e9"', '"1 m^(99)^99"', "9" * 5000, '"' + "9" * 5000 + ' N"', "1979-05-27"),
    *("[" * 60 + "]" * 60, "[" * 2000 + "]" * 2000, '{ value = "1 m" }', '{ value = "1 m", lower = "2 m" }', "1e8"),
    *('{ from = "1 kg", to = "2 kg", steps = 1000000000 }', "{ value = [1] }", '["1 V", 2]', '[["0 s", "1 %"]]'),
    *(
        '"\\u0000"',
        "'" + "a" * 9999 + "'",
        "12:00:00",
        "0x7fffffffffffffff",
        "100000000",
        '"5 kg"',
        '"30 %"',
        '"40 N"',
    ),
)
KEYS = ("Kp", "seed", "count", "kind", "model", "value", "pressure", "a.b", '""', "x" * 500, '"load.mass"', "steps")


@dataclass(frozen=True)
class Base:
    """The valid files of a kind of drive, and what they make."""

    folder: Path
    texts: Mapping[str, str]
    drive: Drive
    parameters: ParameterSet
    tuning: Tuning


def fuzz(cases: int, seed: int, kinds: tuple[str, ...] = KINDS) -> Report:
    """Read mutated files of these kinds of drives."""
    rng, report = random.Random(seed), Report()
    with tempfile.TemporaryDirectory() as folder:
        bases = {kind: _write_base(kind, Path(folder) / kind) for kind in kinds}
        for _ in range(cases):
            kind = rng.choice(kinds)
            name = rng.choice(sorted(bases[kind].texts))
            _try(report, f"{kind} {name}", bases[kind], name, _mutate(rng, bases[kind].texts[name]))
    return report


def _write_base(kind: str, folder: Path) -> Base:
    folder.mkdir()
    with redirect_stdout(io.StringIO()):
        run_init(kind, folder, {"size": None, "cylinder": None, "valve": None}, None, force=True)
    texts = {
        name: (folder / name).read_text("utf-8") for name in ("drive.toml", "tuning.toml", "study.toml", "rig.toml")
    }
    if kind != "linear":
        texts["tuning.toml"] += SCENARIOS.replace("mass", "inertia" if kind == "rotary" else "mass")
    texts["fit.toml"] = texts["drive.toml"] + RESULT
    drive, parameters = read_drive(folder / "drive.toml")
    (folder / "fit.toml").write_text(texts["fit.toml"], "utf-8")
    document = tomlkit.parse(texts["tuning.toml"] + CERTIFICATE)
    document["checksum"] = checksum_section(document.unwrap(), folder / "tuned.toml", read_fit(folder / "fit.toml"))
    texts["tuned.toml"] = tomlkit.dumps(document)
    return Base(folder, texts, drive, parameters, read_tuning(folder / "tuning.toml", drive.system(), parameters))


def _read(base: Base, name: str, path: Path) -> str:
    """Read a file as the commands do; nothing is wrong with what is read."""
    loop: ClosedLoop = base.tuning.loop
    if name in ("drive.toml", "fit.toml"):
        fit = read_fit(path)
        for part in ("status", "marks", "covariance", "estimates", "noise", "assumed_options"):
            getattr(fit, part)
    elif name == "tuning.toml":
        task = read_tuning(path, base.drive.system(), base.parameters)
        given = base.parameters.fixed(*base.parameters.free_names) | task.parameters
        task.scenarios(given)
        task.validation_scenarios(given)
    elif name == "tuned.toml":
        check_certificate(read_fit(base.folder / "fit.toml"), path)
    elif name == "rig.toml":
        read_rig(path, base.drive, loop)
    else:
        study = read_study(path)
        if study.pareto is None:
            read_axes(study, base.parameters | base.tuning.parameters)
        else:
            read_pareto(study, bound_units(loop))
    return ""


def _try(report: Report, label: str, base: Base, name: str, raw: bytes) -> None:
    path = base.folder / f"mutated_{name}"
    path.write_bytes(raw)
    report.count(label, lambda: _read(base, name, path), raw)


def _mutate(rng: random.Random, text: str) -> bytes:
    lines = [line for line in text.split("\n") if line.strip() and (line[0] != "#" or " = " in line)] or [""]
    kinds: list[Callable[[random.Random, list[str]], None]] = [_value, _value, _word, _word, _key, _section, _commented]
    for _ in range(rng.choice([1, 1, 1, 2, 4])):
        rng.choice(kinds)(rng, lines)
        lines = lines or [""]
    raw = "\n".join(lines).encode()
    return _bytes(rng, raw) if rng.random() < 0.15 else raw


def _entry(rng: random.Random, lines: list[str]) -> int:
    return rng.choice([i for i, line in enumerate(lines) if " = " in line] or [0])


def _value(rng: random.Random, lines: list[str]) -> None:
    """Another value, of any type."""
    i = _entry(rng, lines)
    lines[i] = f"{lines[i].partition(' = ')[0]} = {rng.choice(VALUES)}"


def _word(rng: random.Random, lines: list[str]) -> None:
    """A number within a value, of which units and types stay."""
    i = _entry(rng, lines)
    key, equals, value = lines[i].partition(" = ")
    numbers = list(re.finditer(r"\d+\.?\d*(?:e-?\d+)?", value))
    if numbers:
        chosen = rng.choice(numbers)
        other = rng.choice(["0", "1", "-1", "1e9", "1e-9", "1e308", "2", f"{float(chosen[0]) * rng.uniform(0.5, 2):g}"])
        lines[i] = key + equals + value[: chosen.start()] + other + value[chosen.end() :]


def _key(rng: random.Random, lines: list[str]) -> None:
    """A key more, less, twice, or by another name."""
    i, kind = _entry(rng, lines), rng.randrange(4)
    if kind == 0:
        lines.insert(i, f"{rng.choice(KEYS)} = {rng.choice(VALUES)}")
    elif kind == 1 and len(lines) > 1:
        del lines[i]
    elif kind == 2:
        lines.insert(i, lines[i])
    else:
        lines[i] = f"{rng.choice(KEYS)} = {lines[i].partition(' = ')[2]}"


def _section(rng: random.Random, lines: list[str]) -> None:
    """A section as a list, within another, twice, or as a value."""
    heads = [i for i, line in enumerate(lines) if line.startswith("[")]
    if not heads:
        return
    i = rng.choice(heads)
    name = lines[i].strip("[]")
    odd = (f"[[{name}]]", f"[{name}.{name}]", f"[{rng.choice(KEYS)}]", "[a.b.c.d]", f"[{name}]", "")
    lines[i] = rng.choice(odd)


def _commented(rng: random.Random, lines: list[str]) -> None:
    """An entry that init has written as a comment."""
    hidden = [i for i, line in enumerate(lines) if re.match(r"\s*#\s*[\w\".]+ = ", line)]
    if hidden:
        i = rng.choice(hidden)
        lines[i] = lines[i].replace("#", "", 1).strip()


def _bytes(rng: random.Random, raw: bytes) -> bytes:
    """Bytes changed, cut out, put in, or the file cut."""
    changed, i = bytearray(raw), rng.randrange(max(len(raw), 1))
    kind = rng.randrange(4)
    if kind == 0:
        changed[i : i + 1] = bytes([rng.randrange(256)])
    elif kind == 1:
        del changed[i : i + rng.choice([1, 2, 50])]
    elif kind == 2:
        changed[i:i] = rng.randbytes(rng.choice([1, 4]))
    else:
        del changed[i:]
    return bytes(changed)


if __name__ == "__main__":
    _, count, start, *chosen = (*sys.argv, *("0",)[len(sys.argv) - 2 :])
    result = fuzz(int(count), int(start), tuple(chosen) or KINDS)
    sys.stdout.write(f"{result}\n")
    seen = Counter[str]()
    for label, fault, raw, _ in result.failures:
        seen[fault[:60]] += 1
        if seen[fault[:60]] <= 2:
            sys.stdout.write(f"\n{label}: {fault}\n{raw[:3000].decode(errors='replace')}\n")
