"""`Key`: the declaration of a key of a file; its reader reads by it, and templates, schemas and key lists come from it.

A file is a table whose keys are its sections, a section is a table of keys, and so on down.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any

from pneuopt.quantities.parameters import Parameter


class Takes(Enum):
    """What a key takes, in the words of messages."""

    FLAG = "true or false"
    TEXT = "text"
    COUNT = "a whole number"
    NUMBER = "a value with its unit"
    PARAMETER = "a value with its unit, or a table with bounds"
    LIST = "a list"
    FLAG_OR_LIST = "true, false or a list"
    TABLE = "a table"
    TABLES = "sections [[...]]"
    SAMPLES = "a number of samples"
    SPREAD = "a fraction, two values, or a distribution"
    AXIS = "a list of values, or a range"
    COLUMN = "a column's name, a table, or false"

    @property
    def types(self) -> tuple[type, ...]:
        """Python types of such an entry."""
        return _TYPES[self]


_TYPES: Mapping[Takes, tuple[type, ...]] = {
    Takes.FLAG: (bool,),
    Takes.TEXT: (str,),
    Takes.COUNT: (int,),
    Takes.NUMBER: (str, int, float),
    Takes.PARAMETER: (str, int, float, dict),
    Takes.LIST: (list,),
    Takes.FLAG_OR_LIST: (bool, list),
    Takes.TABLE: (dict,),
    Takes.TABLES: (list,),
    Takes.SAMPLES: (int, str),
    Takes.SPREAD: (str, int, float, list, dict),
    Takes.AXIS: (list, dict),
    Takes.COLUMN: (str, dict, bool),
}


@dataclass(frozen=True)
class Key:
    """A key of a file: what it means, what it takes, and what holds where the file leaves it out.

    Parameters
    ----------
    meaning : str
    takes : Takes
    unit : str
        Of a value; words in braces stand for the units of a loop's signals: "{command}/s".
    usual : object
        What holds without the key: a value in `unit`, or the word that the file would say.
    choices : mapping of str to object, optional
        The words that the key takes, and the object that each stands for.
    required : bool
        Whether the file must have the key.
    keys : mapping of str to Key
        Those of a table.
    others : Key, optional
        What the further keys of a table take: names that come from the user, each a `named`.
    named : str
        What such a name is: "parameter".
    example : str
        As a file may write it; needed where nothing is usual.
    source : str
        Where the usual value comes from.
    condition : str
        When the file may have the key: 'form = "standard"'.
    """

    meaning: str
    takes: Takes = Takes.NUMBER
    unit: str = "1"
    usual: Any = None
    choices: Mapping[str, Any] | None = None
    required: bool = False
    keys: Mapping[str, "Key"] = field(default_factory=dict)
    others: "Key | None" = None
    named: str = ""
    example: str = ""
    source: str = ""
    condition: str = ""

    def walk(self, prefix: str = "") -> Iterator[tuple[str, "Key"]]:
        """Yield each key below this one by its full name: "pid.Kp"; a key that the user names, as "noise.<channel>"."""
        named = {f"<{self.named}>": self.others} if self.others else {}
        for name, key in {**self.keys, **named}.items():
            yield f"{prefix}{name}", key
            yield from key.walk(f"{prefix}{name}.")


def flag(meaning: str, usual: bool = False) -> Key:
    """Key that is true or false."""
    return Key(meaning, Takes.FLAG, usual=usual)


def choice(meaning: str, choices: Mapping[str, Any], usual: str | None = None) -> Key:
    """Key that is one of several words; without a usual one it is required."""
    return Key(meaning, Takes.TEXT, usual=usual, choices=choices, required=usual is None)


def table(meaning: str, keys: Mapping[str, Key], **options: Any) -> Key:
    """Key that is a table, or a section, of other keys."""
    return replace(Key(meaning, Takes.TABLE, keys=keys), **options)


def first_sentence(kind: type) -> str:
    """What a class is, by its docstring; empty where Python was told to leave docstrings out."""
    first = " ".join((kind.__doc__ or "").split("\n\n")[0].split())
    return _plain(re.split(r"[.;] ", first)[0])


def argument_meanings(kind: type) -> dict[str, str]:
    """What each argument of a class means, the first sentence of its docstring's section Parameters."""
    section = (kind.__doc__ or "").partition("----------\n")[2].partition("\n\n")[0]
    found: dict[str, str] = {}
    for names, lines in re.findall(r"^    (\w[\w, ]*) : .*\n((?:^        .*\n?)+)", section, re.MULTILINE):
        meaning = _plain(re.split(r"[.;:] ", " ".join(lines.split()))[0])
        found |= dict.fromkeys(names.split(", "), meaning)
    return found


def _plain(sentence: str) -> str:
    """Without markup, unit and full stop, and small where it begins with a whole word."""
    words = re.sub(r" \[[^]]*\]$", "", sentence.removesuffix(".").replace("`", ""))
    return words[:1].lower() + words[1:] if re.match(r"[A-Z][a-z]+ (?!=)", words) else words


def parameter_key(parameter: Parameter, condition: str = "") -> Key:
    """The key of a parameter: its value, or a table with its bounds and flags."""
    p = parameter
    return Key(p.meaning, Takes.PARAMETER, p.unit, p.value, source=p.source, condition=condition)


PARAMETER_KEYS: Mapping[str, Key] = {
    "value": Key("where a search starts, or what holds", example='"5 kg"'),
    "lower": Key("lower bound", example='"1 kg"'),
    "upper": Key("upper bound", example='"20 kg"'),
    "free": flag("whether it is identified, or tuned"),
    "log": flag("whether searches work on its logarithm"),
    "per_log": flag("whether each log has its own value"),
    "source": Key("where the value comes from", Takes.TEXT, example='"data sheet"'),
}
"""The table of a parameter; value and bounds are in the parameter's unit."""
