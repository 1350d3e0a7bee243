"""`pneuopt keys`: the list on the screen, and README's appendix, which it made."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from pneuopt.cli.app import app
from pneuopt.cli.keys import format_markdown
from pneuopt.files.key_list import list_keys

README = Path(__file__).parents[2] / "README.md"


def run(*words: str, width: int = 80) -> tuple[int, str]:
    result = CliRunner(env={"COLUMNS": str(width)}).invoke(app, ["keys", *words])
    return result.exit_code, result.output


def test_the_appendix_of_the_readme_is_the_list() -> None:
    appendix = README.read_text("utf-8").partition("## Appendix: the keys of the files\n")[2]
    remedy = "README's appendix is not the list of keys; put there what `pneuopt keys --markdown` prints"
    assert format_markdown(list_keys()) in appendix, remedy


@pytest.mark.parametrize("width", [60, 80])
def test_the_screen_shows_every_key_within_its_width(width: int) -> None:
    code, output = run(width=width)
    assert code == 0
    assert max(map(len, output.splitlines())) <= width
    assert [r.full_name for r in list_keys() if f"  {r.full_name}" not in output] == []


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
