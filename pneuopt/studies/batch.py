"""`evaluate_batch`: one design on thousands of plants, many at once in SIMD lanes; the worst and some others certified.

The lanes (`PlantBatch`) integrate by RK4 on one grid of samples, as a search does, and the metrics are read off them by
the records that the certificate reads by. They have no events of stick-slip, no margins and no continuation beyond the
horizon: those are left to the certificate. What the lanes say is held to `evaluate`, the independent simulation, on the
plants on which a metric is worst, and on a share of all that is drawn at random.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from math import ceil, inf, nan
from typing import TYPE_CHECKING, Any

import numpy as np

from pneuopt.control.loop import ClosedLoop, add_disturbances, check_closed_loop
from pneuopt.control.reference import Reference, as_references
from pneuopt.dynamics.compiled.rollout import Pieces, Rollout, processor_count
from pneuopt.dynamics.runnable import check_smooth
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.metric import Band, Source
from pneuopt.evaluation.metrics import check_channels
from pneuopt.evaluation.requirements import METRICS, larger_is_better
from pneuopt.evaluation.response import TuningCase
from pneuopt.evaluation.scenarios import generator
from pneuopt.quantities.arrays import Array, Indices
from pneuopt.quantities.errors import PneuoptError, check_names, require
from pneuopt.quantities.parameters import ParameterSet, as_tuple, check_parameters
from pneuopt.quantities.report import Line, Report, Table, Tone, format_number, number_columns, text_columns
from pneuopt.quantities.results import Shown
from pneuopt.quantities.status import Progress, ProgressReporter
from pneuopt.studies.executors import INTERRUPTED_CASE, Outcome, Processes
from pneuopt.studies.journal import CaseMarks, Journal
from pneuopt.studies.sweep import sweep
from pneuopt.studies.tolerances import CHUNK_A_CORE, MAX_PROBED, RATE_MARGIN, SAME_START
from pneuopt.tuning.space import (
    LoopLanes,
    ReferenceGrid,
    dither_resolution_rate,
    fastest_eigenvalue,
    reference_grids,
    rk4_substeps,
)
from pneuopt.tuning.tolerances import MAX_LOOP_SUBSTEPS

if TYPE_CHECKING:
    import pandas as pd


BATCH_METRICS = ("SettlingTime", "Overshoot", "SteadyStateError", "PeakControl")
LANE_METRICS = tuple(n for n, m in METRICS.items() if m.source is not Source.LINEAR_LOOP and n != "StepEnvelope")
"""The metrics that lanes can tell: those of the response, the command and the meter."""

CERTIFIED = "certified "  # before a plant's name where a journal keeps its certificate, beside its metrics in lanes


@dataclass(frozen=True, eq=False, repr=False)
class BatchEvaluation(Shown):
    """Findings of `evaluate_batch`; prints its `summary()`.

    Attributes
    ----------
    table : DataFrame
        A row a case, in their order: "case"; each parameter in which the cases differ [SI]; the metrics, with several
        references "Overshoot[0 to 0.2]"; and "error", empty where all is well, else the reason. NaN without a figure:
        a response that never settles has no SettlingTime.
    checks : DataFrame
        A row a metric of a certified case: "case", "metric", "batch", "certified", "difference", and "agrees".
    """

    table: "pd.DataFrame"
    checks: "pd.DataFrame"

    def summary(self) -> Report:
        """The number of plants, the spread of each metric, and the largest differences from the certificate."""
        failed, differ = int((self.table["error"] != "").sum()), self.checks[~self.checks["agrees"]]
        cases, certified = len(self.table), self.checks["case"].nunique()
        agreement = f"{differ['case'].nunique()} differ" if len(differ) else "all agree"
        verdict = f"{cases} plants in lanes, {certified} of them certified: {agreement}"
        rows = [self._row(metric, own) for metric, own in self.checks.groupby("metric", sort=False)]
        columns = *text_columns("metric"), *number_columns("median", "95 %", "worst", "none", "largest difference")
        parts: list[Line | Table] = [Line(verdict, Tone.BAD if len(differ) or failed else Tone.GOOD)]
        parts += [Table(columns, tuple(rows))] if rows else []
        reasons = "; ".join(self.table["error"][self.table["error"] != ""].unique()[:3])
        parts += [Line(f"failed ({failed} of {cases}): {reasons}")] if failed else []
        for row in differ.to_dict(orient="records"):
            figures = f"{row['batch']:.6g} in the lanes, {row['certified']:.6g} certified"
            parts.append(Line(f"{row['case']}: {row['metric']} is {figures}", indent=2))
        left = "margins, events of stick-slip and what comes after the horizon are not in the lanes: see certificate"
        return Report((*parts, Line(left)))

    def _row(self, metric: object, own: "pd.DataFrame") -> tuple[str, ...]:
        values, good = self.table[str(metric)], self.table["error"] == ""
        low = larger_is_better(str(metric).partition("[")[0])
        shares = [values.median(), values.quantile(0.05 if low else 0.95), values.min() if low else values.max()]
        figures = [format_number(float(v), 4) for v in (*shares, int((good & values.isna()).sum()))]
        return (str(metric), *figures, format_number(float(own["difference"].max()), 2))


def evaluate_batch(
    loop: ClosedLoop,
    references: Reference | Sequence[Reference],
    parameters: ParameterSet,
    cases: Mapping[str, Mapping[str, float]],
    *,
    metrics: Sequence[str] = BATCH_METRICS,
    band: Band = 0.02,
    recertify: float = 0.01,
    tolerance: float = 0.01,
    seed: int = 0,
    chunk: int | None = None,
    executor: Executor | Processes | None = None,
    progress: Callable[[Progress], None] | None = None,
    journal: Journal | None = None,
) -> BatchEvaluation:
    """Evaluate a fixed design on many plants at once, and certify the worst of them and a random share.

    Parameters
    ----------
    loop : ClosedLoop
        With a plant without Karnopp's friction.
    references : Reference or sequence of Reference
        A column of each metric for each.
    parameters : ParameterSet
        The nominal plant and the gains.
    cases : mapping of str to mapping of str to float
        By the case's name the values that differ, as from `monte_carlo`, `samples`, `corners` or `grid`.
    metrics : sequence of str
        Of the response, the command or the meter, as `evaluate` names them; those of the linear loop are left to it.
    band : float
        Half width of the settling band, a fraction of the step.
    recertify : float
        Share of the plants that are drawn at random and certified, beside the worst by each metric; 0: only those.
    tolerance : float
        Share of a metric, or of its median over the plants if that is larger, by which the lanes may differ: a search
        claims no figure that differs by more than 1 %.
    seed : int
        Of the random share.
    chunk : int, optional
        Plants that run at a time, by default 8 a core; memory grows with it, the table does not depend on it.
    executor : concurrent.futures.Executor or Processes, optional
        Where the chosen plants are certified, as for `sweep`; the lanes run on all cores of this machine.
    progress : callable, optional
        Called with a `Progress` after each chunk.
    journal : Journal, optional
        Keeps each plant's metrics, and each certificate, on the disk as they come, as for `sweep`. Ctrl-C leaves the
        plants without metrics that were not reached, and certifies none.

    Returns
    -------
    BatchEvaluation

    Raises
    ------
    InputError
        If a parameter or a metric is unknown, a metric is not read off responses, or the plant has Karnopp's friction.

    Examples
    --------
    >>> from pneuopt.control.pid import PID
    >>> from pneuopt.control.reference import Step
    >>> from pneuopt.evaluation.scenarios import samples
    >>> from pneuopt.models.linear import SecondOrder
    >>> loop = ClosedLoop(SecondOrder().system(), PID())
    >>> rig = loop.parameters.with_values({"pid.Kp": 0.5, "pid.Ki": 2.0})
    >>> plants = samples(rig, {"plant.gain": 0.1}, 20)
    >>> from concurrent.futures import ThreadPoolExecutor
    >>> found = evaluate_batch(loop, Step(1.0, horizon=4.0), rig, plants, executor=ThreadPoolExecutor(1))
    >>> len(found.table), bool(found.checks["agrees"].all())
    (20, True)
    """
    from pneuopt.quantities.frames import WideFrame

    metrics = as_tuple("metrics", metrics, str, 'names of metrics, as ["SettlingTime"]')
    steps, chosen = as_references(references), tuple(dict.fromkeys(metrics))
    check_parameters(parameters)
    check_closed_loop(loop)
    chunk = CHUNK_A_CORE * processor_count() if chunk is None else chunk
    check_smooth(loop.plant)
    require(len(cases) > 0, "a batch needs a case")
    require(0 <= recertify <= 1, f"recertify is a share of the plants between 0 and 1, got {recertify:g}; 0.01 is 1 %")
    require(chunk >= 1, f"chunk must be at least 1, got {chunk}")
    check_lanes(loop, chosen)
    cases = {str(name): values for name, values in cases.items()}
    batch = PlantBatch(add_disturbances(loop, steps), steps, parameters, cases, chosen, band)
    columns = {batch.column(n, grid): np.full(len(cases), nan) for grid in batch.grids for n in chosen}
    report = ProgressReporter(progress, "batch")
    memory = _Memory(journal, parameters, cases, columns)
    with suppress(KeyboardInterrupt):
        for begin in range(0, len(memory.missing), chunk):
            rows = memory.missing[begin : begin + chunk]
            batch.measure(rows, columns)
            memory.keep(rows, batch.errors)
            done = memory.done
            report(f"{done} of {len(cases)} plants", done, len(cases))
    for row in memory.missing[memory.kept :].tolist():
        batch.errors[row] = batch.errors[row] or INTERRUPTED_CASE
    table = WideFrame({"case": list(cases), **batch.varied_columns(), **columns, "error": batch.errors})
    picked = _pick_cases(table, list(columns), recertify, seed) if memory.done == len(cases) else []
    compute = partial(sweep, executor=executor, journal=journal)
    checks = _certify(loop, steps, parameters, {n: cases[n] for n in picked}, table, (band, tolerance), compute)
    return BatchEvaluation(table, checks)


class _Memory:
    """Record of the plants that a journal holds, and of those still to be run."""

    def __init__(
        self,
        journal: Journal | None,
        parameters: ParameterSet,
        cases: Mapping[str, Mapping[str, float]],
        columns: Mapping[str, Array],
    ) -> None:
        self._journal, self._marks, self._columns = journal, CaseMarks(parameters), columns
        self._cases, self.kept = list(cases.items()), 0
        missing = list[int]()
        for k, (name, values) in enumerate(self._cases):
            outcome = journal.find(name, self._marks.of(values)) if journal is not None else None
            if outcome is None or not columns.keys() <= outcome.results.keys():
                missing.append(k)
                continue
            for n, column in columns.items():
                column[k] = outcome.results[n]
        self.missing = np.array(missing, dtype=np.intp)
        if journal is not None:
            known = np.setdiff1d(np.arange(len(cases)), self.missing)
            journal.append_rows(self._row(k, "") for k in known.tolist())

    @property
    def done(self) -> int:
        """Number of plants that have been run, now or before."""
        return len(self._cases) - len(self.missing) + self.kept

    def keep(self, rows: Indices, errors: Sequence[str]) -> None:
        """Keep the metrics of the next missing plants."""
        self.kept += len(rows)
        for k in rows.tolist() if self._journal is not None else ():
            name, values = self._cases[k]
            results = {n: float(column[k]) for n, column in self._columns.items()}
            assert self._journal is not None
            self._journal.add(name, self._marks.of(values), Outcome(results, error=errors[k]))
        if self._journal is not None:
            self._journal.append_rows(self._row(k, errors[k]) for k in rows.tolist())

    def _row(self, k: int, error: str) -> dict[str, Any]:
        """A plant's row for those who watch."""
        name, values = self._cases[k]
        return {"case": name, **values, **{n: float(column[k]) for n, column in self._columns.items()}, "error": error}


