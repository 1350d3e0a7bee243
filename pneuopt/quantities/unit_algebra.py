"""Products and quotients of unit texts: what a gain from volts to metres a second is measured in."""

import re

from pneuopt.quantities.errors import UnitError


def unit_ratio(numerator: str, denominator: str) -> str:
    """Divide two unit texts and simplify; a level such as "Pa(a)" counts as a difference.

    Examples
    --------
    >>> unit_ratio("V", "m/s"), unit_ratio("V", "m/s*s"), unit_ratio("1", "Pa(g)")
    ('V*s/m', 'V/m', '1/Pa')
    """
    powers = _unit_powers(difference_unit(numerator))
    for name, power in _unit_powers(difference_unit(denominator)).items():
        powers[name] = powers.get(name, 0) - power
    above = [_unit_factor(n, k) for n, k in powers.items() if k > 0]
    below = [_unit_factor(n, -k) for n, k in powers.items() if k < 0]
    divisor = "*".join(below) if len(below) < 2 else f"({'*'.join(below)})"
    return ("*".join(above) or "1") + (f"/{divisor}" if below else "")


def difference_unit(unit: str) -> str:
    """The unit of a difference: a pressure level loses its mark, "Pa(g)" becomes "Pa"."""
    return re.sub(r"\([ag]\)", "", unit)


def _unit_factor(name: str, power: int) -> str:
    return name if power == 1 else f"{name}^{power}"


def _unit_powers(unit: str) -> dict[str, int]:
    powers: dict[str, int] = {}
    rest = "*" + unit.replace(" ", "")
    while rest:
        match = re.match(r"([*/])(?:\(([^()]*)\)|([^\W\d_]+|%|1)(?:\^(-?\d+))?)", rest)
        if match is None:
            raise UnitError(f"cannot read the unit {unit!r}; write it like 'V*s/m' or 'm^3/(s*Pa)'")
        sign = 1 if match[1] == "*" else -1
        factors = _unit_powers(match[2]) if match[2] else {match[3]: int(match[4] or 1)}
        for name, power in factors.items():
            if name != "1":
                powers[name] = powers.get(name, 0) + sign * power
        rest = rest[match.end() :]
    return powers
