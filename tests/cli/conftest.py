"""What the commands' tests share."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import tomlkit
from jsonschema import Draft202012Validator

from pneuopt.cli.shared import ScreenStyle
from pneuopt.files.outputs import OUTPUTS, output_schema
from pneuopt.quantities.output import write_json


@pytest.fixture(autouse=True)
def _no_lines_of_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    """Standard error holds what a command says, however slow the machine is."""
    monkeypatch.setattr("pneuopt.cli.shared.SCREEN", ScreenStyle(3600.0))


@pytest.fixture(autouse=True)
def _outputs_keep_their_schema(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever a command of these tests writes with --json is what the schema says."""
    validator = Draft202012Validator(output_schema())

    def write(path: Path, document: Mapping[str, Any]) -> None:
        write_json(path, document)
        written = json.loads(Path(path).read_text("utf-8"))
        names = [n for n, member in OUTPUTS.items() if {*written} <= {*member.members}] or [*OUTPUTS]
        problems = {n: [e.message for e in validator.evolve(schema=_definition(n)).iter_errors(written)] for n in names}
        assert [] in problems.values(), problems

    monkeypatch.setattr("pneuopt.cli.shared.write_json", write)


@pytest.fixture
def parsed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The texts of the TOML files that are parsed."""
    texts, parse = list[str](), tomlkit.parse

    def parse_counted(text: str) -> tomlkit.TOMLDocument:
        texts.append(text)
        return parse(text)

    monkeypatch.setattr(tomlkit, "parse", parse_counted)
    return texts


def _definition(name: str) -> dict[str, Any]:
    found: dict[str, Any] = output_schema()["$defs"][name]
    return found
