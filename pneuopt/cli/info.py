"""`pneuopt info`, what is installed and how fast it is, and `pneuopt keys`, what stands in the files."""

import difflib
import os
import platform
import re
import sys
import textwrap
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, requires, version
from itertools import groupby

import numpy as np
import typer

from pneuopt.cli.shared import make_console, show_pairs
from pneuopt.cli.tolerances import EXIT_FAILURE, EXIT_SUCCESS
from pneuopt.dynamics.compiled.compiler import COMPILER_FLAGS, cache_directory, cached_libraries, find_compiler
from pneuopt.dynamics.compiled.self_check import SelfCheck, check_machine_code
from pneuopt.dynamics.system import discretise, parameter_vector
from pneuopt.files.keys import FILE_MEANINGS, KeyRow, list_keys
from pneuopt.files.outputs import OUTPUTS, describe_member, describe_outputs
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Stribeck
from pneuopt.quantities.errors import InputError

_REQUIREMENT = re.compile(r"^([\w.-]+)[^;]*(?:;\s*extra\s*==\s*['\"]([\w-]+)['\"])?\s*$")


def run_info() -> int:
    """Show what to quote in a question or a bug report; returns 1 where the self-check fails."""
    compiler, cache = find_compiler(), cache_directory()
    check = _check_itself()
    libraries = cached_libraries(cache)
    size = sum(entry.st_size for entry in libraries.values()) / 1e6
    shown = {
        **package_versions(),
        "python": f"{platform.python_version()} ({sys.executable})",
        "platform": f"{platform.platform()}, {os.cpu_count()} CPUs",
        "compiler": f"{compiler}, {compiler.version}" if compiler else "none: models run in the CasADi VM",
        **({"flags": " ".join(COMPILER_FLAGS)} if compiler else {"to add one": 'pip install "pneuopt[compiler]"'}),
        "cache": f"{cache}: {len(libraries)} models, {size:.3g} MB",
        "self-check": _describe_check(check),
        "speed": _describe_speed(check),
    }
    show_pairs(make_console(), shown)
    return EXIT_SUCCESS if check.is_good else EXIT_FAILURE


def package_versions() -> dict[str, str]:
    """The version of each package that pneuopt needs or an extra brings; for those that are not there the extra."""
    found = {"pneuopt": version("pneuopt")}
    for text in requires("pneuopt") or ():  # "numpy>=2.0", "openpyxl>=3.1; extra == 'xlsx'"
        match = _REQUIREMENT.match(text)
        name, extra = match.groups() if match else (text, None)
        try:
            found.setdefault(name, version(name))
        except PackageNotFoundError:
            found.setdefault(name, f'not installed: pip install "pneuopt[{extra}]"' if extra else "MISSING")
    return found


def _check_itself() -> SelfCheck:
    """Of a load that is pushed against friction."""
    system = discretise(ForceDrive(Stribeck()).system(), 1)
    p = parameter_vector(system.parameters, system.parameters)
    return check_machine_code(system.pieces, np.zeros(2), np.full(1, 150.0), p, 1e-3)


def _describe_check(check: SelfCheck) -> str:
    verdict = "good" if check.is_good else "FAILED: please report it, with all of this"
    code = f"machine code differs from the VM by {check.distance:.1g}, " if check.lanes else ""
    return f"{verdict}: {code}derivatives from differences by {check.derivative_error:.1g}"


def _describe_speed(check: SelfCheck) -> str:
    names = {"vm": "in the VM", "scalar": "compiled", "lanes": f"in {check.lanes} lanes"}
    return "ns a step: " + ", ".join(f"{time:.0f} {names[way]}" for way, time in check.nanoseconds.items())


_MARGIN = "    "


def run_keys(word: str | None, markdown: bool) -> int:
    """Print the keys whose name or meaning has the word in it; all without one."""
    rows = find_keys(word)
    typer.echo(format_markdown(rows) if markdown else _format_screen(rows, make_console().width))
    return EXIT_SUCCESS


def run_outputs(markdown: bool) -> int:
    """Print what each command writes with --json."""
    typer.echo(describe_outputs() if markdown else _outputs_on_screen(make_console().width))
    return EXIT_SUCCESS


def find_keys(word: str | None) -> Sequence[KeyRow]:
    """Rows of the list by a word: of a file, a section, a key or its meaning; those with that very name come first."""
    rows = list_keys()
    if word is None:
        return rows
    sought = word.casefold().strip("[]")
    exact = [r for r in rows if sought in (r.file, r.section, r.full_name.casefold(), r.name.casefold().split(".")[-1])]
    found = exact or [r for r in rows if sought in f"{r.full_name} {r.key.meaning}".casefold()]
    if not found:
        names = {n for row in rows for n in (row.section, row.full_name, row.name.split(".")[-1]) if n}
        near = difflib.get_close_matches(word, names, n=1, cutoff=0.5)
        raise InputError(
            f"no key has {word!r} in it; " + (f"did you mean {near[0]!r}?" if near else "leave it out to see all")
        )
    return found


def format_markdown(rows: Sequence[KeyRow]) -> str:
    """Tables in Markdown, one a file."""
    parts = []
    for file, own in groupby(rows, key=lambda row: row.file):
        parts.append(f"**{file}**: {FILE_MEANINGS[file]}\n\n| key | unit | default | |\n|---|---|---|---|")
        parts[-1] += "".join(f"\n{_markdown_row(row)}" for row in own)
    return "\n\n".join(parts)


def _markdown_row(row: KeyRow) -> str:
    name = f"**[{row.section}]**" if (not row.name and row.key.keys) or row.key.others else f"`{row.full_name}`"
    cells = [name, row.unit, row.usual and f"`{row.usual}`", row.remarks]
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _format_screen(rows: Sequence[KeyRow], width: int) -> str:
    """Lines no wider than the terminal."""
    lines: list[str] = []
    for file, own in groupby(rows, key=lambda row: row.file):
        lines += ["", *textwrap.wrap(f"{file}: {FILE_MEANINGS[file]}", width)]
        for row in own:
            unit, usual = f" [{row.unit}]" if row.unit else "", f" = {row.usual}" if row.usual else ""
            lines += _entry(f"{row.full_name}{unit}{usual}", row.remarks, width)
    return "\n".join(lines[1:])


def _outputs_on_screen(width: int) -> str:
    """Lines no wider than the terminal."""
    lines: list[str] = []
    for name, output in OUTPUTS.items():
        lines += ["", *textwrap.wrap(f"{name}: {output.meaning}", width)]
        for member, held in output.members.items():
            lines += _entry(f"{member}: {held.holds.value}", describe_member(held), width)
    return "\n".join(lines[1:])


def _entry(head: str, remarks: str, width: int) -> list[str]:
    """The lines of a key or a member, and what it means below it."""
    return [
        *textwrap.wrap(head, width, initial_indent="  ", subsequent_indent=_MARGIN),
        *textwrap.wrap(remarks, width, initial_indent=_MARGIN, subsequent_indent=_MARGIN),
    ]
