"""Whether a 95 % confidence interval holds the truth 95 times in 100: b32.py's log under many draws of its noise.

    python problems/identify/interval_coverage.py [--count N] [--first SEED] [--case NAME]
                                         [--json FILE] [--out DIR]

The exact log is generated once, its noise drawn anew; each draw is identified without a guess, six parameters free.
`right`: the log states its noise levels. `wrong`: it states three times the position's, a fifth of pressure a's and
three times pressure b's; identify scales its covariance by the residuals' level, one factor for all channels, which
nothing makes right for such a mixture: of its coverage nothing is claimed, but that the misfit shows it (wrong.misfit).
`estimated`: the same with `estimate_noise=True`. `slow_15`, `slow_20`: a residual of .15 and .2 times the noise,
correlated over a second, on every channel; `ar_5` to `ar_200`: one as large as the noise, correlated over so many
samples; `bad_of_4`, `bad_of_8`: the log in so many parts, one with a residual of .7 times the noise over .1 s. There
90 % are to be covered, less two binomial deviations. `stick_*`: logs of a rig of the same numbers that truly sticks
(mismatched_rig.py), which the smooth model turns round over 1, 0.3 or 0.1 mm/s: no estimate without a mark may lie
beyond 4 of its deviations and 2 % (`.silent`).
Of 400 draws, each interval is to cover 92 to 98 % (2.75 binomial deviations), and the six together 93 to 97 %
(`.mean`); of fewer draws as many deviations around 95 %. `scaled_error` is the standard deviation of an estimate's
error over its own standard error, the median of the six. --out keeps a row a draw in coverage_CASE.csv. The whole study
is --count 400.
"""

import functools
import itertools
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import numpy as np
from scipy.signal import lfilter

import pneuopt as po
from pneuopt.plotting import BLUE, GREY, axes_grid, legend_above
from problems.shared.b32 import FREE, LOGGED, NOISE, SAMPLE, SETTLING, VALVE, completed, reference
from problems.shared.b32 import exact as exact_log
from problems.shared.claims import Claim, arguments, finish, frame
from problems.shared.mismatched_rig import Hardware, record

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

COUNT, FIRST, WHOLE = 24, 1, 400
# a slow residual over the noise [1], and its correlation time [samples]
SLOW = {"slow_15": (0.15, 1000.0), "slow_20": (0.2, 1000.0), **{f"ar_{n}": (1.0, float(n)) for n in (5, 20, 60, 200)}}
PARTS, BAD_SHARE, BAD_SAMPLES = {"bad_of_4": 4, "bad_of_8": 8}, 0.7, 100.0  # of the bad part
STICK = {"stick_1mm": 1e-3, "stick_0.3mm": 3e-4, "stick_0.1mm": 1e-4}  # smoothing of the model [m/s]
CASES = ("right", "wrong", "estimated", *SLOW, *PARTS, *STICK)
MISFIT_COVERAGE = 90.0  # [%] least coverage with such residuals
STATED = {"position": 3.0, "pressure_a": 0.2, "pressure_b": 3.0}  # over the truth, where they are wrong
WANTED = (*FREE, *VALVE)
NOMINAL, MARGIN, MEAN_MARGIN = 95.0, 3.0, 2.0  # [%], the margins at the whole number of draws
DEVIATIONS, PERCENT, UNMARKED = 4.0, 2.0, (po.Mark.EXACT, po.Mark.WIDENED)
MISFITS = {"right": "1 +- 0.05", "wrong": ">= 2", "estimated": "1 +- 0.05"}  # chi square over its expectation
SCALED = 0.1  # of the scaled error, likewise


def run(
    count: int = COUNT, first: int = FIRST, cases: tuple[str, ...] = CASES, out: Path | None = None
) -> dict[str, "pd.DataFrame"]:
    """A table a case: a row a draw; kept in `out` as soon as a case is done."""
    draws = {}
    for case in cases:
        draws[case] = study(case, range(first, first + count))
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
            draws[case].to_csv(out / f"coverage_{case}.csv", index=False)
    return draws


def study(case: str, seeds: range) -> "pd.DataFrame":
    """A row a draw: for each parameter its error in standard errors, and whether the interval holds the truth."""
    truth = po.catalog.b32()[1] | po.ParameterSet({"seed": po.Parameter(-1.0, "1")})
    draws = {f"{case} {seed}": {"seed": float(seed)} for seed in seeds}
    fn = functools.partial(identified, case)
    rows = po.sweep(fn, truth, draws, progress=lambda line: print(f"{case}: {line}", end="\r", file=sys.stderr))
    return completed(rows)


