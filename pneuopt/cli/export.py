"""`pneuopt export`: a tuned controller in the form that another machine takes."""

import hashlib
from collections.abc import Mapping
from pathlib import Path

import typer

from pneuopt.cli.init import write_files
from pneuopt.cli.run import ExitStatus
from pneuopt.cli.shared import make_console, read_fit_and_tuning, show_output_files, warn
from pneuopt.export.blocks import export_settings
from pneuopt.export.fmu import export_fmu
from pneuopt.export.languages import Language, export_controller
from pneuopt.export.makers import Block
from pneuopt.files.drive import StoredFit
from pneuopt.files.toml import read_toml
from pneuopt.files.tuned import CertificateCheck, check_certificate
from pneuopt.quantities.errors import check_names, require
from pneuopt.quantities.output import read_toml_source
from pneuopt.quantities.units import difference_unit, read_value

FMU = "fmu"  # the form that is the plant, not the controller
SHOWN_METRICS = ("SettlingTime", "Overshoot", "MaxSensitivity")
PLC_WORDS = ("plc", "sps", "iec", "iec61131", "scl", "structured_text", "structured-text")  # what people call `st`
MAKERS = {"tia": "siemens", "step7": "siemens", "s7": "siemens", "logix": "rockwell", "allen-bradley": "rockwell"}
MAKERS |= {"twincat": "beckhoff", "matlab": "simulink", "py": "python", "c99": "c", "fmi": "fmu"}
NO_CERTIFICATE = CertificateCheck(False, ("its gains were not written by pneuopt tune",))


def run_export(
    fit: Path, tuned: Path, to: str, folder: Path, name: str, uncertified: bool, force: bool, span: str = ""
) -> int:
    """Export as a `Language`, as a `Block`, which is also shown, or the plant, "fmu"; returns the exit status."""
    languages, blocks = {kind.value: kind for kind in Language}, {kind.value: kind for kind in Block}
    forms, word = [*languages, *blocks, FMU], to.casefold()
    if to not in forms:  # what is meant by what it is called elsewhere
        remedy = f"the controller as structured text, --to st; settings for its own PID block: {', '.join(blocks)}"
        require(word not in PLC_WORDS, f"export --to: unknown form {to!r}; a PLC runs {remedy}")
        meant = word if word in forms else MAKERS.get(word, to)
        require(meant == to, f"export --to: unknown form {to!r}; it is called {meant!r} here")
    check_names("form", [to], forms, "export --to")
    scaled = Block.ROCKWELL.value
    require(not span or to == scaled, f"--pv-span: of --to {scaled} only, whose gains are for errors in percent of it")
    stored, task, parameters = read_fit_and_tuning(fit, tuned)
    unit = task.loop.feedback.unit
    measured_span = read_value(span, difference_unit(unit), where="--pv-span") if span else None
    sums = {path: hashlib.sha256(read_toml_source(path)).hexdigest() for path in (fit, tuned)}
    origin = _certificate_lines(stored, tuned, uncertified)
    origin += [f"from {tuned.name}, sha256 {sums[tuned]}", f"plant {fit.name}, sha256 {sums[fit]}"]
    given = (task.loop, parameters)
    files: Mapping[str, str | bytes]
    if to == FMU:
        place = folder / f"{name}.fmu"
        message = "is there already, and stays as it is; --force replaces it, -o names another folder"
        require(force or not place.exists(), f"{place}: {message}")  # not even by the same one
        files = {place.name: export_fmu(task.loop.plant, parameters, name=name)}
    elif to in languages:
        files = export_controller(*given, languages[to], name=name, centre=task.centre, origin=origin)
    else:
        block = blocks[to]
        files = export_settings(
            *given, block, task.references, name=name, centre=task.centre, origin=origin, measured_span=measured_span
        )
    placed = {folder / file: content for file, content in files.items()}
    write_files(placed, force)
    if to in blocks:
        typer.echo("".join(map(str, files.values())))
    show_output_files(make_console(), list(placed))
    return ExitStatus.SUCCESS


def _certificate_lines(fit: StoredFit, tuned: Path, uncertified: bool) -> list[str]:
    """What a file says of its certificate; refused where none holds, unless that is accepted."""
    found = check_certificate(fit, tuned) or NO_CERTIFICATE
    if found.holds:
        certified, lines = read_toml(tuned).unwrap().get("certified", {}), list[str]()
        for step, row in certified.items() if isinstance(certified, Mapping) else ():
            known = row if isinstance(row, Mapping) else {}
            shown = [f"{n} {known[n]:.4g}" for n in SHOWN_METRICS if isinstance(known.get(n), int | float)]
            lines += [f"Certified: {step}: {', '.join(shown)}"] if shown else []
        return lines
    message = "pneuopt certify gives gains a certificate, or says what breaks; --uncertified exports them all the same"
    require(uncertified, f"{tuned}: NOT CERTIFIED: {'; '.join(found.reasons)}. {message}")
    for reason in found.reasons:
        warn(f"{tuned}: {reason}; what is written says NOT CERTIFIED")
    return list(found.lines)
