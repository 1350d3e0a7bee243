"""Certificates after something was changed: is it noticed, and in the exported file itself?

    python problems/demo/forged_certificates.py [--json FILE]

A linear drive's gains are certified by `pneuopt certify`, and a tuning is refused. Then one thing is changed at a time,
by hand: a gain, the dither, the limits of the command or of the design, the reference, the sample time, the plant, a
figure or the status of the certificate. Rows forgery.*: of the exports as C, structured text, Python and the settings
of a maker's block (which takes no dither) how many are refused, and with --uncertified say in their file what was
changed. Rows unforged.*: of these, how many still say "Certified" after an edit that changes no meaning.

Rows certify.*: exit status and file of `certify` on edited gains that hold, and on others that do not; by how much they
break their limit. Row best.refused: whether `export` refuses the best candidate of the tuning that was refused.
"""

import re
import shutil
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import tomlkit
from typer.testing import CliRunner, Result

import pneuopt as po
from pneuopt.cli.app import app
from problems.shared.claims import Claim, arguments, finish, frame

if TYPE_CHECKING:
    import pandas as pd

DRIVE = """
[drive]
kind = "linear"
[plant]
model = "first_order"
gain = "0.12 (m/s)/V"
time_constant = "200 ms"
dead_time = "10 ms"
"""
GIVEN = """# axis 7
[pid]
form = "parallel"
sample_time = "10 ms"
limits = ["-5 V", "5 V"]
Kp = { value = "8 V*s/m", lower = "0.1 V*s/m", upper = "30000 V*s/m", free = true }
Ki = { value = "50 V/m", lower = "1 V/m", upper = "2000 V/m", free = true }
Kd = "0.02 V*s^2/m"
Tf = "20 ms"
b = 0.9
[[reference]]
step = "0.2 m/s"
horizon = "2 s"
[minimise]
settling_time = { band = "2 %" }
[limits]
overshoot = "5 %"
max_sensitivity = 1.6
"""
FILES = {"c": "controller.c", "st": "controller.st", "python": "controller.py", "siemens": "controller_siemens.txt"}


FORGERIES: Mapping[str, tuple[str, str, str, str]] = {
    "Kp": ("tuned", '"8 V*s/m"', '"20000 V*s/m"', "pid.Kp was changed after tuning (8 V*s/m -> 20000 V*s/m)"),
    "Ki": ("tuned", '"50 V/m"', '"51 V/m"', "pid.Ki was changed after tuning (50 V/m -> 51 V/m)"),
    "Kd": ("tuned", '"0.02 V*s^2/m"', '"0.03 V*s^2/m"', "pid.Kd was changed after tuning"),
    "Tf": ("tuned", '"20 ms"', '"2 ms"', "pid.Tf was changed after tuning (20 ms -> 2 ms)"),
    "b": ("tuned", "b = 0.9", "b = 1", "pid.b was changed after tuning (0.9 -> 1)"),
    "dither": ("dither", '"50 mV"', '"1 V"', "dither.amplitude was changed after tuning (0.05 V -> 1 V)"),
    "range": ("tuned", '["-5 V"', '["-10 V"', "pid.limits, the lower one was changed after tuning (-5 V -> -10 V)"),
    "limit": ("tuned", '"5 %"', '"50 %"', "[limits] overshoot.max was changed after tuning (5 % -> 50 %)"),
    "reference": ("tuned", '"0.2 m/s"', '"0.3 m/s"', "reference 1 step was changed after tuning (0.2 m/s -> 0.3 m/s)"),
    "samples": ("tuned", '"10 ms"', '"20 ms"', "pid.sample_time was changed after tuning (10 ms -> 20 ms)"),
    "plant": ("fit", '"0.12 (m/s)/V"', '"0.24 (m/s)/V"', "the plant's plant.gain was changed after tuning (0.12"),
    "figures": ("tuned", "Overshoot = ", "Overshoot = 1", "the row of '0 to 0.2' in [certified] was changed"),
    "status": ("failed_best", f'"{po.Code.INFEASIBLE.value}"', '"converged"', "the status was changed after tuning"),
    "by hand": (
        "given",
        "[[reference]]",
        '[status]\ncode = "converged"\n[[reference]]',
        "it was written by an older version, or by hand",
    ),
}
UNFORGED: Mapping[str, Callable[[str], str]] = {
    "comments": lambda text: text.replace("\n", "  # a note\n", 3),
    "units": lambda text: (
        text.replace('"20 ms"', '"0.02 s"').replace('"8 V*s/m"', '"8e3 mV*s/m"').replace('"5 %"', "0.05")
    ),
    "order": lambda text: tomlkit.dumps(dict(reversed(tomlkit.parse(text).unwrap().items()))),
    "tomlkit": lambda text: tomlkit.dumps(tomlkit.parse(text)),
    "moved": lambda text: text,
}


