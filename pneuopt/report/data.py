"""What pages say of their data: the logs with their channels, the hashes of what was read, the versions."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from pneuopt.logs.experiments import Experiment
from pneuopt.quantities.report import Line, Report, Table, Tone, format_number, number_columns, text_columns
from pneuopt.quantities.units import write_value
from pneuopt.report.page import Section

_HASH = "sha256["
"""What a name in a provenance begins with, where its value is the hash of a file or a log."""


def data_section(experiments: Sequence[Experiment], noise: Mapping[tuple[str, str], float] | None = None) -> Section:
    """Logs, a row each, and their channels with range and noise.

    Parameters
    ----------
    experiments : sequence of Experiment
    noise : mapping, optional
        By log and channel, the noise that a fit has counted with [SI] where the log states none.
    """
    if not experiments:
        return Section("Data", ())
    logs, channels = [], []
    for log in experiments:
        t = log.trajectory.t
        rate = write_value(float(np.median(np.diff(t))), "s", 4) if len(t) > 1 else "-"
        source = log.source.path if log.source else ""
        logs.append((log.name or "log", str(len(t)), f"{t[0]:.6g}", f"{t[-1]:.6g}", rate, source))
        channels += [_channel_row(log, channel, noise or {}) for channel in log.trajectory]
    heads = *text_columns("log"), *number_columns("samples", "from [s]", "to [s]", "one every")
    own = *text_columns("log", "channel", "column"), *number_columns("least", "largest", "noise", "missing")
    known = (Line(f"in {e.name}: {n} = {value:.6g}") for e in experiments for n, value in e.conditions.items())
    remarks = (Line(f"{e.name}: {remark}") for e in experiments for remark in e.remarks)
    table = Table((*heads, *text_columns("file")), tuple(logs))
    return Section("Data", (Report((table, Table(own, tuple(channels)), *known, *remarks)),))


def provenance_section(provenance: Mapping[str, str], hashes: Mapping[str, str]) -> Section:
    """What a result was computed from, by hash, and with which versions and options."""
    known = {**{n: v for n, v in provenance.items() if n.startswith(_HASH)}, **hashes}
    files = tuple((n.removeprefix(_HASH).removesuffix("]"), str(value)) for n, value in known.items() if value)
    others = {n: str(v) for n, v in provenance.items() if not n.startswith(_HASH)}
    options = others.pop("options", "")
    lines = [Line(", ".join(f"{n} {value}" for n, value in others.items()))] if others else []
    tables = [Table(text_columns("read", "SHA-256"), files)] if files else []
    said = [Line("options", Tone.HEADING), *(Line(text) for text in options.split("; "))] if options else []
    return Section("Provenance", (Report((*tables, *lines, *said)),))


def _channel_row(log: Experiment, channel: str, counted: Mapping[tuple[str, str], float]) -> tuple[str, ...]:
    values, unit = log.trajectory[channel], log.unit(channel)
    column = log.source.columns.get(channel) if log.source else None
    finite = values[np.isfinite(values)]
    low, high = (write_value(float(f(finite)), unit or "1", 4) if finite.size else "-" for f in (np.min, np.max))
    level = log.noise.get(channel, counted.get((log.name, channel), math.nan))
    noise = "-" if math.isnan(level) else write_value(level, unit or "1", 3)
    missing = format_number(len(values) - finite.size, 6)
    return (log.name or "log", channel, column.name if column else "", low, high, noise, missing)
