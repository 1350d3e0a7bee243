"""Reading and writing numbers with units: "32 mm", "6 bar(g)", "2e-8 m^3/(s*Pa)"; SI inside.

Units are read exactly (rational arithmetic), so "20 um" is the float 2e-05 and not its neighbour. A frequency in Hz, an
angular frequency in rad/s and a rate in 1/s are three dimensions: nothing is converted by 2 pi behind one's back. The
units that are known, at the end of the file, are a short list of our own: it loads fast, and keeps surprises out, "pt"
as a pint, say.
"""

import difflib
import functools
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from fractions import Fraction
from functools import cache
from typing import Any, NamedTuple

from pneuopt.quantities.errors import UnitError, require

ATMOSPHERE = 101325.0
"""Standard atmosphere [Pa] (ISO 2533), which gauge pressures count from unless `count_gauge_from` says otherwise."""

ANR_DENSITY = 1.185
"""Density of air at ANR [kg/m^3] (ISO 8778: 100 kPa, 20 degC, 65 % humidity), which converts a mass into l(ANR)."""

MAX_UNIT_LENGTH = 80
"""Length of a unit's text [character]: a longer one takes seconds; a shorter bound refuses gains in base units."""
MAX_UNIT_POWER = 144
"""Product of the powers in a unit's text [1]: a higher one takes minutes and gigabytes; no unit of a drive has 20."""
MAX_NUMBER_LENGTH = 64
"""Length of a number [character]: Python refuses to convert the 4300 digits that are no slip of the finger."""

_SYMBOLS = {"℃": "degC", "°C": "degC", "°": "deg"}  # which pint takes for no part of a name
_gauge_zero: ContextVar[float] = ContextVar("gauge_zero", default=ATMOSPHERE)
_NUMBER_WITH_UNIT = re.compile(
    r"\s*([+-]?(?:(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?|inf(?![a-z])))\s*(.*?)\s*", re.DOTALL
)
_PRESSURE_LEVEL = re.compile(r"(.+?)\s*\(([ag])\)")
_READABLE_UNITS = {
    "m": (("um", 1e-4), ("mm", 1.0)),
    "s": (("us", 1e-4), ("ms", 1.0)),
    "m/s": (("mm/s", 0.1),),
    "Pa": (("Pa", 1e3), ("bar", math.inf)),
    "Pa(a)": (("bar(a)", math.inf),),
    "Pa(g)": (("bar(g)", math.inf),),
}


def read_value(text: str | float, unit: str, *, where: str = "") -> float:
    """Read one number with its unit in the SI unit `unit`; without one only where that is "1"; `where` begins an error.

    "Pa(a)" and "Pa(g)" are pressure levels, which need bar(a), kPa(g), ...; "Pa" is a pressure difference, which
    refuses them.

    Examples
    --------
    >>> read_value("32 mm", "m"), read_value("6 bar(g)", "Pa(a)"), read_value("30 %", "1")
    (0.032, 701325.0, 0.3)
    """
    number, unit_text = _split_number(text, where)
    if not unit_text:
        free = _parse_unit(_split_level(unit)[0]).dimension == ()
        require(free, f'{_place_prefix(where)}{text!r} has no unit; write "{number} {_example_unit(unit)}"', UnitError)
        unit_text = "1"
    factor, offset = _exact_conversion(unit_text, unit, where)
    try:
        value = float(number) if "inf" in number else float(Fraction(number) * factor + offset)
    except OverflowError:
        told = f"{_place_prefix(where)}{number} is larger than any number that is measured"
        raise UnitError(told) from None
    floor = {"a": 0.0, "g": -_gauge_zero.get()}.get(_split_level(unit)[1], -math.inf)
    message = f"{_place_prefix(where)}{text!r} lies below vacuum; check (a) and (g)"
    require(value >= floor or value == -math.inf, message, UnitError)
    # a temperature on a scale of its own, as degC, lies above 0 K; in K it may be a difference
    message = f"{_place_prefix(where)}{text!r} lies below absolute zero, -273.15 degC; check sign and unit"
    require(value >= 0 or not _parse_unit(_split_level(unit_text)[0]).offset, message, UnitError)
    return value


def read_si(text: str | float, *, where: str = "") -> float:
    """Read one number in the SI unit of its own dimension; a pressure has to be a level, and gauge becomes absolute."""
    unit_text = _split_number(text, where)[1]
    base = _split_level(unit_text or "1")[0]
    if _parse_unit(base, where).dimension == _parse_unit("Pa").dimension:
        return read_value(text, "Pa(a)", where=where)
    powers = _parse_unit(base).dimension
    return read_value(text, "*".join(f"{name}**({power})" for name, power in powers) or "1", where=where)


