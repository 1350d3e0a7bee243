"""The commands `pneuopt init | check | identify | tune | certify | export | ...`, as `pneuopt --help` has them.

First their help and the options that several have, then the commands. Each imports what it needs, so that `--help`
waits for no heavy import. Exit status: 0 good, 1 not converged or not certified (in a study: a case failed or never
settles), 2 bad input, 70 an error that nobody foresaw, 74 the screen's output is lost, 130 interrupted, 143 terminated.
"""

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import inf
from pathlib import Path
from typing import Annotated, NamedTuple

import typer
from typer.models import CommandFunctionType

from pneuopt.cli.run import ExitStatus, interruption_status, run_guarded
from pneuopt.quantities.errors import ConvergenceError, InputError, PhysicsWarning, require
from pneuopt.quantities.output import read_once


class CommandHelp(NamedTuple):
    """A line for the list of commands, lines to type, and where the result goes next."""

    line: str
    examples: tuple[str, ...]
    pointer: str = ""


COMMAND_HELP = {
    "init": CommandHelp(
        "Write the first files, every key explained.",
        (
            "pneuopt init pneumatic --cylinder 32 --valve 700",
            "pneuopt init --from run_01.csv",
            "pneuopt init --run drive.toml --between 20mm..180mm",
        ),
        "Then: pneuopt check drive.toml run_01.csv. What a key means: pneuopt keys KEY",
    ),
    "check": CommandHelp(
        "Show what is read, assumed and wrong before a fit.",
        ("pneuopt check drive.toml run_01.csv --plot check.png", "pneuopt check drive.toml run_*.csv --fix mended"),
        "Then: pneuopt identify drive.toml run_01.csv -o fit.toml",
    ),
    "identify": CommandHelp(
        "Fit parameters to logs, with confidence intervals.",
        (
            "pneuopt identify drive.toml run_01.csv -o fit.toml --plot fit.png",
            "pneuopt identify drive.toml run_*.csv --select",
        ),
        "Then predict another log: pneuopt simulate fit.toml --log run_02.csv",
    ),
    "tune": CommandHelp(
        "Tune PID and dither together, and certify them.",
        (
            "pneuopt tune fit.toml tuning.toml -o tuned.toml --plot tuned.png",
            "pneuopt tune fit.toml tuning.toml --rig rig.toml --report tuned.html",
        ),
        "Then: pneuopt simulate fit.toml tuned.toml, pneuopt study, pneuopt export",
    ),
    "certify": CommandHelp(
        "Certify gains as they are, or say what breaks.",
        (
            "pneuopt certify fit.toml edited.toml -o tuned.toml",
            "pneuopt certify fit.toml edited.toml --rig rig.toml",
        ),
        "Then: pneuopt export fit.toml tuned.toml",
    ),
    "simulate": CommandHelp(
        "Simulate a closed loop, or predict a log.",
        (
            "pneuopt simulate fit.toml tuned.toml -o steps.csv",
            "pneuopt simulate fit.toml --log run_02.csv --plot prediction.png",
        ),
    ),
    "study": CommandHelp(
        "Certify or tune a loop over many plants.",
        ("pneuopt study study.toml -o cases.csv --plot map.png", "pneuopt study study.toml --executor 8 --resume"),
        "What a study.toml may ask: pneuopt keys study",
    ),
    "export": CommandHelp(
        "Write the tuned controller for a PLC, or as C or Python.",
        (
            "pneuopt export fit.toml tuned.toml --to st -o plc",
            "pneuopt export fit.toml tuned.toml --to siemens",
        ),
        "--to fmu writes the plant, to be simulated with it elsewhere",
    ),
    "next-experiment": CommandHelp(
        "Plan the run that makes the estimates most certain.",
        ("pneuopt next-experiment fit.toml --duration 10s --limit position=20mm..180mm",),
        "-o run.csv writes what to play; then identify with its log, too",
    ),
    "track": CommandHelp(
        "Tell whether parameters drift over dated logs.",
        ("pneuopt track drive.toml logs/*.csv --tuned tuned.toml --plot drift.png",),
    ),
    "keys": CommandHelp(
        "Show what may stand in the files.", ("pneuopt keys", "pneuopt keys dead_zone", "pneuopt keys --outputs")
    ),
    "info": CommandHelp("Show versions, compiler, cache and speed.", ("pneuopt info",), "Quote it in a bug report"),
}