def identified(case: str, truth: po.ParameterSet) -> dict[str, Any]:
    """One draw's row."""
    drive = po.catalog.b32()[0]
    blind = truth.select(drive.parameters).with_values({n: drive.parameters.value(n) for n in WANTED}).freed(*WANTED)
    if case in STICK:
        blind = blind.with_values({"friction.smoothing": STICK[case]})
    logs = drawn(case, round(truth.value("seed")))
    fit = po.identify(drive.system(), logs, blind, estimate_noise=case == "estimated", throw=False)
    row: dict[str, Any] = {"converged": float(fit.status.converged), "misfit": fit.stats["chi_square_ratio"]}
    for name, found in fit.estimates.iterrows():
        true = truth.value(str(name))
        row[f"covered {name}"] = float(found["ci_low"] <= true <= found["ci_high"])
        row[f"scaled {name}"] = (found["value"] - true) / found["stderr"]
        row[f"off {name}"] = 100 * abs(found["value"] / true - 1)
    marks = {f"mark {name}": str(mark) for name, mark in fit.estimates["mark"].items()}
    return row | marks | {"inflation": fit.stats["variance_inflation"], "status": str(fit.status)}


def drawn(case: str, seed: int) -> list[po.Experiment]:
    """The log, or its parts, with a draw of its noise, and the noise levels that it states."""
    rng = np.random.default_rng((seed, 2))
    noise = {n: NOISE[n] for n in LOGGED if n in NOISE}
    exact = _sticking() if case in STICK else _exact()
    noisy = {n: exact[n] + sigma * rng.standard_normal(len(exact)) for n, sigma in noise.items()}
    if case in SLOW:
        share, time = SLOW[case]
        noisy = {n: y + share * noise[n] * _slow(len(exact), time, rng) for n, y in noisy.items()}
    stated = {n: sigma * STATED[n] for n, sigma in noise.items()} if case in ("wrong", "estimated") else noise
    log = exact.with_columns(noisy)
    if case not in PARTS:
        return [po.Experiment(log, stated, name=f"b32 {seed}")]
    edges = np.linspace(0, len(log), PARTS[case] + 1).astype(int)
    parts = [log.rows(a, b) for a, b in itertools.pairwise(edges.tolist())]
    bad = {n: parts[1][n] + BAD_SHARE * noise[n] * _slow(len(parts[1]), BAD_SAMPLES, rng) for n in noise}
    parts[1] = parts[1].with_columns(bad)
    return [po.Experiment(part, stated, name=f"b32 {seed} part {i}") for i, part in enumerate(parts, 1)]


def _slow(n: int, time: float, rng: np.random.Generator) -> np.ndarray:
    """An AR(1) process of unit variance with a correlation time in samples."""
    a = math.exp(-1 / time)
    return np.asarray(lfilter([math.sqrt(1 - a**2)], [1, -a], rng.standard_normal(n + round(5 * time))))[-n:]


def main(draws: dict[str, "pd.DataFrame"]) -> "pd.DataFrame":
    return frame([claim for case, rows in draws.items() for claim in _claims(case, rows)])


def _claims(case: str, rows: "pd.DataFrame") -> list[Claim]:
    done = rows[rows["converged"] == 1]
    widened = math.sqrt(WHOLE / max(1, len(done)))
    if case in STICK:
        return _stick_claims(case, rows)
    held = case != "wrong"
    covering = f"{NOMINAL:g} +- {MARGIN * widened:.3g}" if held else ""
    if is_misfit := case not in MISFITS:
        covering = f">= {MISFIT_COVERAGE - 2 * math.sqrt(MISFIT_COVERAGE * 10 / max(1, len(done))):.3g}"
    exact, mean = case in MISFITS and held, float(np.mean([coverage(done, n) for n in WANTED]))
    scaled = float(np.median([done[f"scaled {n}"].std() for n in WANTED]))
    return [
        Claim(f"{case}.draws", len(rows)),
        Claim(f"{case}.converged", 100 * len(done) / len(rows), "%", None, ">= 99" if held else ""),
        *[Claim(f"{case}.{n}", coverage(done, n), "%", NOMINAL, covering) for n in WANTED],
        Claim(f"{case}.mean", mean, "%", NOMINAL, f"{NOMINAL:g} +- {MEAN_MARGIN * widened:.3g}" if exact else ""),
        Claim(
            f"{case}.scaled_error", scaled, "1", 1.0, f"1 +- {SCALED * widened:.3g}" if held and not is_misfit else ""
        ),
        Claim(f"{case}.misfit", float(rows["misfit"].median()), "1", 1.0, MISFITS.get(case, "")),
        Claim(f"{case}.seconds", float(rows["seconds"].median()), "s"),
    ]


