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