def check_lanes(loop: ClosedLoop, metrics: Sequence[str]) -> None:
    """Refuse metrics that are not read off responses; `InputError` names the remedy."""
    left = [n for n in metrics if n in METRICS and n not in LANE_METRICS]
    require(not left, f"{', '.join(left)}: not read off the lanes' responses; sweep `evaluate` for it")
    check_names("metric", metrics, LANE_METRICS, "metrics")
    check_channels(loop.plant, metrics)


def _pick_cases(table: "pd.DataFrame", columns: Sequence[str], share: float, seed: int) -> list[str]:
    """The cases to certify: the worst by each metric, without a figure and with one, and a random share; in order."""
    good = np.flatnonzero(table["error"] == "")
    if not len(good):
        return []
    picked = set(generator(seed, "recertify").choice(good, min(ceil(share * len(good)), len(good)), replace=False))
    for column in columns:
        values = table[column].to_numpy(dtype=float)[good] * (-1 if larger_is_better(column.partition("[")[0]) else 1)
        picked |= {*good[np.isnan(values)][:1]}
        picked |= {good[np.argmax(np.where(np.isnan(values), -inf, values))]}
    return [str(table["case"].iloc[k]) for k in sorted(picked)]


def _certify(
    loop: ClosedLoop,
    steps: Sequence[Reference],
    parameters: ParameterSet,
    cases: Mapping[str, Mapping[str, float]],
    table: "pd.DataFrame",
    limits: tuple[Band, float],
    compute: "Callable[..., pd.DataFrame]",
) -> "pd.DataFrame":
    """Hold the lanes' figures of some cases to the independent simulation's."""
    import pandas as pd

    band, tolerance = limits
    columns = [c for c in table if str(c).partition("[")[0] in METRICS]
    rows = []
    if cases:
        run = partial(evaluate, loop, steps, band=band)
        computed = compute(run, parameters, {f"{CERTIFIED}{name}": values for name, values in cases.items()})
        computed["case"] = list(cases)
        exact, lanes = (t[t["case"].isin(list(cases))].set_index("case").to_dict("index") for t in (computed, table))
        typical = {str(c): abs(float(table[c].median())) for c in columns}
        for case, c in ((case, c) for case in cases for c in typical):
            batch, certified = (float(rows_by_case[case].get(c, nan)) for rows_by_case in (lanes, exact))
            neither = bool(np.isnan(batch) and np.isnan(certified))
            apart = 0.0 if neither else abs(batch - certified)
            close = neither or apart <= tolerance * max(abs(certified), typical[c])
            rows.append((case, c, batch, certified, apart, close and not exact[case]["error"]))
    return pd.DataFrame(rows, columns=["case", "metric", "batch", "certified", "difference", "agrees"])


