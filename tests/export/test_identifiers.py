"""The table of reserved names holds the words that compilers refuse, and a name is free, plain and given once."""

import builtins
import keyword

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneuopt.export.identifiers import RESERVED, Identifiers, reserved_as
from pneuopt.export.tolerances import MAX_IDENTIFIER
from problems.shared.exported_words import PLAIN

BECKHOFF = """
    ABS ACOS ADD ADR AND ANDN ARRAY ASIN AT ATAN BITADR BOOL BY BYTE CAL CALC CALCN CASE CONSTANT COS DATE DINT DIV DO
    DT DWORD ELSE ELSIF END_CASE END_FOR END_IF END_REPEAT END_STRUCT END_TYPE END_VAR END_WHILE EQ EXIT EXP EXPT
    FALSE FOR FUNCTION FUNCTION_BLOCK GE GT IF INDEXOF INT JMP JMPC JMPCN LD LDN LE LINT LN LOG LREAL LT LTIME LWORD
    MAX METHOD MIN MOD MOVE MUL MUX NE NOT OF OR ORN PARAMS PERSISTENT POINTER PROGRAM R READ_ONLY READ_WRITE REAL
    REFERENCE REPEAT RET RETAIN RETC RETCN RETURN ROL ROR S SEL SHL SHR SIN SINT SIZEOF SUPER SQRT ST STN STRING
    STRUCT SUB TAN THEN THIS TIME TO TOD TRUE TRUNC TYPE UDINT UINT ULINT UNTIL USINT VAR VAR_CONFIG VAR_EXTERNAL
    VAR_GLOBAL VAR_IN_OUT VAR_INPUT VAR_OUTPUT VAR_STAT VAR_TEMP WHILE WORD WSTRING XOR XORN ACTION END_ACTION
    END_FUNCTION END_PROGRAM"""
"""infosys.beckhoff.com, TwinCAT 3 PLC, Keywords: written down apart from the table."""
BLOCKS = """
    integral derivative pid hysteresis ramp sr rs r_trig f_trig ctu ctd ctud ctu_dint ctd_ulint tp ton tof rtc sema"""
"""What matiec's lib/ieclib.txt compiles with every project, and OpenPLC's standard_FB.txt."""
CONVERSIONS = (
    "INT_TO_REAL LREAL_TO_LINT DT_TO_TOD BCD_TO_UINT UDINT_TO_BCD TIME_TO_STRING TO_INT TRUNC_DINT REAL_TRUNC_INT"
)
MATH = "fabs fabsf fabsl sin sinl exp exp2f j0 y1 yn lgamma hypot M_PI M_SQRT1_2 HUGE_VAL FP_NAN INFINITY isnan"
C_PLUS = "class new this template bitand xor_eq char8_t co_await nullptr private operator typename delete int signed"


@pytest.mark.parametrize("word", (BECKHOFF + BLOCKS).split() + CONVERSIONS.split() + MATH.split() + C_PLUS.split())
def test_a_word_that_a_compiler_has_is_reserved_in_any_case(word: str) -> None:
    assert reserved_as(word)
    assert reserved_as(word.swapcase())


def test_the_words_of_this_python_are_reserved() -> None:
    own = [*keyword.kwlist, *keyword.softkwlist, *(n for n in dir(builtins) if n[0].islower())]
    assert [n for n in own if n != "_" and not reserved_as(n)] == []


OWN = "Kp Ki Kd Tf K Ti Td Tt b c lower upper output measured setpoint sample v1 k1"


@pytest.mark.parametrize("word", OWN.split())
def test_the_names_of_a_controller_are_free(word: str) -> None:
    assert reserved_as(word) is None


WORDS = sorted(frozenset().union(*RESERVED.values()))
names = st.one_of(st.text(max_size=60), st.sampled_from(WORDS), st.from_regex(r"\A[a-zA-Z_]{1,50}\Z"))


@given(st.lists(st.lists(names, min_size=1, max_size=3), max_size=20), st.sets(names))
def test_names_are_plain_free_and_given_once(wishes: list[list[str]], taken: set[str]) -> None:
    made = Identifiers(taken)
    found = [made.claim(*own) for own in wishes] + [made.claim_next("v") for _ in range(3)]
    assert all(PLAIN.fullmatch(n) and len(n) <= MAX_IDENTIFIER and not reserved_as(n) for n in found)
    folded = [n.casefold() for n in found]
    assert len(set(folded)) == len(folded)
    assert not set(folded) & {n.casefold() for n in taken}
    again = Identifiers(taken)
    assert [again.claim(*own) for own in wishes] == found[: len(wishes)]


@pytest.mark.parametrize(
    ("wishes", "name"),
    [
        (("speed",), "speed"),
        (("integral", "pid.integral"), "pid_integral"),
        (("a__b_",), "a_b"),
        (("2nd",), "x_2nd"),
        (("Größe",), "Groe"),
        (("int",), "int_2"),
        (("дом", "дом_reading"), "reading"),
        (("ton",), "ton_2"),
    ],
)
def test_a_name_stays_readable(wishes: tuple[str, ...], name: str) -> None:
    assert Identifiers().claim(*wishes) == name
