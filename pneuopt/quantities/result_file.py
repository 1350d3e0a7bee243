"""Files of results: one of JSON, whole or not at all, with a hash of what it holds.

It has the members "pneuopt", the name of the result's class, "format", 1, "sha256", the hash of the result's text, and
"result", a member a field as `archive` says. It is for programs to read; what people edit is fit.toml and tuned.toml.
"""

import hashlib
import json
from pathlib import Path
from typing import Any

from pneuopt.quantities.archive import DamagedError, decode, encode
from pneuopt.quantities.errors import InputError, PneuoptError, check_names, require
from pneuopt.quantities.output import write_text

FORMAT = 1
"""Version of the file's layout: a file of another one is refused, not misread."""


def write_result(path: str | Path, result: object) -> None:
    """Write a result's file.

    Raises
    ------
    InputError
        If it cannot be written there.
    """
    content: dict[str, Any] = encode(result)
    members = ",\n  ".join(f"{_to_json(name)}: {_to_json(value)}" for name, value in content.items())
    head = f'"pneuopt": "{type(result).__name__}", "format": {FORMAT}, "sha256": "{_hash(content)}"'
    write_text(path, f'{{{head}, "result": {{\n  {members}\n}}}}\n')


def read_result(path: str | Path, kinds: dict[str, type]) -> Any:
    """Read a result's file.

    Parameters
    ----------
    kinds : dict of str to type
        The results that it may hold, by name.

    Raises
    ------
    InputError
        If it cannot be read, is of another kind or version, or is not what was saved.
    """
    document, remedy = _read_json(path), "save the result again"
    message = f"{path}: not a result that pneuopt has saved; give a file of `save`"
    require(isinstance(document, dict) and {"pneuopt", "format", "sha256", "result"} <= document.keys(), message)
    version = document["format"]
    require(
        version == FORMAT, f"{path}: has format {version!r}, this pneuopt reads {FORMAT}; install the one that wrote it"
    )
    check_names("result", [str(document["pneuopt"])], kinds, str(path))
    whole = document["sha256"] == _hash(document["result"])
    require(whole, f"{path}: was damaged or changed after it was saved; {remedy}")
    try:
        return decode(kinds[document["pneuopt"]], document["result"])
    except DamagedError as error:
        raise InputError(f"{path}: {error} is not as pneuopt saves it; {remedy}") from None
    except (PneuoptError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise InputError(f"{path}: holds no such result ({error}); {remedy}") from None


def _read_json(path: str | Path) -> Any:
    try:
        return json.loads(Path(path).read_bytes().decode("utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the name and the folder") from None
    except (ValueError, RecursionError):  # no UTF-8, no JSON, or brackets without end
        raise InputError(f"{path}: not a whole result file; save the result again") from None


def _hash(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode("utf-8")).hexdigest()


def _to_json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)
