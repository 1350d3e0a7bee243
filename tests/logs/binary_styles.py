"""The log of `styles` as programs write it that do not write text."""

from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import numpy as np
import pandas as pd

from tests.logs.styles import (
    FOREIGN,
    POSITION,
    PRESSURE,
    ROWS,
    STAMPS,
    STEP,
    TIME,
    VOLTAGE,
    N,
    Style,
    join,
    write_lines,
)

COLUMNS = {"position": ("mm", POSITION), "valve_voltage": ("V", VOLTAGE), "pressure_a": ("bar(g)", PRESSURE)}
LVM_HEAD = (
    "LabVIEW Measurement\t\nWriter_Version\t2\nReader_Version\t2\nSeparator\tTab\nDecimal_Separator\t.\n"
    "Multi_Headings\tNo\nX_Columns\t{x}\nTime_Pref\tRelative\nOperator\trig\nDate\t2026/03/12\nTime\t23:59:59.7\n"
    "***End_of_Header***\t\n\t\nChannels\t3\t\t\t\nSamples\t40\t40\t40\t\nDate\t2026/03/12\t2026/03/12\t2026/03/12\t\n"
    "Y_Unit_Label\tMillimeters\tVolts\tbar(g)\t\nX_Dimension\tTime\tTime\tTime\t\n"
    "X0\t0.0000000000000000E+0\t0.0000000000000000E+0\t0.0000000000000000E+0\t\n"
    "Delta_X\t0.020000\t0.020000\t0.020000\t\n***End_of_Header***\t\t\t\t\n{names}\tComment"
)
REMARK = "rows 1 to 21 are read as the head of a LabVIEW measurement file"


def lvm(x: str, names: str, rows: list[str]) -> Callable[[Path], object]:
    return write_lines(LVM_HEAD.format(x=x, names=names).replace("Millimeters", "mm"), rows, end="\r\n")


def write_sheet(path: Path) -> None:
    """A sheet with metadata, a row of units, and times that Excel shows as such."""
    import openpyxl

    book = openpyxl.Workbook()
    book.active.title = "About"
    book.active.append(["Rig B", None, "seal 3"])
    sheet = book.create_sheet("Log")
    for head in (["Recorder", "DAQ-8"], [], ["Time", *COLUMNS, "remark"], ["hh:mm:ss", "mm", "V", "bar(g)"]):
        sheet.append(head)
    for stamp, row in zip(STAMPS, ROWS, strict=True):
        sheet.append([stamp.replace(tzinfo=None), *row[1:], "ok"])
    book.save(path)


def write_fast_sheet(path: Path) -> None:
    """Times of day over midnight, in days as numbers that Excel shows as times."""
    import openpyxl

    book = openpyxl.Workbook()
    book.active.append(["Uhrzeit", "Weg", "U_Ventil", "p_A"])
    for row in ROWS:
        book.active.append([(0.99999 + row[0] / 86400) % 1, *row[1:]])
        book.active.cell(book.active.max_row, 1).number_format = "hh:mm:ss.000"
    book.save(path)


def write_vectors(path: Path) -> None:
    from scipy.io import savemat

    savemat(path, {"time_s": np.array(TIME), **{f"{n}_{unit}": np.array(v) for n, (unit, v) in COLUMNS.items()}})


def write_simulink(path: Path) -> None:
    """A scope's "Structure With Time"."""
    from scipy.io import savemat

    kind = [("values", object), ("dimensions", object), ("label", object)]
    labels = ("Weg", "U_Ventil", "p_A")
    signals = [(np.array(v)[:, None], 1.0, label) for label, (_, v) in zip(labels, COLUMNS.values(), strict=True)]
    savemat(path, {"ScopeData": {"time": np.array(TIME), "signals": np.array(signals, kind), "blockName": "rig/Scope"}})