def _stick_claims(case: str, rows: "pd.DataFrame") -> list[Claim]:
    """What the smooth model makes of true stiction: what is marked, and what is silently wrong."""
    done = rows[rows["converged"] == 1]
    far = np.array([(done[f"scaled {n}"].abs() > DEVIATIONS) & (done[f"off {n}"] > PERCENT) for n in WANTED])
    unmarked = np.array([done[f"mark {n}"].isin(UNMARKED) for n in WANTED])
    worst = float(np.nanmax(np.abs(done[[f"scaled {n}" for n in WANTED]].to_numpy(dtype=float))))
    return [
        Claim(f"{case}.draws", len(rows)),
        Claim(f"{case}.converged", 100 * len(done) / len(rows), "%", None, ">= 99"),
        Claim(f"{case}.unmarked", 100 * float(unmarked.mean()), "%"),
        Claim(f"{case}.worst", worst, "sd"),
        Claim(f"{case}.silent", int((far & unmarked).sum()), "1", 0.0, "<= 0"),
        Claim(f"{case}.misfit", float(rows["misfit"].median()), "1", 1.0),
        Claim(f"{case}.seconds", float(rows["seconds"].median()), "s"),
    ]


def coverage(rows: "pd.DataFrame", name: str) -> float:
    """How many of the draws' intervals hold a parameter's truth [%]; a missing interval holds nothing."""
    return 100 * float(rows[f"covered {name}"].mean())


def figure(draws: dict[str, "pd.DataFrame"]) -> "Figure":
    """Coverage by case: a dot a parameter, and their mean; what stands in the band chance explains."""
    picture, ((ax,),) = axes_grid(1, 1, (0.5 + 0.26 * len(draws),), width=8.0)
    done = [rows[rows["converged"] == 1] for rows in draws.values()]
    found = np.array([[coverage(rows, n) for n in WANTED] for rows in done])
    margin = MARGIN * np.sqrt(WHOLE / np.array([max(1, len(rows)) for rows in done]))
    places, low, high = np.arange(len(draws)), NOMINAL - margin, np.minimum(100.0, NOMINAL + margin)
    ax.barh(places, high - low, 0.8, low, color="0.9", label="chance, of a right interval")
    spread = places[:, None] + np.linspace(-0.25, 0.25, len(WANTED))
    ax.plot(found.ravel(), spread.ravel(), "o", ms=3, color=GREY, label="one of six parameters")
    ax.plot(found.mean(axis=1), places, "D", ms=6, color=BLUE, label="their mean")
    ax.axvline(NOMINAL, color="k", lw=0.8, ls="--")
    ax.set_yticks(places, [f"{case.replace('_', ' ')}, {len(rows)} draws" for case, rows in draws.items()])
    ax.set(ylim=(len(draws) - 0.4, -0.6), xlabel="95 % intervals that hold the truth [%]")
    ax.set_xlim(right=101.5)
    ax.grid(False, axis="y")
    legend_above(picture, ax)
    return picture


@functools.cache
def _exact() -> po.Trajectory:
    return exact_log(po.catalog.b32()[1]).select(LOGGED)


@functools.cache
def _sticking() -> po.Trajectory:
    """The log of a rig of the same numbers that truly sticks."""
    t = np.arange(-SETTLING, 10_000) * SAMPLE
    return record(Hardware(), po.catalog.b32()[1], np.array([reference(x) for x in t.tolist()])).select(LOGGED)


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("--count", type=int, default=COUNT, help="draws of each case")
    parser.add_argument("--first", type=int, default=FIRST, metavar="SEED", help="seed of the first draw")
    parser.add_argument("--case", choices=CASES, action="append", help="all by default")
    options = parser.parse_args()
    draws = run(options.count, options.first, tuple(options.case or CASES), options.out)
    sys.exit(finish(main(draws), options, lambda: {"interval_coverage": figure(draws)}))
