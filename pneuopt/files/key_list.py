"""All keys of all files in one list, from the declarations by which they are read."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache

from pneuopt.files.drive_keys import drive_keys
from pneuopt.files.loop_parameters import tuning_keys
from pneuopt.files.rig import RIG_KEYS
from pneuopt.files.study import STUDY_KEYS
from pneuopt.logs.sidecar_keys import SIDECAR_KEYS
from pneuopt.models.drive_kinds import DRIVE_KINDS
from pneuopt.quantities.errors import UnitError
from pneuopt.quantities.keys import Key, Takes, table
from pneuopt.quantities.units import write_value

FILE_MEANINGS: Mapping[str, str] = {
    "drive.toml": "the hardware: what is known of it, and what is free",
    "tuning.toml": "the controller, what it is asked to follow, and what counts",
    "study.toml": "a grid of plants, samples, corners or a table of them, or a front between two requirements",
    "rig.toml": "what the hardware has and its model has not, for `tune --rig`",
    "log.toml": "the sidecar of log.csv: it has the log's name",
}
_SIGNAL_WORDS = {"command": "command", "measured": "measured", "difference": "measured", "position": "position"}
_SHARED_BY = 3  # requirements that have the same key: one row stands for all


@dataclass(frozen=True)
class KeyRow:
    """A key in the list.

    Attributes
    ----------
    file, section, name : str
        The name within its section, "smoothing.corner"; empty for the section itself.
    key : Key
    unit, usual : str
        As text; of drives that differ, each with its kind.
    kinds : tuple of str
        The kinds of drive that have it; empty where all have it that have the section.
    """

    file: str
    section: str
    name: str
    key: Key
    unit: str
    usual: str
    kinds: tuple[str, ...] = ()

    @property
    def full_name(self) -> str:
        """Section and key."""
        return ".".join(filter(None, [self.section, self.name]))

    @property
    def remarks(self) -> str:
        """Meaning, words, condition, kinds and source in one line."""
        words = "" if self.key.choices is None else ", ".join(f'"{word}"' for word in self.key.choices)
        kinds = f"{', '.join(self.kinds)} only" if self.kinds else ""
        needed = "required" if self.key.required else ""
        example = f"say {self.key.example}" if self.key.example and not self.usual and not words else ""
        parts = [
            self.key.meaning,
            words and f"one of {words}",
            example,
            self.key.condition,
            kinds,
            needed,
            self.key.source,
        ]
        return "; ".join(filter(None, parts))


@cache
def list_keys() -> tuple[KeyRow, ...]:
    """Every key of every file."""
    others = {"tuning.toml": tuning_keys(), "study.toml": STUDY_KEYS, "rig.toml": RIG_KEYS, "log.toml": SIDECAR_KEYS}
    rows = list(_drive_rows())
    for file, sections in others.items():
        rows += [_row(file, name, key) for name, key in _merge_shared(sections)]
    return tuple(rows)


def describe_usual(key: Key) -> str:
    """What holds where a file leaves the key out, as the file would say it; empty where nothing does."""
    usual = key.usual
    if usual is None or usual == {}:
        return ""
    if isinstance(usual, bool):
        return str(usual).lower()
    if isinstance(usual, str):
        return f'"{usual}"'
    if isinstance(usual, list | tuple):
        return f"[{', '.join(describe_usual(Key('', usual=entry)) for entry in usual)}]"
    if isinstance(usual, int) and key.takes in (Takes.COUNT, Takes.SAMPLES):
        return str(usual)
    return _describe_value(usual, key.unit)


def describe_unit(key: Key) -> str:
    """The unit of a key's value, with words for the units of signals; empty for what has none."""
    unit = key.unit.replace("{own}", "its own").replace("{signal}", "its own").replace("{column}", "the column's")
    unit = unit.format_map(_SIGNAL_WORDS)
    return "" if unit == "1" else unit


def _describe_value(value: float, unit: str) -> str:
    try:
        text = write_value(value, unit)
    except UnitError:  # of a signal that is not known yet
        return f"{value:g}"
    return text if unit == "1" else f'"{text}"'


def _row(file: str, name: str, key: Key) -> KeyRow:
    section, _, own = name.partition(".")
    return KeyRow(file, section, own, key, describe_unit(key), describe_usual(key))


def _merge_shared(sections: Mapping[str, Key]) -> Iterable[tuple[str, Key]]:
    """Keys by full name; what several requirements of a section share has one row, "minimise.*.weight"."""
    walked = list(table("", sections).walk())
    counts: dict[tuple[str, str, str], int] = {}
    for name, key in walked:
        if name.count(".") == 2:
            counts[_shape(name, key)] = counts.get(_shape(name, key), 0) + 1
    done = set()
    for name, key in walked:
        shape = _shape(name, key) if name.count(".") == 2 else None
        if shape is None or counts[shape] < _SHARED_BY:
            yield name, key
        elif shape not in done:
            done.add(shape)
            several = len({k.unit for n, k in walked if n.count(".") == 2 and _shape(n, k) == shape}) > 1
            yield f"{shape[0]}.*.{shape[1]}", replace(key, unit="{own}") if several else key


def _shape(name: str, key: Key) -> tuple[str, str, str]:
    section, _, own = name.split(".")
    return section, own, key.meaning


def _drive_rows() -> Iterable[KeyRow]:
    """Keys of all kinds of drive; kinds that share a key have one row, which says where they differ."""
    kinds = {kind: dict(table("", drive_keys(kind)).walk()) for kind in DRIVE_KINDS}
    for name in dict.fromkeys(n for keys in kinds.values() for n in keys):
        own = {kind: keys[name] for kind, keys in kinds.items() if name in keys}
        section, _, rest = name.partition(".")
        known = {kind for kind, keys in kinds.items() if section in keys}
        units, usual = ({kind: text(key) for kind, key in own.items()} for text in (describe_unit, describe_usual))
        condition = _join({kind: key.condition for kind, key in own.items()})
        only = tuple(own) if set(own) != known or (not rest and set(own) != set(kinds)) else ()
        key = replace(next(iter(own.values())), condition=condition)
        yield KeyRow("drive.toml", section, rest, key, _join(units), _join(usual), only)


def _join(texts: Mapping[str, str]) -> str:
    """One text, and of each kind that differs its own: "N; rotary: N*m"."""
    first = next(iter(texts.values()))
    others = [f"{kind}: {text}" for kind, text in texts.items() if text not in (first, "")]
    return "; ".join(filter(None, [first, *others]))
