"""What each attempt of the search for a fit, and each number that decides in it, is worth: the rigs without it.

    python problems/identify/ablation.py [--drives N] [--servos N] [--numbers] [--json FILE] [--out DIR]

An attempt of `pneuopt.identification.search.ATTEMPTS` is taken out, or (--numbers) a number of the rooms'
`tolerances.py` halved and doubled, and the even rigs of `foreign_rigs.py`, those for development, are identified again.
Right counts those that are right or refused with a true reason. What changes neither rigs nor time may go.
--numbers takes hours; --out keeps a row a variant and rig in ablation.csv.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

sys.path.append(str(Path(__file__).parents[2]))  # the checkout, which holds `problems`

import pneuopt as po
from pneuopt.identification import search
from pneuopt.identification import tolerances as identification
from pneuopt.shooting import tolerances as shooting
from problems.identify.foreign_rigs import KINDS, identify_rig
from problems.shared.claims import Claim, arguments, finish, frame

if TYPE_CHECKING:
    import pandas as pd

DRIVES, SERVOS = 12, 12
WHOLE = "as it is"
FACTORS = {"halved": 0.5, "doubled": 2.0}
TOLERANCES = {"identification": identification, "shooting": shooting}


def main(
    drives: int = DRIVES, servos: int = SERVOS, *, numbers: bool = False, out: Path | None = None
) -> "pd.DataFrame":
    import pandas as pd

    variants = [WHOLE, *(f"without {attempt.name}" for attempt in search.ATTEMPTS)]
    variants += [f"{n} {how}" for n in named_numbers() for how in FACTORS] if numbers else []
    counts = dict(zip(KINDS, (drives, servos), strict=True))
    cases = {
        f"{variant}, {kind} {seed}": {"variant": float(i), "kind": float(k), "seed": float(seed)}
        for i, variant in enumerate(variants)
        for k, (kind, count) in enumerate(counts.items())
        for seed in range(0, 2 * count, 2)
    }
    start = po.ParameterSet({n: po.Parameter(-1.0, "1") for n in ("variant", "kind", "seed")})
    rows = pd.DataFrame(po.sweep(partial(identify_without, tuple(variants)), start, cases))
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        rows.to_csv(out / "ablation.csv", index=False)
    return frame([claim for i, name in enumerate(variants) for claim in _claims(name, rows[rows["variant"] == i])])


def named_numbers() -> list[str]:
    """The numbers that decide in identification and shooting, as room.NAME."""
    return [
        f"{room}.{name}"
        for room, module in TOLERANCES.items()
        for name, value in vars(module).items()
        if name.isupper() and isinstance(value, int | float) and not isinstance(value, bool)
    ]


def identify_without(variants: tuple[str, ...], given: po.ParameterSet) -> dict[str, Any]:
    """What `identify` makes of a rig in one variant of the search."""
    kind = list(KINDS)[round(given.value("kind"))]
    with changed(variants[round(given.value("variant"))]):
        return identify_rig(kind, po.ParameterSet({"seed": po.Parameter(given.value("seed"), "1")}))


@contextmanager
def changed(variant: str) -> Iterator[None]:
    """The search without an attempt, or with another number wherever a module has it."""
    before = list[tuple[ModuleType, str, Any]]()
    if variant.startswith("without "):
        kept = tuple(a for a in search.ATTEMPTS if a.name != variant.removeprefix("without "))
        before.append((search, "ATTEMPTS", search.ATTEMPTS))
        search.ATTEMPTS = kept
    elif variant != WHOLE:
        place, how = variant.split()
        room, name = place.split(".")
        old = getattr(TOLERANCES[room], name)
        new = type(old)(old * FACTORS[how])
        for module in [m for n, m in sys.modules.items() if n.startswith("pneuopt.") and vars(m).get(name) is old]:
            before.append((module, name, old))
            setattr(module, name, new)
    try:
        yield
    finally:
        for module, name, value in before:
            setattr(module, name, value)


def _claims(variant: str, rows: "pd.DataFrame") -> list[Claim]:
    bound = "<= 0" if variant == WHOLE else ""
    good = rows["outcome"].isin(["right", "refused"]).sum()
    return [
        Claim(f"{variant}: right", int(good)),
        Claim(f"{variant}: false", int((rows["outcome"] == "false").sum()), "1", None, bound),
        Claim(f"{variant}: CPU", float(rows["cpu"].sum()), "s"),
    ]


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("--drives", type=int, default=DRIVES)
    parser.add_argument("--servos", type=int, default=SERVOS)
    parser.add_argument("--numbers", action="store_true", help="halve and double each number, too")
    options = parser.parse_args()
    sys.exit(finish(main(options.drives, options.servos, numbers=options.numbers, out=options.out), options))
