"""`load_result`: a result as its `save` has written it."""

from pathlib import Path
from typing import Any

from pneuopt.evaluation.certificate import Certificate
from pneuopt.evaluation.dither import CompensatorVerdict, DitherVerdict
from pneuopt.evaluation.rest_check import RestCheck
from pneuopt.experiments.design import ExperimentDesign
from pneuopt.identification.compare_logs import LogComparison
from pneuopt.identification.result import IdentificationResult
from pneuopt.identification.select_model import ModelSelection
from pneuopt.quantities.results import read_result
from pneuopt.tuning.result import TuningResult
from pneuopt.tuning.validation import DesignValidation

RESULT_KINDS: dict[str, type] = {
    kind.__name__: kind
    for kind in (
        *(IdentificationResult, ModelSelection, LogComparison, ExperimentDesign),
        *(TuningResult, DesignValidation, Certificate, RestCheck, DitherVerdict, CompensatorVerdict),
    )
}


def load_result(path: str | Path) -> Any:
    """Read a result that was saved: ``fit.save("fit.json")``, then ``load_result("fit.json")``.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    IdentificationResult, TuningResult or another
        Of the class that was saved, with the same numbers to the last digit. What a model needs of a log's motion
        (`Verdict.identification_hints.needs`) is not in it.

    Raises
    ------
    InputError
        If the file cannot be read, is no result, or was damaged or changed; nothing in it is ever run as code.
    """
    return read_result(path, RESULT_KINDS)