def epilog(name: str) -> str:
    r"""The lines below a command's help; \b keeps click from filling them into one paragraph."""
    text = COMMAND_HELP[name]
    lines = ["\b", "Examples:" if text.examples[1:] else "Example:", *(f"  {line}" for line in text.examples)]
    return "\n".join([*lines, *([text.pointer] if text.pointer else [])])


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


app = typer.Typer(
    name="pneuopt",
    help="Identify and optimally tune pneumatic drives: friction from logs, PID and dither together, certified.",
    epilog="Exit status: 0 good, 1 not converged or not certified, 2 bad input, 70 a bug, 130 interrupted.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


def _command(name: str) -> Callable[[CommandFunctionType], CommandFunctionType]:
    """Register a command with its help."""
    return app.command(name, short_help=COMMAND_HELP[name].line, epilog=epilog(name))


@contextmanager
def report_errors() -> Iterator[None]:
    """Turn an error that a user can mend into one message and an exit status, and a `PhysicsWarning` into one line."""
    printed: set[str] = set()

    def say(sentence: str) -> None:
        from pneuopt.cli.shared import make_console, show_sentence

        show_sentence(make_console(error=True), sentence)

    def print_warning(message: Warning | str, *_: object, **__: object) -> None:  # each once, as soon as it comes
        line = f"warning: {message}"
        if line not in printed:
            printed.add(line)
            say(line)

    try:
        with warnings.catch_warnings(), read_once():
            warnings.simplefilter("always", PhysicsWarning)
            warnings.showwarning = print_warning
            yield
    except InputError as error:
        say(f"error: {error}")
        raise typer.Exit(ExitStatus.BAD_INPUT) from None
    except ConvergenceError as error:
        say(f"NOT converged: {error}")
        raise typer.Exit(ExitStatus.FAILURE) from None
    except KeyboardInterrupt:
        say("interrupted: no file was left half-written")
        raise typer.Exit(interruption_status() or ExitStatus.INTERRUPTED) from None


def main() -> None:
    """Run the command line; `pneuopt.__main__` does the same, and listens to signals while this is imported."""
    run_guarded(lambda: app)


@app.callback(invoke_without_command=True)
def options(
    version: Annotated[bool, typer.Option("--version", is_eager=True, help="Show the version and exit.")] = False,
) -> None:
    """Take the options that stand before a command."""
    if version:
        from pneuopt import __version__

        typer.echo(f"pneuopt {__version__}")
        raise typer.Exit


@_command("init")
def init_command(
    kind: Annotated[
        str | None, typer.Argument(metavar="KIND", help="What drives the load: pneumatic, force, rotary, linear.")
    ] = None,
    size: Annotated[str | None, typer.Option(help="Of the catalogue: s25, s32 or s40.")] = None,
    cylinder: Annotated[str | None, typer.Option(help="Of the catalogue, by its bore: 25, 32 or 40.")] = None,
    valve: Annotated[str | None, typer.Option(help="Of the catalogue, by its l/min: 350, 700 or 1400.")] = None,
    folder: Annotated[Path, typer.Option("-o", "--output", metavar="FOLDER", help="Where to write.")] = Path(),
    log: Annotated[
        Path | None, typer.Option("--from", metavar="LOG", help="Fill the sidecar of this log by what it shows.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace files that are there already.")] = False,
    run: RunOf = None,
    between: Between = "",
    speed: RunSpeed = "",
    sample_time: RunSampleTime = "1ms",
) -> None:
    """Write a first drive.toml, tuning.toml, study.toml, rig.toml and log.toml, or a run to play."""
    with report_errors():
        if run is not None:
            from pneuopt.cli.init import RunOptions, run_init_run

            unused = {"KIND": kind, "--size": size, "--cylinder": cylinder, "--valve": valve, "--from": log}
            raise typer.Exit(run_init_run(run, folder, RunOptions(between, speed, sample_time), force, unused))
        require(not (between or speed), "--between and --speed are limits of a run: give --run DRIVE with them")
        from pneuopt.cli.init import run_init

        parts = {"size": size, "cylinder": cylinder, "valve": valve}
        raise typer.Exit(run_init(kind, folder, parts, log, force))


@_command("check")
def check_command(
    drive: Annotated[
        Path,
        typer.Argument(metavar="DRIVE", help="drive.toml: the hardware; what is `free` in it is to be identified."),
    ],
    logs: LogFiles,
    json: Json = None,
    plot: Plot = None,
    report: ReportFile = None,
    accept: Accept = None,
    fix: Annotated[
        Path | None,
        typer.Option(
            "--fix", metavar="FOLDER", help="Mend what rules can, and write the new logs and sidecars into this folder."
        ),
    ] = None,
) -> None:
    """Show what is read, assumed and wrong before a fit, and what the logs identify; status 1 if a fit refuses them."""
    with report_errors():
        from pneuopt.cli.check import run_check
        from pneuopt.cli.shared import Outputs, expand_patterns

        raise typer.Exit(run_check(drive, expand_patterns(logs), Outputs(None, json, plot, report), accept or (), fix))


@_command("identify")
def identify_command(
    drive: Annotated[
        Path, typer.Argument(metavar="DRIVE", help="drive.toml: the hardware; what is `free` in it is identified.")
    ],
    logs: LogFiles,
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="FILE", help="Write fit.toml.")] = None,
    json: Json = None,
    plot: Plot = None,
    report: ReportFile = None,
    window: Window = None,
    accept: Accept = None,
    select: Annotated[
        bool, typer.Option("--select", help="Compare friction models instead, and recommend one.")
    ] = False,
    budget: SearchBudget = inf,
    draws: Draws = 0,
    held_out: HeldOut = None,
    trail: Annotated[
        bool, typer.Option("--trail", help="Show what the search has tried, for how long, and why.")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Fit parameters to logs, with confidence intervals; --plot adds residuals, friction and correlation."""
    with report_errors():
        from pneuopt.cli.identify import run_identify, run_select
        from pneuopt.cli.shared import Outputs, expand_patterns

        given = drive, expand_patterns(logs), Outputs(output, json, plot, report), window, quiet, accept or ()
        require(budget > 0, f"--budget {budget:g}: give the CPU seconds that the search may take")
        require(budget == inf or not select, "--budget limits one fit: leave it out with --select")
        require(draws == 0 or draws >= 2, f"--bootstrap {draws}: a spread takes two sets of logs at least")
        require(not (draws and select), "--bootstrap tries one model's fit: leave it out with --select")
        require(not held_out or report is not None, "--held-out predicts a log in the report: name it, --report FILE")
        require(not (trail and select), "--trail shows one fit's search: leave it out with --select")
        raise typer.Exit(run_select(*given) if select else run_identify(*given, budget, draws, held_out or (), trail))


@_command("tune")
def tune_command(
    fit: Annotated[
        Path, typer.Argument(metavar="FIT", help="fit.toml, or a drive.toml: the plant; nothing of it is tuned.")
    ],
    tuning: Annotated[
        Path, typer.Argument(metavar="TUNING", help="tuning.toml: controller, references, requirements.")
    ],
    rig: RigFile = None,
    structure: Annotated[
        bool, typer.Option("--structure", help="Adopt another part of the controller where that is certified, better.")
    ] = False,
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="FILE", help="Write tuned.toml.")] = None,
    json: Json = None,
    plot: Plot = None,
    report: ReportFile = None,
    quiet: Quiet = False,
) -> None:
    """Tune PID and dither together, and certify them."""
    with report_errors():
        from pneuopt.cli.shared import Outputs
        from pneuopt.cli.tune import run_tune

        raise typer.Exit(run_tune(fit, tuning, rig, Outputs(output, json, plot, report), quiet, structure))


@_command("certify")
def certify_command(
    fit: Annotated[Path, typer.Argument(metavar="FIT", help="fit.toml, or a drive.toml: the plant.")],
    tuning: Annotated[
        Path, typer.Argument(metavar="TUNING", help="tuned.toml with edited gains, or a tuning.toml: taken as it is.")
    ],
    rig: RigFile = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE", help="Write tuned.toml, if all holds.")
    ] = None,
    json: Json = None,
    plot: Plot = None,
    report: ReportFile = None,
    quiet: Quiet = False,
) -> None:
    """Certify gains as they are, after an edit say, or say what breaks; status 1 if so."""
    with report_errors():
        from pneuopt.cli.shared import Outputs
        from pneuopt.cli.tune import run_certify

        raise typer.Exit(run_certify(fit, tuning, rig, Outputs(output, json, plot, report), quiet))


@_command("simulate")
def simulate_command(
    fit: Annotated[Path, typer.Argument(metavar="FIT", help="fit.toml, or a drive.toml.")],
    tuning: Annotated[
        Path | None, typer.Argument(metavar="[TUNING]", help="tuning.toml or tuned.toml: simulate its closed loop.")
    ] = None,
    log: Annotated[Path | None, typer.Option(metavar="LOG", help="Predict this log instead, in open loop.")] = None,
    window: Window = None,
    output: CsvFile = None,
    json: Json = None,
    plot: Plot = None,
    report: ReportFile = None,
    quiet: Quiet = False,
) -> None:
    """Simulate a closed loop, or predict a log."""
    with report_errors():
        require((tuning is None) != (log is None), "give either a tuning file or --log, to say what to simulate")
        from pneuopt.cli.identify import run_predict
        from pneuopt.cli.shared import Outputs
        from pneuopt.cli.simulate import run_simulate

        outputs = Outputs(output, json, plot, report)
        require(window is None or log is not None, "--window cuts a log: give it with --log")
        if tuning is not None:
            raise typer.Exit(run_simulate(fit, tuning, outputs))
        if log is not None:
            raise typer.Exit(run_predict(fit, log, window, outputs, quiet))


@_command("study")
def study_command(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="study.toml: the drive, the tuning, and which cases, or a front.")
    ],
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="FILE", help="CSV, or .parquet.")] = None,
    json: Json = None,
    plot: Plot = None,
    report: ReportFile = None,
    executor: ExecutorAt = "",
    time_limit: Annotated[
        float, typer.Option(metavar="SECONDS", help="A case that takes longer is killed.", show_default="none")
    ] = inf,
    memory_limit: Annotated[
        float, typer.Option(metavar="MB", help="A case that needs more memory fails.", show_default="none")
    ] = inf,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the cases of an earlier run, and refuse if it was another one.")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Certify a loop over any plants, or tune it over a grid or along a Pareto front; status 1 if a case fails."""
    with report_errors():
        from pneuopt.cli.shared import Outputs
        from pneuopt.cli.study import Computing, run_study

        computing = Computing(executor, time_limit, memory_limit, resume)
        raise typer.Exit(run_study(file, Outputs(output, json, plot, report), quiet, computing))


@_command("export")
def export_command(
    fit: Annotated[Path, typer.Argument(metavar="FIT", help="fit.toml, or a drive.toml: the plant, for units.")],
    tuned: Annotated[Path, typer.Argument(metavar="TUNED", help="tuned.toml: the controller.")],
    to: Annotated[
        str,
        typer.Option(
            metavar="FORM",
            help="c, st (IEC 61131-3 structured text), python; or the settings of a PID block: siemens, rockwell, "
            "beckhoff, codesys, simulink; or fmu, the plant (FMI 3.0).",
        ),
    ],
    folder: Annotated[Path, typer.Option("-o", "--output", metavar="FOLDER", help="Where to write.")] = Path(),
    name: Annotated[
        str, typer.Option(metavar="NAME", help="Of the block and its files.", show_default="controller")
    ] = "controller",
    pv_span: Annotated[
        str, typer.Option(metavar="VALUE", help="Of rockwell: the span that its PV is scaled to, 0.5m/s.")
    ] = "",
    uncertified: Annotated[bool, typer.Option("--uncertified", help="Export gains that no certificate holds.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace files that are there already.")] = False,
) -> None:
    """Write a tuned sampled controller as C99, structured text or Python, or as the settings of a maker's PID block."""
    with report_errors():
        from pneuopt.cli.export import run_export

        raise typer.Exit(run_export(fit, tuned, to, folder, name, uncertified, force, pv_span))


@_command("next-experiment")
def next_experiment_command(
    fit: Annotated[Path, typer.Argument(metavar="FIT", help="fit.toml: estimates, their covariance, what is free.")],
    duration: Annotated[str, typer.Option(metavar="TIME", help="Of a run: 10s.")],
    limit: Annotated[
        list[str],
        typer.Option(metavar="SIGNAL=LOW..HIGH", help="Kept at every sample: position=20mm..180mm; repeatable."),
    ],
    tuning: Annotated[
        Path | None, typer.Option("--loop", metavar="TUNING", help="tuning.toml: run its loop; else in open loop.")
    ] = None,
    target: Annotated[
        str, typer.Option(metavar="NAMES", help="Parameters, with commas, * for any.", show_default="all free ones")
    ] = "",
    sample_time: Annotated[str, typer.Option(metavar="TIME", help="Of an open loop: 1ms.")] = "",
    noise: Annotated[
        list[str] | None,
        typer.Option(metavar="SIGNAL=VALUE", help="Of what will be logged; as in the fit's logs if left out."),
    ] = None,
    start: Annotated[
        list[str] | None, typer.Option(metavar="SIGNAL=VALUE", help="Rest from which a run begins.")
    ] = None,
    runs: Annotated[int, typer.Option(metavar="N", help="Runs that are planned together.")] = 1,
    mean: Annotated[bool, typer.Option("--mean", help="Make the mean deviation small, not the joint region.")] = False,
    budget: Annotated[float, typer.Option(metavar="SECONDS", help="CPU time of the search.")] = 60.0,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE", help="Write what to play, CSV.")
    ] = None,
    json: Json = None,
    plot: Plot = None,
    report: ReportFile = None,
    quiet: Quiet = False,
) -> None:
    """Plan the run that shrinks the confidence intervals of a fit most, within limits."""
    with report_errors():
        from pneuopt.cli.shared import Outputs
        from pneuopt.cli.track import PlannedOptions, run_next_experiment

        targets = tuple(filter(None, (n.strip() for n in target.split(","))))
        lists = (tuple(limit), tuple(noise or ()), tuple(start or ()))
        options = PlannedOptions(duration, sample_time, targets, *lists, runs, mean, budget)
        raise typer.Exit(run_next_experiment(fit, tuning, options, Outputs(output, json, plot, report), quiet))