def write_dspace(path: Path) -> None:
    """ControlDesk's structure of X and Y."""
    from scipy.io import savemat

    kind = [("Name", object), ("Data", object), ("Unit", object)]
    x = np.array([(np.zeros((0, 0)), np.array(TIME), "s")], kind)
    y = np.array([(name, np.array(v), unit) for name, (unit, v) in COLUMNS.items()], kind)
    savemat(path, {"run_003": {"X": x, "Y": y, "Description": {"General": "rig B"}}})


def write_waveforms(path: Path) -> None:
    from nptdms import ChannelObject, TdmsWriter

    grid = {"wf_start_time": datetime(2026, 3, 12), "wf_start_offset": 0.0, "wf_increment": STEP, "wf_samples": N}
    with TdmsWriter(path) as writer:
        writer.write_segment(
            [ChannelObject("DAQ", n, np.array(v), {**grid, "unit_string": u}) for n, (u, v) in COLUMNS.items()]
        )


def write_groups(path: Path) -> None:
    """MDF 4 with a second group of another rate."""
    from asammdf import MDF, Signal

    with MDF() as file:
        file.append([Signal(np.array(v), np.array(TIME), unit=u, name=n) for n, (u, v) in COLUMNS.items()])
        file.append([Signal(np.zeros(3), np.array([0.0, 0.3, 0.6]), unit="degC", name="temperature")])
        file.save(path, overwrite=True)


def write_stamps(path: Path) -> None:
    """Parquet with time stamps in a zone, and units in the fields' metadata."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    stamps = pa.array(STAMPS, pa.timestamp("us", "Europe/Berlin"))
    fields = [pa.field(n, pa.float64(), metadata={"unit": u}) for n, (u, _) in COLUMNS.items()]
    schema = pa.schema([pa.field("recorded", stamps.type), *fields])
    pq.write_table(pa.Table.from_arrays([stamps, *(pa.array(v) for _, v in COLUMNS.values())], schema=schema), path)


def write_pandas(path: Path) -> None:
    """Parquet as pandas writes it, with the time as the index."""
    frame = pd.DataFrame({f"{n} [{unit}]": v for n, (unit, v) in COLUMNS.items()})
    frame.set_axis(pd.Index(TIME, name="time [s]")).to_parquet(path)


BINARY_STYLES: dict[str, Style] = {
    "LabVIEW .lvm with one X column": Style(
        ".lvm", lvm("One", "X_Value\tposition\tvalve_voltage\tpressure_a", join("\t")), remark=REMARK
    ),
    "LabVIEW .lvm without an X column": Style(
        ".lvm",
        lvm(
            "No",
            "X_Value\tposition\tvalve_voltage\tpressure_a",
            [
                f"\t{r}" + ("\tvalve warm" if k == 0 else "")
                for k, r in enumerate(join("\t", rows=[x[1:] for x in ROWS]))
            ],
        ),
    ),
    "LabVIEW .lvm with an X column a channel": Style(
        ".lvm",
        lvm(
            "Multi",
            "X_Value\tposition\tX_Value\tvalve_voltage\tX_Value\tpressure_a",
            join("\t", ",", [(t, x, t, u, t, p) for t, x, u, p in ROWS]),
        ),
    ),
    "Excel sheet with dates": Style(".xlsx", write_sheet, remark="sheet 'Log' is read, of 2"),
    "Excel sheet with times of day over midnight": Style(".xlsx", write_fast_sheet, FOREIGN),
    "MATLAB vectors": Style(".mat", write_vectors),
    "Simulink's structure with time": Style(".mat", write_simulink, FOREIGN),
    "dSPACE ControlDesk": Style(".mat", write_dspace),
    "TDMS waveforms": Style(".tdms", write_waveforms),
    "MDF 4": Style(".mf4", write_groups),
    "Parquet with stamps and units": Style(".parquet", write_stamps),
    "Parquet of pandas": Style(".parquet", write_pandas),
}
