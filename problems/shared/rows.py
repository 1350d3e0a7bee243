"""Rows of a study, one a seed, in processes: kept as they come, and resumed; the options of such a study."""

from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any

from problems.shared.claims import arguments

if TYPE_CHECKING:
    import pandas as pd

Row = dict[str, Any]


def row_arguments(description: str | None, count: int) -> ArgumentParser:
    """A parser with the options of a script that makes a row a seed; a script adds its own."""
    parser = arguments(description)
    parser.add_argument(
        "--count", type=int, default=count, metavar="N", help="problems; of each set, if there are some"
    )
    parser.add_argument("--jobs", type=int, default=1, metavar="J", help="processes")
    parser.add_argument("--resume", action="store_true", help="go on with the rows that --out holds")
    return parser


def study_rows(make: Callable[[int], Row], seeds: Sequence[int], options: Namespace, name: str) -> "pd.DataFrame":
    """The rows of `rows_by_seed`, kept in --out as NAME.csv, as the options of `row_arguments` say."""
    kept = None if options.out is None else options.out / f"{name}.csv"
    if kept is not None:
        kept.parent.mkdir(parents=True, exist_ok=True)
        if not options.resume:
            kept.unlink(missing_ok=True)
    return rows_by_seed(make, seeds, options.jobs, kept)


def rows_by_seed(make: Callable[[int], Row], seeds: Sequence[int], jobs: int, kept: Path | None) -> "pd.DataFrame":
    """A row a seed, in their order; those that the file `kept` already has are not made again.

    Parameters
    ----------
    make : callable
        Of the seed; its row has "seed", "kind", "outcome" and "status". A function of a module, for other processes.
    seeds : sequence of int
    jobs : int
        Processes.
    kept : Path, optional
        A CSV file that is written anew after each row.
    """
    import pandas as pd

    read = pd.read_csv(kept).to_dict("records") if kept is not None and kept.exists() else []
    rows = [{str(k): v for k, v in row.items()} for row in read]
    done = {int(r["seed"]) for r in rows}
    for row in _rows(make, [s for s in seeds if s not in done], jobs):
        rows.append(row)
        print(f"{row['seed']} {row['kind']}: {row['outcome']}, {row['status']}", flush=True)
        if kept is not None:
            pd.DataFrame(rows).to_csv(kept, index=False)
    table = pd.DataFrame(rows)
    return table[table["seed"].isin(list(seeds))].sort_values("seed")


def _rows(make: Callable[[int], Row], seeds: list[int], jobs: int) -> Iterator[Row]:
    if jobs == 1:
        yield from map(make, seeds)
        return
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        yield from (future.result() for future in as_completed([pool.submit(make, seed) for seed in seeds]))
