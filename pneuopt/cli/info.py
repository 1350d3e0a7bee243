"""`pneuopt info`, what is installed and how fast it is, and `pneuopt keys`, what stands in the files."""

import difflib
import os
import platform
import re
import sys
import textwrap
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, requires, version
from itertools import groupby

import numpy as np
import typer

from pneuopt.cli.run import ExitStatus
from pneuopt.cli.shared import make_console, show_pairs
from pneuopt.dynamics.compiled.compiler import COMPILER_FLAGS, cache_directory, cached_libraries, find_compiler
from pneuopt.dynamics.compiled.rollout import check_machine_code
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
    system = discretise(ForceDrive(Stribeck()).system(), 1)  # a load that is pushed against friction
    p = parameter_vector(system.parameters, system.parameters)
    check = check_machine_code(system.pieces, np.zeros(2), np.full(1, 150.0), p, 1e-3)
    verdict = "good" if check.is_good else "FAILED: please report it, with all of this"
    code = f"machine code differs from the VM by {check.distance:.1g}, " if check.lanes else ""
    names = {"vm": "in the VM", "scalar": "compiled", "lanes": f"in {check.lanes} lanes"}
    libraries = cached_libraries(cache)
    size = sum(entry.st_size for entry in libraries.values()) / 1e6
    shown = {
        **package_versions(),
        "python": f"{platform.python_version()} ({sys.executable})",
        "platform": f"{platform.platform()}, {os.cpu_count()} CPUs",
        "compiler": f"{compiler}, {compiler.version}" if compiler else "none: models run in the CasADi VM",
        **({"flags": " ".join(COMPILER_FLAGS)} if compiler else {"to add one": 'pip install "pneuopt[compiler]"'}),
        "cache": f"{cache}: {len(libraries)} models, {size:.3g} MB",
        "self-check": f"{verdict}: {code}derivatives from differences by {check.derivative_error:.1g}",
        "speed": "ns a step: " + ", ".join(f"{time:.0f} {names[way]}" for way, time in check.nanoseconds.items()),
    }
    show_pairs(make_console(), shown)
    return ExitStatus.SUCCESS if check.is_good else ExitStatus.FAILURE


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


_MARGIN = "    "


def run_keys(word: str | None, markdown: bool) -> int:
    """Print the keys whose name or meaning has the word in it; all without one."""
    rows = find_keys(word)
    if markdown:
        typer.echo(format_markdown(rows))
        return ExitStatus.SUCCESS
    files = groupby(rows, key=lambda row: row.file)
    _show_entries(
        {f"{file}: {FILE_MEANINGS[file]}": [(row.heading, row.remarks) for row in own] for file, own in files}
    )
    return ExitStatus.SUCCESS


def run_outputs(markdown: bool) -> int:
    """Print what each command writes with --json."""
    if markdown:
        typer.echo(describe_outputs())
        return ExitStatus.SUCCESS
    _show_entries(
        {
            f"{name}: {output.meaning}": [
                (f"{n}: {member.holds.value}", describe_member(member)) for n, member in output.members.items()
            ]
            for name, output in OUTPUTS.items()
        }
    )
    return ExitStatus.SUCCESS


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
        for row in own:
            name = f"**[{row.section}]**" if (not row.name and row.key.keys) or row.key.others else f"`{row.full_name}`"
            cells = [name, row.unit, row.usual and f"`{row.usual}`", row.remarks]
            parts[-1] += "\n| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
    return "\n\n".join(parts)


def _show_entries(groups: Mapping[str, Sequence[tuple[str, str]]]) -> None:
    """Print groups of entries, each with what it means below it, in lines no wider than the terminal."""
    lines, width = list[str](), make_console().width
    for title, entries in groups.items():
        lines += ["", *textwrap.wrap(title, width)]
        for head, remarks in entries:
            lines += textwrap.wrap(head, width, initial_indent="  ", subsequent_indent=_MARGIN)
            lines += textwrap.wrap(remarks, width, initial_indent=_MARGIN, subsequent_indent=_MARGIN)
    typer.echo("\n".join(lines[1:]))