@contextmanager
def count_gauge_from(pressure: float) -> Iterator[None]:
    """Count gauge pressures from this absolute one [Pa], a drive's ambient pressure say, in what is read within."""
    token = _gauge_zero.set(pressure)
    try:
        yield
    finally:
        _gauge_zero.reset(token)


def si_conversion(unit_text: str, unit: str, *, where: str = "") -> tuple[float, float]:
    """Find factor and offset that bring a column of raw numbers to SI: ``si = factor * raw + offset``."""
    factor, offset = _exact_conversion(unit_text, unit, where)
    return float(factor), float(offset)


def read_unit(text: str | float, unit: str) -> str:
    """The unit in which a value is written; `unit` where it stands alone."""
    return _split_number(text, "")[1] or unit


def is_unit(text: str) -> bool:
    """Whether a text is a unit that `read_value` knows, a pressure's level among them."""
    if not re.search(r"[^\W\d_]|[%‰°]", text):
        return False
    try:
        _parse_unit(_split_level(text.strip())[0])
    except UnitError:
        return False
    return True


def write_value(value: float, unit: str, digits: int = 6) -> str:
    """Write an SI number with a unit that reads well; `read_value` reads it back to the digits given."""
    require(not math.isnan(value), f"a value of NaN {unit} cannot be written")
    readable = _READABLE_UNITS.get(unit, ()) if math.isfinite(value) else ()
    shown = next((name for name, below in readable if 0 < abs(value) < below), unit)
    factor, offset = _exact_conversion(shown, unit, "")
    number = float((Fraction(value) - offset) / factor) if math.isfinite(value) else value
    return f"{number:.{digits}g}" + ("" if unit == "1" else f" {shown}")


def unit_ratio(numerator: str, denominator: str) -> str:
    """Divide two unit texts and simplify; a level such as "Pa(a)" counts as a difference."""
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


class _UnitScale(NamedTuple):
    """How a unit converts to the SI base unit of its dimension, exactly."""

    factor: Fraction
    offset: Fraction
    dimension: tuple[tuple[str, Fraction], ...]


def _split_number(text: str | float, where: str) -> tuple[str, str]:
    shown = text if isinstance(text, str) else repr(text)
    match = _NUMBER_WITH_UNIT.fullmatch(shown)
    if match is None or isinstance(text, bool):
        said = repr(text[:60]) if isinstance(text, str) else shown[:60]
        raise UnitError(f'{_place_prefix(where)}{said} is not a number with a unit; write for instance "32 mm"')
    number, unit = match.groups()
    text_is_short = len(number) <= MAX_NUMBER_LENGTH
    require(text_is_short, f"{_place_prefix(where)}a number of {len(number)} characters; round it", UnitError)
    comma = re.fullmatch(r",(\d+)\s*([^\d.,]*)", unit)
    if comma and "." not in number:
        mended = f"{number}.{comma[1]} {comma[2]}".strip()
        raise UnitError(f'{_place_prefix(where)}{text!r} has a decimal comma; write "{mended}"')
    if re.match(r"[\d.,+_'-]", unit) and not unit.startswith("1/"):
        raise UnitError(
            f"{_place_prefix(where)}{text!r} is not one number with a unit; write digits without separators"
        )
    return number, unit


def _exact_conversion(unit_text: str, unit: str, where: str) -> tuple[Fraction, Fraction]:
    (base, level), (target, target_level) = _split_level(unit_text), _split_level(unit)
    source, goal = _parse_unit(base, where), _parse_unit(target, where)
    if source.dimension != goal.dimension:
        rates = [_parse_unit(rate).dimension for rate in ("Hz", "rad/s", "1/s")]
        remedy = f'write for instance "{_example_unit(unit)}"'
        if source.dimension in rates and goal.dimension in rates:
            remedy = f"write it in {unit} (1 Hz is 2 pi rad/s; pneuopt does not choose for you)"
        raise UnitError(f"{_place_prefix(where)}unit {unit_text!r} does not measure {unit!r}; {remedy}")
    if target_level and not level:
        raise UnitError(
            f"{_place_prefix(where)}a pressure level in {unit_text!r} may be absolute or gauge; "
            f'write "{base}(a)" or "{base}(g)" (gauge counts from {_gauge_zero.get():g} Pa)'
        )
    if level and not target_level:
        raise UnitError(
            f"{_place_prefix(where)}{unit_text!r}: (a) and (g) mark a pressure level, which is not meant here; "
            f"write {base!r}"
        )
    shift = Fraction(_gauge_zero.get()) * ((level == "g") - (target_level == "g"))
    return source.factor / goal.factor, (source.offset - goal.offset + shift) / goal.factor


def _split_level(unit_text: str) -> tuple[str, str]:
    match = _PRESSURE_LEVEL.fullmatch(unit_text)
    return (match[1], match[2]) if match else (unit_text, "")


