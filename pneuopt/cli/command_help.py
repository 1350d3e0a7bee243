"""What `pneuopt --help` says of each command in a line, and the examples and pointers below a command's own help."""

from typing import NamedTuple


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
    said = COMMAND_HELP[name]
    lines = ["\b", "Examples:" if said.examples[1:] else "Example:", *(f"  {line}" for line in said.examples)]
    return "\n".join([*lines, *([said.pointer] if said.pointer else [])])
