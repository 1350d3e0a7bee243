from pathlib import Path

import pytest

from pneuopt.errors import InputError
from pneuopt.tomlfile import read_toml


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
