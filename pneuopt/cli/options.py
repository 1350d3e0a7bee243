"""Options that several commands have."""

from pathlib import Path
from typing import Annotated

import typer

Json = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write all figures as JSON.")]
Plot = Annotated[Path | None, typer.Option("--plot", metavar="FILE", help="Draw: .png, .pdf or .svg.")]
ReportFile = Annotated[
    Path | None,
    typer.Option("--report", metavar="FILE", help="Write one page of HTML: verdict first, tables, figures, hashes."),
]
Window = Annotated[
    float | None, typer.Option(metavar="SECONDS", help="Cut the logs into windows, each with a start of its own.")
]
Accept = Annotated[
    list[str] | None,
    typer.Option(
        metavar="CHECK",
        help="Logs are right: motion, speed, work, command, scale, jumps, stops, mass, pressures; repeatable.",
    ),
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress.")]
RunOf = Annotated[
    Path | None,
    typer.Option("--run", metavar="DRIVE", help="Write a run of moves from whose log this drive is identified."),
]
Between = Annotated[
    str, typer.Option(metavar="LOW..HIGH", help="Of --run: 20mm..180mm.", show_default="a tenth from either end stop")
]
RunSpeed = Annotated[
    str, typer.Option(metavar="VALUE", help="Of --run, the largest: 0.3m/s.", show_default="half the drive's")
]
RunSampleTime = Annotated[str, typer.Option(metavar="TIME", help="Of --run, the controller's.")]
RigFile = Annotated[
    Path | None,
    typer.Option("--rig", metavar="FILE", help="rig.toml: certify with its stick-slip, valve and sensors too."),
]
CsvFile = Annotated[Path | None, typer.Option("-o", "--output", metavar="FILE", help="Write a CSV file.")]
LogFiles = Annotated[
    list[Path], typer.Argument(metavar="LOGS", help="Log files, each with its sidecar .toml if it has one.")
]
SearchBudget = Annotated[
    float,
    typer.Option(
        metavar="SECONDS",
        help="CPU time after which the search ends with the best values so far.",
        show_default="none",
    ),
]
Draws = Annotated[
    int,
    typer.Option(
        "--bootstrap",
        metavar="N",
        help="Simulate the logs N times with the estimates, and with stick-slip if the fit misses them; fit again.",
    ),
]
HeldOut = Annotated[
    list[Path] | None,
    typer.Option(metavar="LOG", help="Predict this log, which the fit has not seen, in the report; repeatable."),
]
ExecutorAt = Annotated[
    str,
    typer.Option(
        metavar="WHERE",
        help="A number of processes, dask (a cluster on this machine), or the address of a dask scheduler, "
        "tcp://host:8786.",
        show_default="one process a CPU",
    ),
]