def _parse_unit(unit_text: str, where: str = "") -> _UnitScale:
    _registry()
    try:
        return _parse_with_pint(functools.reduce(lambda text, s: text.replace(s, _SYMBOLS[s]), _SYMBOLS, unit_text))
    except Exception:  # whatever pint raises on a text, the text is not a unit
        shown = unit_text[:40]
        known = {key.casefold(): unit for unit in COMMON_UNITS.split() for key in (unit, re.sub(r"[()]", "", unit))}
        near = difflib.get_close_matches(shown.casefold(), known, n=1, cutoff=0.6)
        hint = f"did you mean {known[near[0]]!r}?" if near else "write for instance mm, m/s, N, bar(g), V, ms or %"
        raise UnitError(f"{_place_prefix(where)}unknown unit {shown!r}; {hint}") from None


@cache
def _parse_with_pint(unit_text: str) -> _UnitScale:
    require(len(unit_text) <= MAX_UNIT_LENGTH, "a text this long is no unit")
    require(not re.search(r"\d{3}|\d\s*[eE]\s*[+-]?\d", unit_text), "a power this high would take for ever")
    powers = (int(power) for power in re.findall(r"(?:\*\*|\^)[\s(]*[+-]?(\d+)", unit_text))
    require(math.prod(power for power in powers if power) <= MAX_UNIT_POWER, "a power of powers would, too")
    require("%%" not in unit_text.replace(" ", ""), "a percentage of a percentage is a slip of the finger")
    unit = _registry().parse_units(unit_text)
    zero, one = (_registry().Quantity(Fraction(k), unit).to_base_units() for k in range(2))
    # Base units, not the unit's dimensionality: an angle counts as a dimension here.
    dimension = tuple(sorted((name, Fraction(power)) for name, power in one.unit_items()))
    return _UnitScale(one.magnitude - zero.magnitude, zero.magnitude, dimension)


@cache
def _registry() -> Any:
    import pint

    registry: Any = pint.UnitRegistry(None, non_int_type=Fraction, autoconvert_offset_to_baseunit=True)
    registry.load_definitions(UNIT_DEFINITIONS.strip().splitlines())
    return registry


def _example_unit(unit: str) -> str:
    return {"Pa(a)": "bar(a)", "Pa(g)": "bar(g)", "1": "%"}.get(unit, unit)


def _place_prefix(where: str) -> str:
    return f"{where}: " if where else ""


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


UNIT_DEFINITIONS = """
nano- = 1e-9 = n-
micro- = 1e-6 = µ- = μ- = u-
milli- = 1e-3 = m-
centi- = 1e-2 = c-
deci- = 1e-1 = d-
hecto- = 1e2 = h-
kilo- = 1e3 = k-
mega- = 1e6 = M-
giga- = 1e9 = G-
meter = [length] = m = metre
kilogram = [mass] = kg
second = [time] = s = sec
ampere = [current] = A = amp
kelvin = [temperature] = K
radian = [angle] = rad
cycle = [cycle]
percent = 0.01 = %
permille = 0.001 = ‰
ppm = 1e-6
count = 1 = cnt
gram = 1e-3 kilogram = g
tonne = 1000 kilogram = t
pound = 0.45359237 kilogram = lb
minute = 60 second = min
hour = 3600 second = h
day = 86400 second = d
inch = 0.0254 meter = in
foot = 0.3048 meter = ft
degree_Celsius = kelvin; offset: 273.15 = °C = degC = celsius
degree = 0.017453292519943295769 radian = deg = °
revolution = 6.283185307179586477 radian = rev
rpm = revolution / minute
hertz = cycle / second = Hz
newton = kilogram * meter / second ** 2 = N
kilogram_force = 9.80665 newton = kgf = kp
pound_force = 4.4482216152605 newton = lbf
pascal = newton / meter ** 2 = Pa
bar = 1e5 pascal
psi = 6894.757293168361 pascal
standard_atmosphere = 101325 pascal = atm
joule = newton * meter = J
watt = joule / second = W
volt = watt / ampere = V
coulomb = ampere * second = C
ohm = volt / ampere = Ω
liter = 1e-3 meter ** 3 = l = L = litre
newton_meter = newton * meter = Nm
newton_second = newton * second = Ns
volt_second = volt * second = Vs
"""
"""pint's definitions."""

COMMON_UNITS = """
m mm um cm km in s ms us min h day kg g t N kN Nm V mV A mA K degC Hz kHz rad deg rad/s rpm m/s mm/s m/s^2 m^2 m^3 mm^2
cm^2 cm^3 l N*s/m V*s/m 1/s m^3/(s*Pa) % count kg*m^2 N*m rev N*m*s/rad newton volt meter Pa kPa MPa bar mbar psi
Pa(a) Pa(g) kPa(a) kPa(g) MPa(a) MPa(g) bar(a) bar(g) mbar(a) mbar(g) psi(a) psi(g)
"""
"""The units that a message may suggest."""
