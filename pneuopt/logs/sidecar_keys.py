"""The keys of a log's sidecar, by which it is read."""

from collections.abc import Mapping

from pneuopt.logs.columns import CHANNELS, COLUMN_KEYS
from pneuopt.quantities.intersample import Intersample
from pneuopt.quantities.keys import Key, Takes, table

ACCEPTED_CHECKS = "accept"  # the checks that the log need not pass
DATE = "date"  # when the log was taken


def _column_key(channel: str, unit: str) -> Key:
    meaning = f"column of the {channel.replace('_', ' ')}"
    return Key(meaning, Takes.COLUMN, unit, keys=COLUMN_KEYS, example=f'"{channel} [{unit}]"')


INTERSAMPLE_KEY = Key(
    "by default a command is held", Takes.TEXT, choices={kind.value: kind for kind in Intersample}, example='"held"'
)
SIDECAR_KEYS: Mapping[str, Key] = {
    ACCEPTED_CHECKS: Key("checks that this log need not pass", Takes.LIST, usual=[], example='["work"]'),
    DATE: Key("when this log was taken, for track; before its stamps and its name", Takes.TEXT, example='"2026-03-12"'),
    "columns": table(
        "which column is which channel; false leaves one out; the header says the others",
        {channel: _column_key(channel, unit) for channel, unit in CHANNELS.items()},
        others=Key("column of another signal of the drive", Takes.COLUMN, "{own}", keys=COLUMN_KEYS),
        named="signal",
    ),
    "noise": table(
        "standard deviations; by default as the log shows",
        {},
        others=Key("of that channel", unit="{own}", example='"20 um"'),
        named="channel",
    ),
    "conditions": table(
        "known values that hold in this log only",
        {},
        others=Key("its value in this log", unit="{own}", example='"6.3 bar(g)"'),
        named="parameter",
    ),
    "intersample": table(
        "how channels run between two samples",
        {},
        others=INTERSAMPLE_KEY,
        named="channel",
    ),
}
"""The sections of a sidecar, and what stands before them."""
