"""Each command has a line and examples that it would take, within 80 columns; the shell completes."""

import os
import shlex
import subprocess
import sys

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from pneuopt.cli.app import app
from pneuopt.cli.command_help import COMMAND_HELP

COMMANDS = get_command(app).commands  # type: ignore[attr-defined]  # of a click.Group


def test_every_command_has_its_line_and_no_other_has() -> None:
    assert set(COMMAND_HELP) == set(COMMANDS)


@pytest.mark.parametrize("name", COMMAND_HELP)
def test_examples_are_shown_whole_and_would_be_taken(name: str) -> None:
    shown = CliRunner().invoke(app, [name, "--help"], env={"COLUMNS": "80"}).output
    assert all(len(line) <= 80 for line in shown.splitlines())
    for example in COMMAND_HELP[name].examples:
        assert f"    {example}\n" in shown
        program, command, *arguments = shlex.split(example)
        assert (program, command) == ("pneuopt", name)
        COMMANDS[name].make_context(name, arguments)  # raises where an option or an argument is not there


def test_the_list_of_commands_cuts_no_line() -> None:
    shown = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "80"}).output
    assert all(said.line in shown for said in COMMAND_HELP.values())


def test_a_shell_completes_commands_and_options() -> None:
    code = "import sys; sys.argv = ['pneuopt']; from pneuopt.__main__ import main; main()"

    def complete(words: str) -> list[str]:
        asked = {"_PNEUOPT_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
        command = [sys.executable, "-c", code]
        done = subprocess.run(command, env=os.environ | asked, capture_output=True, text=True, check=True)
        return done.stdout.split()

    assert complete("pneuopt id") == ["identify"]
    assert "--report" in complete("pneuopt tune --re")