RAN_AWAY = "the response runs away"


class PlantBatch:
    """The plants of a batch as rows of numbers, and the grids on which they run."""

    def __init__(
        self,
        loop: ClosedLoop,
        steps: Sequence[Reference],
        parameters: ParameterSet,
        cases: Mapping[str, Mapping[str, float]],
        metrics: Sequence[str],
        band: Band,
    ) -> None:
        self.loop, self.metrics, self.band = loop, tuple(metrics), band
        self._full = loop.complete(parameters).select(loop.parameters)
        self._order = {n: k for k, n in enumerate(self._full)}
        self._cases, self.errors = list(cases.values()), [""] * len(cases)
        self.varied = list(dict.fromkeys(n for values in self._cases for n in values))
        check_names("parameter", self.varied, self._order, "cases")
        self._places = [self._order[n] for n in self.varied]
        self.nominal = np.array([p.value for p in self._full.values()])
        self._values = np.array(
            [[v.get(n, self._full.value(n)) for n in self.varied] for v in self._cases], dtype=float
        )
        for k, n in enumerate(self.varied):
            known, column = self._full[n], self._values[:, k]
            bad = ~((column >= known.lower) & (column <= known.upper) & np.isfinite(column))
            for row in np.flatnonzero(bad).tolist():
                reason = f"{n} is {column[row]:g} {known.unit}, outside [{known.lower:g}, {known.upper:g}]"
                self.errors[row] = self.errors[row] or reason
        self.lanes = LoopLanes(loop, metrics, _make_rollout)
        fastest, frequency = {}, "dither.frequency"
        if frequency in self.varied:
            values = self._values[:, self.varied.index(frequency)]
            fastest[frequency] = float(np.max(values, where=np.isfinite(values), initial=self._full.value(frequency)))
        self.grids = reference_grids(loop, steps, self._full.with_values(fastest))
        self._starts = [self._shared_start(grid.reference) for grid in self.grids]
        rate = max(RATE_MARGIN * self._fastest_mode(), dither_resolution_rate(loop, self._full))
        self.substeps = [rk4_substeps(rate, grid.spacing) for grid in self.grids]

    def column(self, metric: str, grid: ReferenceGrid) -> str:
        """Heading of a metric's column."""
        return metric if len(self.grids) == 1 else f"{metric}[{grid.reference.label}]"

    def varied_columns(self) -> dict[str, Array]:
        """The parameters in which the plants differ."""
        return {n: self._values[:, k] for k, n in enumerate(self.varied)}

    def measure(self, rows: Indices, columns: Mapping[str, Array]) -> None:
        """Run some plants on every reference and fill their rows of the columns."""
        for grid, start, substeps in zip(self.grids, self._starts, self.substeps, strict=True):
            startable, x0 = self._start_states(rows, grid.reference, start)
            if not len(startable):
                continue
            p = np.tile(self.nominal, (len(startable), 1))
            p[:, self._places] = self._values[startable]
            run, sound = self.lanes.run(grid, x0, p, substeps)
            if not sound.all() and 2 * substeps <= MAX_LOOP_SUBSTEPS:  # RK4 may be what runs away
                again = ~sound
                finer, sound[again] = self.lanes.run(grid, x0[again], p[again], 2 * substeps)
                run.y[again] = finer.y
            for k in startable[~sound].tolist():
                self.errors[k] = self.errors[k] or f"{RAN_AWAY} in the lanes"
            for _, some, metrics in self.lanes.read(grid, run.y, p, sound, (self.band,), self.metrics):
                for n, value in metrics.items():
                    columns[self.column(n, grid)][startable[some]] = value

    def _start_states(self, rows: Indices, step: Reference, shared: Array | None) -> tuple[Indices, Array]:
        """The plants that can begin, and their states before the step; the others get their reason."""
        good, states = list[int](), list[Array]()
        for k in rows.tolist():
            if self.errors[k]:
                continue
            try:
                states.append(shared if shared is not None else self.start(self._cases[k], step))
                good.append(k)
            except PneuoptError as error:
                self.errors[k] = str(error)
        rows_of_states = np.reshape(states, (len(good), len(self.loop.states)))
        return np.array(good, dtype=np.intp), self.lanes.with_integral(rows_of_states)

    def start(self, values: Mapping[str, float], step: Reference) -> Array:
        """The state before a step of the plant with these values."""
        return TuningCase(step, "", values).initial(self.loop, self._full)

    def _shared_start(self, step: Reference) -> Array | None:
        """The state before the step, if it is the same on the probed plants (`_extremes`); None: each has its own."""
        # a state takes a millisecond, which is longer than a plant's response in the lanes
        try:
            states = [self.start(self._cases[k], step) for k in self._extremes()]
        except PneuoptError:
            return None
        room = SAME_START * np.array([q.nominal for q in self.loop.states])
        return states[0] if states and all(np.all(np.abs(states[0] - x) <= room) for x in states) else None

    def _extremes(self) -> list[int]:
        """Plants with the least and the greatest value of each parameter, and the first sound one."""
        good = np.flatnonzero([not e for e in self.errors])
        values = self._values[good]
        ends = [*values.argmin(axis=0).tolist(), *values.argmax(axis=0).tolist()] if len(good) else []
        return [int(good[k]) for k in sorted({0, *ends})] if len(good) else []

    def _fastest_mode(self) -> float:
        """The rate of the fastest mode of the probed plants along the nominal plant's responses [1/s]."""
        good = np.flatnonzero([not e for e in self.errors])
        spread = good[np.unique(np.linspace(0, len(good) - 1, MAX_PROBED).astype(int))] if len(good) else good
        probed = np.unique([*self._extremes(), *spread.tolist()]).astype(int)
        p = np.tile(self.nominal, (len(probed) + 1, 1))
        p[1:, self._places] = self._values[probed]
        starts = [self.lanes.with_integral(self.start({}, grid.reference)[None])[0] for grid in self.grids]
        few = MAX_LOOP_SUBSTEPS // 4
        along = [self.lanes.states_along(g, x, self.nominal, few) for g, x in zip(self.grids, starts, strict=True)]
        return float(fastest_eigenvalue(self.loop, p, [x for rows in along for x in rows]).max())


def _make_rollout(pieces: Pieces) -> Rollout:
    """A rollout with twice the usual lanes, where there are lanes: two chains of operations run at a time.

    It takes four fifths of the time for many plants; a search has too few for it.
    """
    usual = Rollout(pieces)
    twice = Rollout(pieces, lanes=2 * usual.lanes) if usual.lanes > 1 else usual
    return twice if twice.lanes else usual
