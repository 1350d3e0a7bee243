"""Every key that a reader accepts stands in the list of keys, and nothing else does: the readers are asked."""

import re
from collections import defaultdict
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from pneuopt.control.loop import ClosedLoop
from pneuopt.files.drive import read_drive
from pneuopt.files.keys import KeyRow, list_keys
from pneuopt.files.rig import read_rig
from pneuopt.files.study import read_axes, read_study
from pneuopt.files.tuning import read_tuning
from pneuopt.logs.read_log import read_log
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import FRICTION_LAWS, FRICTION_WRAPPERS, Coulomb
from pneuopt.quantities.errors import InputError

STRANGER = "qqqq"  # near no key, so that the message lists them all
DRIVE = ForceDrive(Coulomb())
PID = '[pid]\nsample_time = "1 ms"\nKp = "1 N*s/m"\n'
REFERENCE = '[[reference]]\nstep = "0.1 m/s"\nhorizon = "1 s"\n'
BLOCKS = {
    "load": ["", "spring = true", "inclined = true"],
    "cylinder": ["", "stops = false"],
    "chamber": ["", "mixed = true", "model = 'thermal'"],
    "valve": ["", "law = 'isentropic'", "spool = 'rigid'"],
    "rig": ["", "chamber = false"],
}
KINDS = {
    "pneumatic": ["cylinder", "valve", "supply", "gas", "chamber", "ambient", "load", "friction"],
    "force": ["load", "ambient", "friction"],
    "motion": ["rig", "ambient", "friction"],
    "rotary": ["load", "friction"],
    "linear": ["plant", "friction"],
}


def accepted(read: Callable[[Path], Any], path: Path, text: str, section: str = "") -> set[str]:
    """The keys that a reader lists when it meets a stranger in a section."""
    line = f"[{section}]\n{STRANGER} = 1\n" if f"[{section}]" not in text else ""
    at = (
        text.replace(f"[{section}]\n", f"[{section}]\n{STRANGER} = 1\n", 1) + line
        if section
        else f"{STRANGER} = 1\n{text}"
    )
    path.write_text(at, encoding="utf-8")
    with pytest.raises(InputError, match=f"unknown .* '{STRANGER}'; known: ") as raised:
        read(path)
    return set(re.sub(".*; known: ", "", str(raised.value)).split(", "))


def listed(file: str, section: str, chosen: Callable[[KeyRow], bool] = lambda _: True) -> set[str]:
    """The keys of a section in the list, without those that a user names."""
    rows = (r for r in list_keys() if r.file == file and r.section == section and chosen(r))
    return {r.name for r in rows if r.name and "." not in r.name and "<" not in r.name}


def laws(kind: str) -> list[str]:
    wrapped = [f"model = 'coulomb'\n{wrapper} = true" for wrapper in FRICTION_WRAPPERS]
    skipped = {"motion": "load_dependent", "rotary": "pressure", "linear": "_dependent"}.get(kind, "-")
    return [f"model = '{law}'" for law in FRICTION_LAWS] + [w for w in wrapped if skipped not in w]


@pytest.mark.parametrize("kind", KINDS)
def test_a_drives_keys_are_those_of_its_reader(kind: str, tmp_path: Path) -> None:
    known = defaultdict[str, set[str]](set)
    plants = [f"model = '{m}'" for m in ("second_order", "first_order", "integrator")] if kind == "linear" else [""]
    plants += ["model = 'second_order'\npade_order = 1"] if kind == "linear" else []
    for section in KINDS[kind]:
        blocks = laws(kind) if section == "friction" else plants if section == "plant" else BLOCKS.get(section, [""])
        blocks = [b for b in blocks if kind in ("pneumatic", "force") or section != "load"] or [""]
        for block in blocks:
            friction = laws(kind)[-1] if section == "ambient" else "model = 'coulomb'"
            friction = "" if ("order'" in block and "second" not in block) or "integrator" in block else friction
            said = {"friction": friction, "plant": "model = 'second_order'", section: block}
            body = "".join(f"[{s}]\n{said.get(s, '')}\n" for s in KINDS[kind] if said.get(s) or s == section)
            known[section] |= accepted(
                read_drive, tmp_path / "drive.toml", f"[drive]\nkind = '{kind}'\n{body}", section
            )
    for section, keys in known.items():
        assert keys == listed("drive.toml", section, lambda r: not r.kinds or kind in r.kinds), section
    assert set(KINDS[kind]) == {
        r.section for r in list_keys() if r.file == "drive.toml" and not r.name and (not r.kinds or kind in r.kinds)
    } - {"drive"}


def read_loop(path: Path) -> Any:
    return read_tuning(path, DRIVE.system())


