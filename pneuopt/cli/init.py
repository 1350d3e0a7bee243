"""The command `init`: the first files of a new user, each whole or not at all, none over an old one."""

from collections.abc import Mapping
from pathlib import Path

import typer

from pneuopt.cli.exit_status import EXIT_SUCCESS
from pneuopt.files.first_files import first_files, first_kinds
from pneuopt.models.catalog import CATALOGUE_SOURCE, catalogue_values
from pneuopt.quantities.errors import check_names, require
from pneuopt.quantities.output import check_output_paths, write_text
from pneuopt.quantities.parameters import ParameterSet

USUAL_SIZE = "s32"  # of the catalogue: the middle one
_CATALOGUE_KIND = "pneumatic"


def run_init(kind: str | None, folder: Path, parts: Mapping[str, str | None], force: bool) -> int:
    """Write the files and say which.

    Parameters
    ----------
    kind : str, optional
    folder : Path
        Made where it is missing.
    parts : mapping of str to str or None
        "size", "cylinder" and "valve" of the catalogue.
    force : bool
        Whether old files may be replaced.
    """
    kinds = ", ".join(first_kinds())
    require(kind is not None, f"say what drives the load: pneuopt init KIND, one of {kinds}")
    check_names("kind", [str(kind)], first_kinds(), "init")
    known, source = _read_catalogue(str(kind), parts)
    files = first_files(str(kind), known, {}, source=source)
    write_files(folder, files, force)
    _show_next(folder, files)
    return EXIT_SUCCESS


def write_files(folder: Path, files: Mapping[str, str], force: bool) -> None:
    """Write files below a folder, all or none: an old one with another text is refused, unless forced.

    Raises
    ------
    InputError
        Before the first is written, if one of them may not or cannot be.
    """
    paths = {folder / name: text for name, text in files.items()}
    for path, text in paths.items():
        is_new = force or not path.exists() or path.read_bytes() == text.encode()
        require(
            is_new, f"{path}: is there already, and was left as it is; --force replaces it, -o names another folder"
        )
    for parent in dict.fromkeys(path.parent for path in paths):
        try:
            parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            require(False, f"{parent}: the folder cannot be made ({error.strerror}); name another with -o")
    check_output_paths(paths, [])
    for path, text in paths.items():
        write_text(path, text)


def _read_catalogue(kind: str, parts: Mapping[str, str | None]) -> tuple[ParameterSet, tuple[str, ...]]:
    """The catalogue's values, and the lines that say where they come from."""
    asked = {what: name for what, name in parts.items() if name is not None}
    if kind != _CATALOGUE_KIND:
        require(not asked, f"--{next(iter(asked), '')} is of the catalogue of pneumatic drives; leave it out")
        return ParameterSet(), ()
    chosen = {"size": USUAL_SIZE, **asked}
    known = catalogue_values(chosen["size"], chosen.get("cylinder"), chosen.get("valve"))
    words = ", ".join(f"{what} {name}" for what, name in chosen.items())
    return known, (f"Values of the catalogue ({words}): {CATALOGUE_SOURCE}.",)


def _show_next(folder: Path, files: Mapping[str, str]) -> None:
    names = [name for name in files if name.endswith(".toml")]
    typer.echo(f"wrote {', '.join(names)} and schemas/ in {folder.resolve() if str(folder) == '.' else folder}")
    typer.echo("Next: put what you know into drive.toml, then")
    typer.echo("  pneuopt identify drive.toml LOG -o fit.toml      # logs whose headers say position [mm]")
    typer.echo("  pneuopt tune fit.toml tuning.toml -o tuned.toml")
    typer.echo("What a key means: pneuopt keys KEY")
