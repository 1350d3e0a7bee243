"""What all TOML files share: a syntax error names its line, and places are found whatever the style."""

from pathlib import Path

import pytest

from pneuopt.files.toml import FileLocations, read_toml
from pneuopt.quantities.errors import InputError


def written(folder: Path, text: str, name: str = "drive.toml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_a_syntax_error_names_file_and_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"drive\.toml: not valid TOML: .* at line 3 "):
        read_toml(written(tmp_path, "a = 1\nb = 2\nc = = 3\n"))
    with pytest.raises(InputError, match=r"drive\.toml: not valid TOML: .*already exists"):
        read_toml(written(tmp_path, "a = 1\na = 2\n"))
    with pytest.raises(InputError, match=r"none\.toml: cannot be read"):
        read_toml(tmp_path / "none.toml")
    (tmp_path / "latin.toml").write_bytes("a = 'µ'".encode("latin-1"))
    with pytest.raises(InputError, match="UTF-8"):
        read_toml(tmp_path / "latin.toml")


def test_places_are_found_whatever_the_style_of_the_table() -> None:
    text = """# a drive
[cylinder] # of mine
  rod = { value = "4 mm", lower = "1 mm" }
"bore" = "32 mm"
[valve]
rod = 2
leak.lower = 0
"""
    places = FileLocations("drive.toml", text)
    found = {
        ("cylinder", "rod"): 3,
        ("cylinder", "bore"): 4,
        ("valve", "rod"): 6,
        ("valve", "leak"): 7,
        ("valve", ""): 5,
    }
    assert {name: places.location(*name) for name in found} == {
        name: f"drive.toml:{line}" for name, line in found.items()
    }
    assert places.location("valve", "span") == "drive.toml:5"
    assert places.location("load", "mass") == str(places) == "drive.toml"
    inline = 'load = { mass = "5 kg" }\nsupply.pressure = "6 bar(g)"'
    assert FileLocations("d", inline).location("load", "mass") == "d:1"
    assert FileLocations("d", inline).location("supply", "pressure") == "d:2"