def test_a_tunings_keys_are_those_of_its_reader(tmp_path: Path) -> None:
    path, rest = tmp_path / "tuning.toml", PID + REFERENCE
    assert accepted(read_loop, path, rest) == {r.section for r in list_keys() if r.file == "tuning.toml"}
    forms = {"parallel": "Kp = '1 N*s/m'", "standard": "Kp = '1 N*s/m'", "series": "K = '1 N*s/m'"}
    pids = [
        f"[pid]\nform = '{f}'\n{gain}\nlimits = ['-1 N', '1 N']\ndead_band = '1 mm/s'\n"
        "sample_time = '1 ms'\nreset_ratio = 1\n"
        for f, gain in forms.items()
    ]
    gains = set().union(*(accepted(read_loop, path, pid + REFERENCE, "pid") for pid in pids))
    assert gains == listed("tuning.toml", "pid")
    needed = {
        "loop": "", "dither": "frequency = '20 Hz'", "sensor": "lag = '1 ms'", "feedforward": "gain = '1 N*s/m'",
        "friction_feedforward": "level = '1 N'", "knocker": "amplitude = '1 N'",
        "impulsive_control": "amplitude = '1 N'", "dead_zone_inverse": "width = '1 N'",
        "minimise": "", "limits": "", "scenarios": "", "budget": "",
    }  # fmt: skip
    for section, line in needed.items():
        read = read_loop if section != "scenarios" else lambda p: read_loop(p).scenarios(read_loop(p).parameters)
        assert accepted(read, path, f"{rest}[{section}]\n{line}\n", section) == listed("tuning.toml", section), section
    kinds = ("racing", "two_phase")
    options = [accepted(read_loop, path, f"{rest}[method]\nkind = '{k}'\n", "method") for k in kinds]
    assert set().union(*options) == listed("tuning.toml", "method")
    step = accepted(read_loop, path, PID + REFERENCE.replace("[[reference]]", "[[reference]]\nqqqq = 1"), "loop")
    assert step == listed("tuning.toml", "loop")
    path.write_text(PID + REFERENCE + f"{STRANGER} = 1\n", encoding="utf-8")
    with pytest.raises(InputError) as raised:
        read_loop(path)
    assert set(str(raised.value).partition("; known: ")[2].split(", ")) == listed("tuning.toml", "reference")


def test_the_keys_within_a_requirement_are_those_of_its_reader(tmp_path: Path) -> None:
    for section, name in product(
        ("minimise", "limits"), ("settling_time", "step_envelope", "overshoot", "gain_margin")
    ):
        text = f"{PID}{REFERENCE}[{section}]\n{name} = {{ {STRANGER} = 1 }}\n"
        (tmp_path / "tuning.toml").write_text(text, encoding="utf-8")
        with pytest.raises(InputError) as raised:
            read_loop(tmp_path / "tuning.toml")
        known = set(str(raised.value).partition("; known: ")[2].split(", "))
        rows = [r.full_name for r in list_keys() if r.file == "tuning.toml"]
        assert known == {k for k in known if f"{section}.{name}.{k}" in rows or f"{section}.*.{k}" in rows}
        assert {r.split(".")[-1] for r in rows if r.startswith(f"{section}.{name}.")} <= known


def test_a_studys_keys_are_those_of_its_reader(tmp_path: Path) -> None:
    path = tmp_path / "study.toml"
    base = "[study]\ndrive = 'd'\ntuning = 't'\n"
    assert accepted(read_study, path, base) == {r.section for r in list_keys() if r.file == "study.toml"}
    grid = base + "[axes]\n'load.mass' = ['1 kg', '2 kg']\n"
    for section in ("study", "metrics", "pareto"):
        assert accepted(read_study, path, grid, section) == listed("study.toml", section)
    parameters = DRIVE.system().parameters
    path.write_text(f"{base}[axes]\n'load.mass' = {{ from = '1 kg', {STRANGER} = 1 }}\n", encoding="utf-8")
    with pytest.raises(InputError, match="known: from, steps, to"):
        read_axes(read_study(path), parameters)


def test_a_rigs_keys_are_those_of_its_reader(tmp_path: Path) -> None:
    import pneuopt as po

    def read(path: Path) -> Any:
        return read_rig(path, DRIVE, ClosedLoop(DRIVE.system(), po.PID(sample_time=1e-3)))

    path = tmp_path / "rig.toml"
    assert accepted(read, path, "") == {r.section for r in list_keys() if r.file == "rig.toml"}
    for section in ("actuator", "encoder"):
        assert accepted(read, path, "", section) == listed("rig.toml", section)
    rows = {r.name for r in list_keys() if r.file == "rig.toml" and r.section == "sensors"}
    assert {f"<output>.{k}" for k in accepted(read, path, "", "sensors.speed")} == rows - {"", "<output>"}


def test_a_sidecars_keys_are_those_of_its_reader(tmp_path: Path) -> None:
    log, side = tmp_path / "log.csv", tmp_path / "log.toml"
    log.write_text("t,x\n" + "".join(f"{0.1 * i},{i}\n" for i in range(20)), encoding="utf-8")
    assert accepted(lambda _: read_log(log), side, "") == {r.section for r in list_keys() if r.file == "log.toml"}
    assert accepted(lambda _: read_log(log), side, "", "columns") == listed("log.toml", "columns")
    side.write_text(f"[columns]\ntime = {{ column = 't', {STRANGER} = 1 }}\n", encoding="utf-8")
    with pytest.raises(InputError) as raised:
        read_log(log)
    known = {f"*.{k}" for k in str(raised.value).partition("; known: ")[2].split(", ")}
    assert known == {r.name for r in list_keys() if r.file == "log.toml" and r.name.startswith("*.")}


def test_every_key_says_what_it_is() -> None:
    assert [r.full_name for r in list_keys() if not r.key.meaning] == []
