"""`read_option_assumptions`: the options of a drive that its file leaves out, with what holds in their place."""

from collections.abc import Iterator, Mapping
from pathlib import Path

from pneuopt.files.toml import read_toml
from pneuopt.identification.assumptions import DRIVE_FILE, Assumption
from pneuopt.models.drive_kinds import DRIVE_KINDS
from pneuopt.quantities.keys import Key


def read_option_assumptions(path: str | Path) -> tuple[Assumption, ...]:
    """The options that a drive's file leaves out.

    Parameters
    ----------
    path : str or Path
        A file that `read_drive` reads.

    Returns
    -------
    tuple of Assumption
        The parameters that it leaves out are `list_assumptions`'.
    """
    sections = read_toml(path).unwrap()
    kind = DRIVE_KINDS[sections["drive"]["kind"]]
    return tuple(a for section, keys in kind.sections.items() for a in _options(section, keys, sections.get(section)))


def _options(section: str, keys: Mapping[str, Key], written: Mapping[str, object] | None) -> Iterator[Assumption]:
    """What holds of a section; nothing where the drive lacks it."""
    if written is None and any(key.required for key in keys.values()):
        return
    for name, key in keys.items():
        if name not in (written or {}) and isinstance(key.usual, str | bool):
            yield Assumption(f"{section}.{name}", key.usual, "", f"[{section}] {name}", DRIVE_FILE, key.meaning)
