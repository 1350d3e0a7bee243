import math
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneuopt.quantities.errors import UnitError
from pneuopt.quantities.units import (
    ATMOSPHERE,
    count_gauge_from,
    read_si,
    read_value,
    si_conversion,
    unit_ratio,
    write_value,
)


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("32 mm", "m", 0.032),
        ("20 um", "m", 2e-5),
        ("20 µm", "m", 2e-5),  # micro sign
        ("20 μm", "m", 2e-5),  # Greek mu
        ("32mm", "m", 0.032),
        ("-.5e-3 m", "m", -5e-4),
        ("2 V*s/m", "V*s/m", 2.0),
        ("2 V/(m/s)", "V*s/m", 2.0),
        ("2 V s/m", "V*s/m", 2.0),
        ("80 Ns/m", "N*s/m", 80.0),
        ("80 N·s/m", "N*s/m", 80.0),
        ("80 N/(m/s)", "N*s/m", 80.0),
        ("80 kg/s", "N*s/m", 80.0),
        ("2e-8 m^3/(s*Pa)", "m^3/(s*Pa)", 2e-8),
        ("2e-8 m³/(s·Pa)", "m^3/(s*Pa)", 2e-8),
        ("1.2 l/(s*bar)", "m^3/(s*Pa)", 1.2e-8),
        ("10 N/bar", "N/Pa", 1e-4),
        ("80 Hz", "Hz", 80.0),
        ("1.5 kHz", "Hz", 1500.0),
        ("3 rad/s", "rad/s", 3.0),
        ("30 rpm", "rad/s", math.pi),
        ("180 deg", "rad", math.pi),
        ("2 1/s", "1/s", 2.0),
        ("30 %", "1", 0.3),
        ("0.3", "1", 0.3),
        (0.3, "1", 0.3),
        (2, "1", 2.0),
        ("20 degC", "K", 293.15),
        ("20 °C", "K", 293.15),
        ("20 ℃", "K", 293.15),
        ("-5 K", "K", -5.0),  # a difference
        ("90 °", "rad", math.pi / 2),
        ("10 lbf", "N", 44.482216152605),
        ("10 lbf*s/in", "N*s/m", 44.482216152605 / 0.0254),
        ("3 in", "m", 0.0762),
        ("3 inch", "m", 0.0762),
        ("2 ft/s", "m/s", 0.6096),
        ("2 lb", "kg", 0.90718474),
        ("6 bar", "Pa", 6e5),
        ("6 bar(g)", "Pa(a)", 6e5 + ATMOSPHERE),
        ("6 bar(a)", "Pa(a)", 6e5),
        ("6 bar(a)", "Pa(g)", 6e5 - ATMOSPHERE),
        ("0.6 MPa(g)", "Pa(g)", 6e5),
        ("100 kPa(a)", "Pa(a)", 1e5),
        ("14.5 psi (a)", "Pa(a)", 14.5 * 6894.757293168361),
        ("inf N", "N", math.inf),
    ],
)
def test_reads(text: str | float, unit: str, value: float) -> None:
    assert read_value(text, unit) == pytest.approx(value, rel=1e-15)


def test_reads_a_decimal_number_exactly() -> None:
    assert [read_value(f"{k} um", "m") for k in range(1, 1000)] == [float(f"{k}e-6") for k in range(1, 1000)]


def test_own_dimension() -> None:
    texts = ("5000 g", "6.3 bar(g)", "1 bar(a)", "30 %", "80 Hz", "10 N/bar", "25 degC")
    assert [read_si(t) for t in texts] == [5.0, 6.3e5 + ATMOSPHERE, 1e5, 0.3, 80.0, 1e-4, 298.15]


def test_scale_of_a_column() -> None:
    assert si_conversion("mm", "m") == (1e-3, 0.0)
    assert si_conversion("kPa(g)", "Pa(a)") == (1e3, ATMOSPHERE)
    assert si_conversion("degC", "K") == (1.0, 273.15)


UNITS = ["m", "s", "kg", "N", "N*s/m", "V*s/m", "m^3/(s*Pa)", "N/Pa", "1", "1/s", "Hz", "rad/s", "m/s", "Pa", "V"]


@given(st.floats(-1e12, 1e12), st.sampled_from(UNITS), st.integers(3, 17))
def test_what_is_written_reads_back(value: float, unit: str, digits: int) -> None:
    tiny = 1e-300  # below, floats lose digits of their own
    text = write_value(value, unit, digits)
    rounded = max(10.0 ** (1 - digits), 1e-15)  # the unit's prefix costs a float's rounding or two
    assert read_value(text, unit) == pytest.approx(value, rel=rounded, abs=tiny)


@given(st.floats(0.0, 1e9), st.sampled_from(["Pa(a)", "Pa(g)"]))
def test_a_pressure_level_reads_back(value: float, unit: str) -> None:
    assert read_value(write_value(value, unit, 17), unit) == pytest.approx(value, rel=1e-15, abs=1e-300)


def test_writes_what_reads_well() -> None:
    pairs = ((0.032, "m"), (2e-5, "m"), (1.5, "m"), (0.0, "m"), (1e-3, "s"), (7e5, "Pa(a)"), (-2e4, "Pa(g)"))
    assert [write_value(*p) for p in pairs] == ["32 mm", "20 um", "1.5 m", "0 m", "1 ms", "7 bar(a)", "-0.2 bar(g)"]
    assert write_value(math.inf, "N") == "inf N"
    with pytest.raises(ValueError, match="NaN"):
        write_value(math.nan, "N")


def test_pint_stays_out_of_import_time() -> None:
    code = "import sys, pneuopt.quantities.units, pneuopt.logs.experiment\n"
    code += "assert not {'pint', 'pandas', 'casadi'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("text", ["2 %%", "2 % %"])
def test_a_doubled_percent_sign_is_refused(text: str) -> None:
    with pytest.raises(UnitError):
        read_value(text, "1")


@pytest.mark.parametrize(
    ("above", "below", "expected"),
    [
        ("V", "m/s", "V*s/m"),
        ("V*s", "m/s", "V*s^2/m"),
        ("N", "m", "N/m"),
        ("V", "Pa(g)", "V/Pa"),
        ("1", "m^2/s^2", "s^2/m^2"),
        ("kg/(m*s)", "Pa", "kg/(m*s*Pa)"),
        ("m", "m", "1"),
    ],
)
def test_units_of_gains_are_simplified(above: str, below: str, expected: str) -> None:
    assert unit_ratio(above, below) == expected


def test_gauge_pressures_count_from_where_they_are_told_to() -> None:
    with count_gauge_from(95e3):
        assert read_value("6 bar(g)", "Pa(a)") == 695e3
        assert read_value("6.95 bar(a)", "Pa(g)") == 600e3
        assert read_si("6 bar(g)") == 695e3
        assert si_conversion("bar(g)", "Pa(a)") == (1e5, 95e3)
        with pytest.raises(UnitError):
            read_value("-0.96 bar(g)", "Pa(a)")
        with pytest.raises(UnitError, match="95000 Pa"):
            read_value("6 bar", "Pa(a)")
    assert read_value("6 bar(g)", "Pa(a)") == 6e5 + ATMOSPHERE


@pytest.mark.parametrize(
    "unit", ["mm**9e9", "mm^(9e9)", "mm^999999999", "((mm**99)**99)**99", "m" * 100_000, "1e9**9e9*m", "(" * 5000 + "m"]
)
def test_a_unit_that_would_take_for_ever_is_refused(unit: str) -> None:
    with pytest.raises(UnitError) as error:
        si_conversion(unit, "m")
    assert len(str(error.value)) < 200
