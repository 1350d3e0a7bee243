"""`write_report`: a result as one page of HTML."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.reference import Reference, as_references
from pneuopt.dynamics.runnable import HasSystem
from pneuopt.evaluation.band import Band
from pneuopt.evaluation.certificate import Certificate
from pneuopt.identification.result import IdentificationResult
from pneuopt.identification.tracking import Tracking
from pneuopt.logs.experiments import Experiment
from pneuopt.plotting import plot_sensitivity
from pneuopt.quantities.arguments import as_tuple
from pneuopt.quantities.errors import require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.shown import Shown
from pneuopt.report.fit_page import Source, fit_page
from pneuopt.report.page import Picture, write_page
from pneuopt.report.summary_page import summary_page, tracking_picture
from pneuopt.report.tuning_page import LoopView, simulation_page, tuning_page
from pneuopt.studies.sensitivity import Sensitivity
from pneuopt.tuning.result import TuningResult

LOGS = "an Experiment or several, as read_log(path) gives them"
_TITLES: dict[type, str] = {IdentificationResult: "Identification", TuningResult: "Tuning", Certificate: "Certificate"}


def write_report(
    result: Shown,
    path: str | Path,
    *,
    title: str = "",
    model: HasSystem | ClosedLoop | None = None,
    experiments: Experiment | Sequence[Experiment] = (),
    held_out: Experiment | Sequence[Experiment] = (),
    references: Reference | Sequence[Reference] = (),
    parameters: ParameterSet | None = None,
    band: Band = 0.02,
) -> None:
    """Write a result as one page of HTML that needs no network: verdict first, figures where they belong, hashes.

    The same result gives the same page, to the letter. A result that did not converge gets its page, too, which says
    so first. Results hold no models and no logs: what is to be drawn of these is given here. The page of a loop ends
    with sliders, which a script within it follows by simulating the loop; without scripts only they are missing.

    Parameters
    ----------
    result : Shown
        Whatever `identify`, `tune`, `certificate`, `bootstrap`, `track` or another verb returns.
    path : str or Path
    title : str
        By default the kind of the result.
    model : drive, System or ClosedLoop, optional
        Of a fit: draws its friction, and predicts held-out logs. Of a tuning or a certificate the loop: draws steps,
        the Bode plot and the diagram, and gives the gains in every form.
    experiments : Experiment or sequence of Experiment
        Of a fit: the logs that it was made from, in their order.
    held_out : Experiment or sequence of Experiment
        Logs that the fit has not seen.
    references : Reference or sequence of Reference
        Those of the loop.
    parameters : ParameterSet, optional
        Of a certificate: every parameter of its loop. Of a tuning: those before, to be drawn beside.
    band : float
        Half width of the settling band, a fraction of the step.

    Raises
    ------
    InputError
        If the result is no such object, a figure lacks what it is drawn from, or the file cannot be written; no file is
        left then.

    Examples
    --------
    >>> import tempfile
    >>> from pneuopt.quantities.report import Line, Report
    >>> class Found(Shown):
    ...     def summary(self):
    ...         return Report((Line("nothing is wrong"),))
    >>> place = Path(tempfile.mkdtemp()) / "found.html"
    >>> write_report(Found(), place)
    >>> "nothing is wrong" in place.read_text("utf-8")
    True
    """
    require(isinstance(result, Shown), f"a report is written of a result, got {type(result).__name__}")
    steps = as_references(references)
    logs, others = (
        as_tuple(n, given, Experiment, LOGS) for n, given in (("experiments", experiments), ("held_out", held_out))
    )
    require(not others or model is not None, "held-out logs are predicted with the model: give both")
    source = Source(title or _TITLES.get(type(result), type(result).__name__))
    if isinstance(result, IdentificationResult):
        page = fit_page(source, result, logs, model, held_out=others)
    elif isinstance(result, TuningResult):
        page = tuning_page(source, result, _view(model, steps, result.parameters, parameters, band))
    elif isinstance(result, Certificate):
        require(model is None or parameters is not None, "a certificate holds no gains: give parameters with the loop")
        page = simulation_page(source, result, _view(model, steps, parameters, None, band))
    else:
        page = summary_page(source, result.summary(), _pictures(result), (), getattr(result, "provenance", {}))
    write_page(path, page)


def _view(
    model: object, steps: Sequence[Reference], parameters: ParameterSet | None, before: ParameterSet | None, band: Band
) -> LoopView | None:
    """What a loop's figures are drawn from; None without a loop."""
    if model is None or parameters is None:
        return None
    require(isinstance(model, ClosedLoop), f"the model of this result is a ClosedLoop, got {type(model).__name__}")
    assert isinstance(model, ClosedLoop)
    require(bool(steps), "a loop is drawn with its references: give both")
    earlier = None if before is None else model.complete(before)
    return LoopView(model, steps, model.complete(parameters), earlier, band)


def _pictures(result: Shown) -> tuple[Picture, ...]:
    """Of a result without a page of its own."""
    if isinstance(result, Sensitivity):
        alt = "For each figure the share of its variance that each parameter brings, with its 95 % interval."
        return (Picture(partial(plot_sensitivity, result), alt, "Shares of the variance."),)
    return (tracking_picture(result),) if isinstance(result, Tracking) else ()
