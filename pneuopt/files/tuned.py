"""tuned.toml: a tuning's file with the gains found and their certificate."""

from collections.abc import Mapping
from dataclasses import replace
from math import isclose
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tomlkit

from pneuopt.evaluation.evaluate import metric_limits
from pneuopt.evaluation.response import cases
from pneuopt.files.certificate import CHECKSUM, checksum_section
from pneuopt.files.drive import StoredFit, read_fit
from pneuopt.files.loop import TUNABLE_SECTIONS
from pneuopt.files.tolerances import FILE_DIGITS
from pneuopt.files.toml import inline_table, read_parameter, read_toml, toml_table, write_parameter
from pneuopt.files.tuning import TUNED_SECTIONS, move_paths, read_tuning_table
from pneuopt.quantities.errors import InputError, require
from pneuopt.quantities.output import plain_value, write_text
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.units import write_value

if TYPE_CHECKING:
    from pneuopt.tuning.result import TuningResult


def write_tuned(
    path: str | Path,
    source: str | Path,
    result: "TuningResult",
    wire: Mapping[str, str] | None = None,
    *,
    fit: str | Path | StoredFit | None = None,
) -> None:
    """Write a tuning's file with the gains found: the user's text and comments, [certified], [status], [provenance].

    Parameters
    ----------
    path : str or Path
        `read_tuning` reads it. Of a result that is not certified it gets the best candidate's gains and no figures, and
        its status says so.
    source : str or Path
        The tuning.toml that the result was made from.
    result : TuningResult
    wire : mapping of str to str, optional
        `Tuning.wire`.
    fit : str, Path or StoredFit, optional
        The plant's file that the result was made with. Without it the certificate gets no checksum: `pneuopt export`
        then takes the gains for uncertified.

    Raises
    ------
    InputError
        If one of the files cannot be read or written, the result has neither design nor candidate, or is about other
        values, references or limits than the files.
    """
    gains = result.candidate
    if gains is None:
        raise InputError(f"{path}: not written, for the tuning found no candidate: {result.status.verdict}")
    document = read_toml(source)
    for name in TUNED_SECTIONS:
        document.pop(name, None)
    move_paths(document.get("reference", []), Path(source).parent, Path(path).parent)
    for section in TUNABLE_SECTIONS:
        for key, entry in document.unwrap().get(section, {}).items():
            if isinstance(entry, dict) and entry.get("free", False):
                found = gains[f"{section}.{key}"]
                given = read_parameter(entry, replace(found, free=True), f"{source}: [{section}] {key}")
                write_parameter(document, f"{section}.{key}", replace(given, value=found.value), given)  # in its unit
    status: dict[str, Any] = {"code": result.status.code.value, "message": result.status.message}
    if result.status.converged:
        rows = result.certified.to_dict(orient="dict")
        document["certified"] = toml_table({str(name): inline_table(row) for name, row in rows.items()})
    else:
        status["gains"] = "the best candidate that was found; no certificate holds it"
    if wire:
        document["wire"] = toml_table(wire)
    document["status"] = toml_table(status)
    document["provenance"] = toml_table(plain_value(result.provenance))
    if fit is not None:
        stored = fit if isinstance(fit, StoredFit) else read_fit(fit)
        _check_subject(document.unwrap(), path, stored, result, gains)
        document[CHECKSUM] = checksum_section(document.unwrap(), path, stored)
    write_text(path, tomlkit.dumps(document))


def _check_subject(
    table: Mapping[str, Any], path: str | Path, fit: StoredFit, result: "TuningResult", gains: ParameterSet
) -> None:
    """Refuse to bind a certificate to files that say something else than what was certified."""
    plant = fit.parameters
    task = read_tuning_table(table, path, fit.drive.system(), plant)
    known = plant | task.parameters
    for n, p in known.items():
        same = n not in gains or isclose(gains.value(n), p.value, rel_tol=10.0 ** (1 - FILE_DIGITS))
        values = f"{write_value(p.value, p.unit)}, the result was made with {write_value(gains[n].value, p.unit)}"
        require(same, f"{path}: {n} is {values}" if n in task.parameters else f"{fit.path}: {n} is {values}")
    labels = [case.label for case in cases(task.references, task.scenarios(known), known)]
    message = "the result was made with other references or scenarios than its file has"
    require(labels == [str(n) for n in result.certified.columns], f"{path}: {message}")
    same = not result.limits or dict(result.limits) == metric_limits(task.specification.limits)
    require(same, f"{path}: the result was made with other limits than its file has")