def run(line: str) -> Result:
    """A command of pneuopt, its words separated by blanks."""
    return CliRunner().invoke(app, line.split(), catch_exceptions=False)


def make_files(folder: Path) -> None:
    """A certified design, one with dither, and the best candidate of a tuning that is refused."""
    dither = '[dither]\nfrequency = "20 Hz"\namplitude = "50 mV"\n[[reference]]'
    wanted = GIVEN.replace("30000 V", "10 V") + 'settling_time = { max = "100 ms", band = "2 %" }\n'
    texts = {"fit": DRIVE, "given": GIVEN, "dithered": GIVEN.replace("[[reference]]", dither), "wanted": wanted}
    for name, text in texts.items():
        (folder / f"{name}.toml").write_text(text, "utf-8")
    for given, made in (("given", "tuned"), ("dithered", "dither")):
        ended = run(f"certify {folder}/fit.toml {folder}/{given}.toml -o {folder}/{made}.toml -q")
        assert ended.exit_code == 0, ended.output
    failed = run(f"tune {folder}/fit.toml {folder}/wanted.toml -o {folder}/failed.toml -q")
    assert failed.exit_code == 1, failed.output


def edit(path: Path, old: str, new: str) -> None:
    """Change a file in one place."""
    text = path.read_text("utf-8")
    assert old in text, f"{path} has no {old}"
    path.write_text(text.replace(old, new, 1), "utf-8")


def forge(folder: Path, name: str) -> tuple[str, str]:
    """Make a forgery; the name of the file that is then to be exported, and what has to be said of it."""
    file, old, new, told = FORGERIES[name]
    edit(folder / f"{file}.toml", old, new)
    return "tuned" if file == "fit" else file, told


def export(folder: Path, file: str, form: str, *options: str) -> tuple[int, str]:
    """The exit status of an export, and the file's text; empty where there is none."""
    place = folder / form
    ended = run(" ".join([f"export {folder}/fit.toml {folder}/{file}.toml --to {form} -o {place}", *options]))
    made = place / FILES[form]
    return ended.exit_code, made.read_text("ascii") if made.exists() else ""


def count_noticed(folder: Path, name: str) -> int:
    """In how many forms of export a forgery is refused, and said in the file."""
    file, told = forge(folder, name)
    noticed = 0
    for form in forms(name):
        refused, none = export(folder, file, form)
        status, text = export(folder, file, form, "--uncertified")
        noticed += (refused, none, status) == (2, "", 0) and f"NOT CERTIFIED: {told}" in text
    return noticed


def forms(name: str) -> list[str]:
    """The forms of export that take a forged design."""
    return [form for form in FILES if form != "siemens" or name != "dither"]


def main() -> "pd.DataFrame":
    claims = list[Claim]()
    with tempfile.TemporaryDirectory() as place:
        made = Path(place) / "made"
        made.mkdir()
        make_files(made)

        def copy(name: str) -> Path:
            return Path(shutil.copytree(made, Path(place) / name.replace(" ", "_")))

        for name in FORGERIES:
            count = count_noticed(copy(f"forged {name}"), name)
            claims.append(Claim(f"forgery.{name}", count, "1", None, f">= {len(forms(name))}"))
        for name, rewrite in UNFORGED.items():
            folder = copy(f"unforged {name}")
            path = folder / "tuned.toml"
            path.write_text(rewrite(path.read_text("utf-8")), "utf-8")
            texts = [export(folder, "tuned", form)[1] for form in FILES]
            kept = sum("Certified: " in text and "NOT CERTIFIED" not in text for text in texts)
            claims.append(Claim(f"unforged.{name}", kept, "1", None, f">= {len(FILES)}"))
        for name, gain, status in (("holds", 9, 0), ("breaks", 62, 1)):
            folder = copy(f"certify {name}")
            edit(folder / "tuned.toml", '"8 V*s/m"', f'"{gain} V*s/m"')
            ended = run(f"certify {folder}/fit.toml {folder}/tuned.toml -o {folder}/again.toml -q")
            written = float((folder / "again.toml").exists())
            claims.append(Claim(f"certify.{name}.exit_status", ended.exit_code, "1", None, f"{status} +- 0"))
            claims.append(Claim(f"certify.{name}.files", written, "1", None, f"{1 - status} +- 0"))
            excess = re.findall(r"off by ([\d.]+) %", ended.stdout)
            claims += [Claim(f"certify.{name}.excess", float(v), "%", None, ">= 0.1") for v in excess]
        refused, text = export(copy("best"), "failed_best", "st")
        claims.append(Claim("best.refused", float(refused == 2 and not text), "1", None, ">= 1"))
    return frame(claims)


if __name__ == "__main__":
    options = arguments(__doc__).parse_args()
    sys.exit(finish(main(), options))
