"""`pneuopt keys`: what may stand in the files, and what --json writes, on the screen and as Markdown."""

import pytest
from typer.testing import CliRunner

from pneuopt.cli.app import app
from pneuopt.files.keys import list_keys
from pneuopt.files.outputs import OUTPUTS


def run(*words: str, width: int = 80) -> tuple[int, str]:
    result = CliRunner(env={"COLUMNS": str(width)}).invoke(app, ["keys", *words])
    return result.exit_code, result.output


@pytest.mark.parametrize("width", [60, 80])
def test_the_screen_shows_every_key_within_its_width(width: int) -> None:
    code, output = run(width=width)
    assert code == 0
    assert max(map(len, output.splitlines())) <= width
    assert [r.full_name for r in list_keys() if f"  {r.full_name}" not in output] == []


@pytest.mark.parametrize("width", [60, 80])
def test_the_screen_shows_every_member_of_what_json_writes_within_its_width(width: int) -> None:
    code, output = run("--outputs", width=width)
    assert code == 0
    assert max(map(len, output.splitlines())) <= width
    for name, written in OUTPUTS.items():
        own = output.partition(f"\n{name}: " if name != next(iter(OUTPUTS)) else f"{name}: ")[2].partition("\n\n")[0]
        assert [m for m, held in written.members.items() if f"  {m}: {held.holds.value}" not in own] == []


def test_markdown_has_a_row_for_each_key_and_member() -> None:
    keys, outputs = run("--markdown")[1], run("--outputs", "--markdown")[1]
    assert [
        r.full_name for r in list_keys() if f"`{r.full_name}`" not in keys and f"**[{r.section}]**" not in keys
    ] == []
    assert all(f"| `{member}` |" in outputs for written in OUTPUTS.values() for member in written.members)


def test_a_word_beside_outputs_is_refused_not_ignored() -> None:
    assert run("mass", "--outputs") == (2, "error: --outputs shows all outputs: give no WORD beside it\n")


def test_a_word_finds_sections_keys_and_meanings() -> None:
    mass = ['  load.mass [kg] = "5 kg"', "    mass that moves, piston and rod included; pneumatic, force only"]
    assert run("mass")[1].splitlines()[1:3] == mass
    assert "  sensor.lag [s]" in run("[sensor]")[1]
    assert "  valve.conductance" in run("ISO 6358")[1]
    assert "tuning.toml" not in run("log.toml")[1]


def test_a_word_that_no_key_has_is_met_with_the_nearest() -> None:
    code, output = run("stribek_velocity")
    assert (code, output) == (2, "error: no key has 'stribek_velocity' in it; did you mean 'stribeck_velocity'?\n")
    assert "leave it out to see all" in run("zzzz")[1]