@_command("track")
def track_command(
    drive: Annotated[Path, typer.Argument(metavar="DRIVE", help="drive.toml: what is `free` in it is tracked.")],
    logs: Annotated[list[Path], typer.Argument(metavar="LOGS", help="Four or more logs, each of another day.")],
    tuned: Annotated[
        Path | None, typer.Option(metavar="FILE", help="tuned.toml: predict what its loop is worth.")
    ] = None,
    parameter: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Track this one alone; repeatable.")
    ] = None,
    dates: Annotated[
        str, typer.Option(metavar="DATES", help="A date a log, with commas.", show_default="as stamps or names say")
    ] = "",
    drift: Annotated[float, typer.Option(metavar="PERCENT", help="A week, to say after how many logs it is seen.")] = 1,
    horizon: Annotated[int, typer.Option(metavar="N", help="Logs for which 1 % of false alarms holds.")] = 52,
    output: CsvFile = None,
    json: Json = None,
    plot: Plot = None,
    report: ReportFile = None,
    quiet: Quiet = False,
) -> None:
    """Tell whether parameters drift over dated logs, and what that does to a tuned loop; status 1 if so."""
    with report_errors():
        from pneuopt.cli.shared import Outputs, expand_patterns
        from pneuopt.cli.track import TrackOptions, run_track

        require(drift > 0, f"--drift {drift:g}: give the percent a week that is to be seen")
        options = TrackOptions(tuned, tuple(parameter or ()), dates, drift / 100, horizon)
        raise typer.Exit(run_track(drive, expand_patterns(logs), options, Outputs(output, json, plot, report), quiet))


@_command("keys")
def keys_command(
    word: Annotated[
        str | None, typer.Argument(metavar="WORD", help="A file, a section, a key, or a word of its meaning.")
    ] = None,
    markdown: Annotated[bool, typer.Option("--markdown", help="Print tables in Markdown.")] = False,
    outputs: Annotated[bool, typer.Option("--outputs", help="Show what each command writes with --json.")] = False,
) -> None:
    """Show what may stand in the files: each key, its unit, its default and what it means."""
    with report_errors():
        from pneuopt.cli.info import run_keys, run_outputs

        require(not (outputs and word), "--outputs shows all outputs: give no WORD beside it")
        raise typer.Exit(run_outputs(markdown) if outputs else run_keys(word, markdown))


@_command("info")
def info_command() -> None:
    """Show versions, compiler, cache, a self-check and the speed, to be quoted in a question or a bug report."""
    with report_errors():
        from pneuopt.cli.info import run_info

        raise typer.Exit(run_info())
