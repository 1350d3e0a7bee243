"""`evaluate_batch`: one design on thousands of plants, many at once in SIMD lanes; the worst and some others certified.

The lanes integrate by RK4 on one grid of samples, as a search does, and the metrics are read off them by the records
that the certificate reads by. They have no events of stick-slip, no margins and no continuation beyond the horizon:
those are left to the certificate. What the lanes say is held to `evaluate`, the independent simulation, on the plants
on which a metric is worst, and on a share of all that is drawn at random.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from math import ceil, inf, nan
from typing import TYPE_CHECKING, Any

import numpy as np

from pneuopt.control.disturbance import add_disturbances
from pneuopt.control.loop import ClosedLoop, check_closed_loop
from pneuopt.control.reference import Step, as_steps
from pneuopt.dynamics.compiled.rollout import Rollout
from pneuopt.dynamics.runnable import check_smooth
from pneuopt.evaluation.cases import TuningCase
from pneuopt.evaluation.evaluate import evaluate
from pneuopt.evaluation.meter import check_channels, needed_channels
from pneuopt.evaluation.metric import Source
from pneuopt.evaluation.requirements import METRICS, larger_is_better
from pneuopt.quantities.arguments import check_parameters
from pneuopt.quantities.arrays import Array, Indices, Mask
from pneuopt.quantities.errors import PneuoptError, check_names, require
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.progress import Progress, ProgressReporter
from pneuopt.quantities.report import Line, Report, Table, Tone, format_number, number_columns, text_columns
from pneuopt.quantities.shown import Shown
from pneuopt.studies.processes import Processes
from pneuopt.studies.sweep import sweep
from pneuopt.tuning.grids import reference_grids
from pneuopt.tuning.readings import ReferenceGrid, has_integral, loop_pieces, read_metrics
from pneuopt.tuning.responses import is_sound
from pneuopt.tuning.space import MAX_LOOP_SUBSTEPS, dither_resolution_rate, fastest_eigenvalue, rk4_substeps

if TYPE_CHECKING:
    import pandas as pd

BATCH_METRICS = ("SettlingTime", "Overshoot", "SteadyStateError", "PeakControl")
CHUNK = 64
"""Plants that are run and read at a time: fewer leave cores idle; the responses of more do not fit a cache."""
USUAL_TOLERANCE = 0.01
"""Share of a metric, or of its median over the plants, by which lanes and certificate may differ: a search claims no
figure that differs by more."""
MAX_PROBED = 64
"""Plants, beside those with an extreme value, whose fastest mode is sought: fewer may miss a stiff one, on which RK4
is then unstable; each more costs an eigenvalue problem a plant and state."""
RATE_MARGIN = 1.2
"""Factor on the fastest mode found [1]: the plants that are not probed may be faster by that much."""
SAME_START = 1e-9
"""Share of the states' nominal sizes [1] by which starts differ by rounding: at 0 each plant's is computed anew."""
RAN_AWAY = "the response runs away"


@dataclass(frozen=True, eq=False, repr=False)
class BatchEvaluation(Shown):
    """What `evaluate_batch` found; prints its `summary()`.

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
        """How many plants there are, the spread of each metric, and the largest differences from the certificate."""
        failed, differ = int((self.table["error"] != "").sum()), self.checks[~self.checks["agrees"]]
        cases, certified = len(self.table), self.checks["case"].nunique()
        said = f"{differ['case'].nunique()} differ" if len(differ) else "all agree"
        verdict = f"{cases} plants in lanes, {certified} of them certified: {said}"
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
    references: Step | Sequence[Step],
    parameters: ParameterSet,
    cases: Mapping[str, Mapping[str, float]],
    *,
    metrics: Sequence[str] = BATCH_METRICS,
    band: float = 0.02,
    recertify: float = 0.01,
    tolerance: float = USUAL_TOLERANCE,
    seed: int = 0,
    chunk: int = CHUNK,
    executor: Executor | Processes | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> BatchEvaluation:
    """Evaluate a fixed design on many plants at once, and certify the worst of them and a random share.

    Parameters
    ----------
    loop : ClosedLoop
    references : Step or sequence of Step
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
        Share of a metric, or of its median over the plants if that is larger, by which the lanes may differ.
    seed : int
        Of the random share.
    chunk : int
        Plants that run at a time; memory grows with it, the table does not depend on it.
    executor : concurrent.futures.Executor or Processes, optional
        Where the chosen plants are certified, as for `sweep`; the lanes run on all cores of this machine.
    progress : callable, optional
        Called with a `Progress` after each chunk.

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

    steps, chosen = as_steps(references), tuple(dict.fromkeys(metrics))
    check_parameters(parameters)
    check_closed_loop(loop)
    _check_batch(loop, chosen, cases, recertify, chunk)
    cases = {str(name): values for name, values in cases.items()}
    fleet = _Fleet(add_disturbances(loop, steps), steps, parameters, cases, chosen, band)
    columns, report = fleet.empty_columns(), ProgressReporter(progress, "batch")
    for begin in range(0, len(cases), chunk):
        rows = np.arange(begin, min(begin + chunk, len(cases)))
        fleet.measure(rows, columns)
        report(f"{rows[-1] + 1} of {len(cases)} plants", int(rows[-1]) + 1, len(cases))
    table = WideFrame({"case": list(cases), **fleet.varied_columns(), **columns, "error": fleet.errors})
    picked = _pick_cases(table, list(columns), recertify, seed)
    checks = _certify(loop, steps, parameters, {n: cases[n] for n in picked}, table, (band, tolerance), executor)
    return BatchEvaluation(table, checks)


def _check_batch(
    loop: ClosedLoop, metrics: Sequence[str], cases: Mapping[str, Mapping[str, float]], recertify: float, chunk: int
) -> None:
    """Refuse what lanes cannot do; the message names the remedy."""
    check_smooth(loop.plant)
    require(len(cases) > 0, "a batch needs a case")
    require(0 <= recertify <= 1, f"recertify is a share of the plants between 0 and 1, got {recertify:g}; 0.01 is 1 %")
    require(chunk >= 1, f"chunk must be at least 1, got {chunk}")
    known = [n for n, m in METRICS.items() if m.source is not Source.LINEAR_LOOP and n != "StepEnvelope"]
    left = [n for n in metrics if n in METRICS and n not in known]
    require(not left, f"{', '.join(left)}: not read off the lanes' responses; sweep `evaluate` for it")
    check_names("metric", metrics, known, "metrics")
    check_channels(loop.plant, metrics)


class _Fleet:
    """The plants of a batch as rows of numbers, and the grids on which they run."""

    def __init__(
        self,
        loop: ClosedLoop,
        steps: Sequence[Step],
        parameters: ParameterSet,
        cases: Mapping[str, Mapping[str, float]],
        metrics: Sequence[str],
        band: float,
    ) -> None:
        self.loop, self.metrics, self.band = loop, tuple(metrics), band
        self._full = loop.complete(parameters).select(loop.parameters)
        self._order = {n: k for k, n in enumerate(self._full)}
        self._cases, self.errors = list(cases.values()), [""] * len(cases)
        self.varied = list(dict.fromkeys(n for values in self._cases for n in values))
        check_names("parameter", self.varied, self._order, "cases")
        self._places = [self._order[n] for n in self.varied]
        self._nominal = np.array([p.value for p in self._full.values()])
        self._values = np.array(
            [[v.get(n, self._full.value(n)) for n in self.varied] for v in self._cases], dtype=float
        )
        self._check_values()
        self._channels = needed_channels(metrics)
        self._held: tuple[Any, ...] = ()
        self._rollout = Rollout(loop_pieces(loop, self._channels))
        fastest = {"dither.frequency": self._most("dither.frequency")} if "dither.frequency" in self.varied else {}
        self._grids = reference_grids(loop, steps, self._full.with_values(fastest))
        self._starts = [self._shared_start(grid.reference) for grid in self._grids]
        rate = max(RATE_MARGIN * self._fastest_mode(), dither_resolution_rate(loop, self._full))
        self._substeps = [rk4_substeps(rate, grid.spacing) for grid in self._grids]

    def column(self, metric: str, grid: ReferenceGrid) -> str:
        """Heading of a metric's column."""
        return metric if len(self._grids) == 1 else f"{metric}[{grid.reference.label}]"

    def empty_columns(self) -> dict[str, Array]:
        """The metrics' columns, NaN."""
        return {self.column(n, g): np.full(len(self._cases), nan) for g in self._grids for n in self.metrics}

    def varied_columns(self) -> dict[str, Array]:
        """The parameters in which the plants differ."""
        return {n: self._values[:, k] for k, n in enumerate(self.varied)}

    def measure(self, rows: Indices, columns: Mapping[str, Array]) -> None:
        """Run some plants on every reference and fill their rows of the columns."""
        for grid, start, substeps in zip(self._grids, self._starts, self._substeps, strict=True):
            own, x0 = self._start_states(rows, grid.reference, start)
            if not len(own):
                continue
            p, y, sound = self._run(own, x0, grid, substeps)
            if not sound.all() and 2 * substeps <= MAX_LOOP_SUBSTEPS:  # RK4 may be what runs away
                again = ~sound
                _, y[again], sound[again] = self._run(own[again], x0[again], grid, 2 * substeps)
            for k in own[~sound].tolist():
                self.errors[k] = self.errors[k] or f"{RAN_AWAY} in the lanes"
            for period, some in self._by_dither_period(p, sound):
                seen = np.moveaxis(np.ascontiguousarray(np.moveaxis(y[some], 2, 0)), 0, 2)
                read = read_metrics(grid, seen, (self.band,), period, self.metrics, (), self._channels)
                for n, value in read.items():
                    columns[self.column(n, grid)][own[some]] = value

    def _run(self, own: Indices, x0: Array, grid: ReferenceGrid, substeps: int) -> tuple[Array, Array, Mask]:
        """Parameters and outputs of plants, and which of them do not run away."""
        p = np.tile(self._nominal, (len(own), 1))
        p[:, self._places] = self._values[own]
        if self._held[:2] != (
            grid,
            len(own),
        ):  # most chunks are alike; a copy for each would take a quarter of its time
            shown = (np.tile(a, (len(own), *[1] * a.ndim)) for a in grid.pad(len(grid.t)))
            self._held = (grid, len(own), *shown)
        u, t, h = self._held[2:]
        with np.errstate(all="ignore"):
            found = self._rollout.run(x0, u, p, t, h, substeps=substeps)
        return p, found.y, is_sound(found.y, found.x_end)

    def _by_dither_period(self, p: Array, sound: Mask) -> Iterator[tuple[float | None, Indices]]:
        """The time over which a plant's signal is averaged [s], None without dither, and the rows that it is for."""
        rates, dither = np.zeros(len(p)), self.loop.dither
        if dither is not None:
            amplitude, frequency = (p[:, self._order[f"dither.{n}"]] for n in ("amplitude", "frequency"))
            rates = np.where(amplitude == 0, 0.0, frequency)
        for rate in np.unique(rates[sound]).tolist():
            period = dither.period(rate, self.loop.pid.sample_time) if dither is not None and rate else None
            yield period, np.flatnonzero(sound & (rates == rate))

    def _start_states(self, rows: Indices, step: Step, shared: Array | None) -> tuple[Indices, Array]:
        """The plants that can begin, and their states before the step; the others get their reason."""
        good, states = list[int](), list[Array]()
        for k in rows.tolist():
            if self.errors[k]:
                continue
            try:
                states.append(shared if shared is not None else self._start(self._cases[k], step))
                good.append(k)
            except PneuoptError as error:
                self.errors[k] = str(error)
        found = np.reshape(states, (len(good), len(self.loop.states)))
        return np.array(good, dtype=np.intp), np.pad(found, ((0, 0), (0, int(has_integral(self.loop)))))

    def _start(self, values: Mapping[str, float], step: Step) -> Array:
        return TuningCase(step, "", values).initial(self.loop, self._full)

    def _shared_start(self, step: Step) -> Array | None:
        """The state before the step, if it is the same on every plant, as far as probes tell; None: each has its own.

        It takes a millisecond, which is longer than a plant's response in the lanes. The probes are the plants with the
        least and the greatest value of each parameter, and the first.
        """
        try:
            states = [self._start(self._cases[k], step) for k in self._extremes()]
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
        p = np.tile(self._nominal, (len(probed) + 1, 1))
        p[1:, self._places] = self._values[probed]
        return float(fastest_eigenvalue(self.loop, p, [x for grid in self._grids for x in self._along(grid)]).max())

    def _along(self, grid: ReferenceGrid) -> list[Array]:
        """States along the nominal plant's response, its start first."""
        start = self._start({}, grid.reference)
        x0 = np.pad(start, (0, int(has_integral(self.loop))))[None]
        u, t, h = (a[None] for a in grid.pad(len(grid.t)))
        every = max(1, len(grid.t) // 10)
        found = self._rollout.run(x0, u, self._nominal, t, h, substeps=MAX_LOOP_SUBSTEPS // 4, states=every).x
        assert found is not None
        rows = np.vstack([start, found[0][:, : len(start)]])
        return list(rows[np.isfinite(rows).all(axis=1)])

    def _check_values(self) -> None:
        """Give each plant with a value that is no number, or out of bounds, its reason."""
        for k, n in enumerate(self.varied):
            p, column = self._full[n], self._values[:, k]
            bad = ~((column >= p.lower) & (column <= p.upper) & np.isfinite(column))
            for row in np.flatnonzero(bad).tolist():
                said = f"{n} is {column[row]:g} {p.unit}, outside [{p.lower:g}, {p.upper:g}]"
                self.errors[row] = self.errors[row] or said

    def _most(self, name: str) -> float:
        values = self._values[:, self.varied.index(name)]
        return float(np.max(values, where=np.isfinite(values), initial=self._full.value(name)))


def _pick_cases(table: "pd.DataFrame", columns: Sequence[str], share: float, seed: int) -> list[str]:
    """The cases to certify: the worst by each metric, without a figure and with one, and a random share; in order."""
    good = np.flatnonzero(table["error"] == "")
    if not len(good):
        return []
    picked = set(np.random.default_rng(seed).choice(good, min(ceil(share * len(good)), len(good)), replace=False))
    for column in columns:
        values = table[column].to_numpy(dtype=float)[good] * (-1 if larger_is_better(column.partition("[")[0]) else 1)
        picked |= {*good[np.isnan(values)][:1]}
        picked |= {good[np.argmax(np.where(np.isnan(values), -inf, values))]}
    return [str(table["case"].iloc[k]) for k in sorted(picked)]


def _certify(
    loop: ClosedLoop,
    steps: Sequence[Step],
    parameters: ParameterSet,
    cases: Mapping[str, Mapping[str, float]],
    table: "pd.DataFrame",
    limits: tuple[float, float],
    executor: Executor | Processes | None,
) -> "pd.DataFrame":
    """Hold the lanes' figures of some cases to the independent simulation's."""
    import pandas as pd

    band, tolerance = limits
    columns = [c for c in table if str(c).partition("[")[0] in METRICS]
    rows = []
    if cases:
        run = partial(evaluate, loop, steps, band=band)
        found = sweep(run, parameters, cases, executor=executor)
        own, lanes = (t[t["case"].isin(list(cases))].set_index("case").to_dict("index") for t in (found, table))
        typical = {str(c): abs(float(table[c].median())) for c in columns}
        for case, c in ((case, c) for case in cases for c in typical):
            batch, certified = (float(rows_by_case[case].get(c, nan)) for rows_by_case in (lanes, own))
            neither = bool(np.isnan(batch) and np.isnan(certified))
            apart = 0.0 if neither else abs(batch - certified)
            close = neither or apart <= tolerance * max(abs(certified), typical[c])
            rows.append((case, c, batch, certified, apart, close and not own[case]["error"]))
    return pd.DataFrame(rows, columns=["case", "metric", "batch", "certified", "difference", "agrees"])
