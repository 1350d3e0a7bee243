"""`Identifiers`: the names of an exported program, each free in every language and given once; and what is reserved.

One list serves all languages, so that a number is called alike in C, structured text and Python, and a manual of one
holds for the others. Case does not tell two names apart: structured text knows none. What is reserved or taken falls
back on a longer name of the same meaning, "integral" on "pid_integral", and on a number at its end only after that.
"""

import itertools
import re
import unicodedata
from collections.abc import Iterable, Mapping

from pneuopt.export.tolerances import MAX_IDENTIFIER


def _words(text: str) -> frozenset[str]:
    return frozenset(word.casefold() for word in text.split())


_IEC_TYPES = """
    BOOL SINT INT DINT LINT USINT UINT UDINT ULINT REAL LREAL BYTE WORD DWORD LWORD CHAR WCHAR STRING WSTRING TIME LTIME
    DATE LDATE TOD LTOD TIME_OF_DAY LTIME_OF_DAY DT LDT DATE_AND_TIME LDATE_AND_TIME ANY ANY_DERIVED ANY_ELEMENTARY
    ANY_MAGNITUDE ANY_NUM ANY_REAL ANY_INT ANY_UNSIGNED ANY_SIGNED ANY_BIT ANY_CHARS ANY_CHAR ANY_STRING ANY_DURATION
    ANY_DATE"""
_TYPE = rf"(?:{'|'.join(_words(_IEC_TYPES) | _words('BCD'))})"
_MATH = (
    "abs acos asin atan atan2 cos sin tan acosh asinh atanh cosh sinh tanh exp exp2 exp10 expm1 frexp ilogb ldexp log "
    "log10 log1p log2 logb modf scalb scalbn scalbln cbrt fabs hypot pow pow10 sqrt erf erfc lgamma tgamma gamma ceil "
    "floor nearbyint rint lrint llrint round lround llround trunc fmod remainder remquo drem copysign nan nextafter "
    "nexttoward fdim fmax fmin fma j0 j1 jn y0 y1 yn significand finite sincos"
)
RESERVED: Mapping[str, frozenset[str]] = {
    # IEC 61131-3:2013, table 4 and annex A; of the second edition (2003) annex C and table 52 and 57, the operators of
    # instruction lists and the qualifiers of actions, which CODESYS and TwinCAT reserve in part
    "a keyword of IEC 61131-3": _words(
        _IEC_TYPES
        + """
    ABSTRACT ACTION AND ARRAY AT BY CASE CLASS CONFIGURATION CONSTANT CONTINUE DO ELSE ELSIF EN ENO END_ACTION END_CASE
    END_CLASS END_CONFIGURATION END_FOR END_FUNCTION END_FUNCTION_BLOCK END_IF END_INTERFACE END_METHOD END_NAMESPACE
    END_PROGRAM END_REPEAT END_RESOURCE END_STEP END_STRUCT END_TRANSITION END_TYPE END_VAR END_WHILE EXIT EXTENDS
    FALSE FINAL FOR FROM FUNCTION FUNCTION_BLOCK F_EDGE IF IMPLEMENTS INITIAL_STEP INTERFACE INTERNAL INTERVAL METHOD
    MOD NAMESPACE NON_RETAIN NOT NULL OF ON OR OVERLAP OVERRIDE PRIORITY PRIVATE PROGRAM PROTECTED PUBLIC READ_ONLY
    READ_WRITE REF REF_TO REPEAT RESOURCE RETAIN RETURN R_EDGE SINGLE STEP STRUCT SUPER TASK THEN THIS TO TRANSITION
    TRUE TYPE UNTIL USING VAR VAR_ACCESS VAR_CONFIG VAR_EXTERNAL VAR_GLOBAL VAR_INPUT VAR_IN_OUT VAR_OUTPUT VAR_TEMP
    WHILE WITH XOR LD LDN ST STN S R S1 R1 CLK CU CD PV IN PT ANDN ORN XORN CAL CALC CALCN RET RETC RETCN JMP JMPC
    JMPCN N P P0 P1 L D SD DS SL"""
    ),
    # IEC 61131-3:2013, tables 22 to 36; the typed ones of the second edition
    "a standard function of IEC 61131-3": _words(
        """
    TRUNC ROUND ABS SQRT LN LOG EXP SIN COS TAN ASIN ACOS ATAN ATAN2 ADD MUL SUB DIV EXPT MOVE SHL SHR ROR ROL SEL MAX
    MIN LIMIT MUX GT GE EQ LT LE NE LEN LEFT RIGHT MID CONCAT INSERT DELETE REPLACE FIND LOWER_BOUND UPPER_BOUND
    ADD_TIME ADD_LTIME ADD_TOD_TIME ADD_LTOD_LTIME ADD_DT_TIME ADD_LDT_LTIME SUB_TIME SUB_LTIME SUB_DATE_DATE
    SUB_LDATE_LDATE SUB_TOD_TIME SUB_LTOD_LTIME SUB_TOD_TOD SUB_LTOD_LTOD SUB_DT_TIME SUB_LDT_LTIME SUB_DT_DT
    SUB_LDT_LDT MULTIME MUL_TIME MUL_LTIME DIVTIME DIV_TIME DIV_LTIME CONCAT_DATE CONCAT_TOD CONCAT_LTOD CONCAT_DT
    CONCAT_LDT CONCAT_DATE_TOD CONCAT_DATE_LTOD SPLIT_DATE SPLIT_TOD SPLIT_LTOD SPLIT_DT SPLIT_LDT DAY_OF_WEEK
    TO_BIG_ENDIAN TO_LITTLE_ENDIAN FROM_BIG_ENDIAN FROM_LITTLE_ENDIAN IS_VALID IS_VALID_BCD"""
    ),
    # IEC 61131-3:2013, tables 43 to 46; 61131-3:2003, annexes D and F (examples, five of which matiec compiles with
    # every project: lib/ieclib.txt); IEC 61131-5:2000, table 15
    "a function block of IEC 61131-3": _words(
        """
    SR RS SEMA R_TRIG F_TRIG CTU CTD CTUD TP TON TOF RTC INTEGRAL DERIVATIVE PID HYSTERESIS RAMP AVERAGE DELAY LAG1
    DIFFEQ TRANSFER LIMITS_ALARM CMD_MONITOR FWD_REV_MON FWD_REV_MON_1 STACK_INT MIX_2_BRIX ALRM_INT WEIGH GRAVEL AGV
    BLANK MIX_BRIX ANALOG_LIMITS ANALOG_MONITOR ANALOG_SIGNAL_RANGE ANALOG_SIGNAL_TYPE ANALOG_CHANNEL_CONFIGURATION
    ANALOG_DATA STATUS REMOTE_VAR READ WRITE USEND URCV BSEND BRCV SEND RCV NOTIFY ALARM CONNECT DISCONNECT"""
    ),
    # helpme-codesys.com: Keywords, Operators, Data Types; libraries Standard and Util
    "a word of CODESYS": _words(
        """
    ADR BITADR SIZEOF XSIZEOF INDEXOF INI BIT PVOID XINT UXINT XWORD POINTER REFERENCE UNION END_UNION VAR_STAT
    VAR_INST VAR_GENERIC PERSISTENT PARAMS PROPERTY END_PROPERTY GET SET TEST_AND_SET AND_THEN OR_ELSE LIBRARY
    MACRO END_MACRO TRY CATCH FINALLY ENDTRY PD PID_FIXCYCLE BLINK GEN FREQ_MEASURE CHARCURVE RAMP_INT RAMP_REAL
    LIMITALARM LIN_TRAFO STATISTICS_INT STATISTICS_REAL VARIANCE EXTRACT PACK PUTBIT UNPACK CLOCK LTP LTON LTOF
    WLEN WLEFT WRIGHT WMID WCONCAT WINSERT WDELETE WREPLACE WFIND"""
    ),
    # infosys.beckhoff.com: TwinCAT 3 PLC, Keywords, Data types and Operators; what CODESYS has besides stands above
    "a word of TwinCAT 3": _words(
        """
    OTCID HRESULT ITCUNKNOWN UXINT XWORD GVL END_GET END_SET F_GETSYSTEMTIME GETCURTASKINDEX GETSYSTEMTIME
    LTRUNC TRUNC_INT LMOD FRAC FLOOR MODABS TWINCAT_SYSTEMINFOVARLIST"""
    ),
    # S7-SCL V5.3 manual (A5E00324650), 5.4 reserved words; STEP 7 (TIA Portal) help, SCL: keywords, data types,
    # instructions; English and German addresses stand under PATTERNS
    "a word of SCL": _words(
        """
    BEGIN BLOCK_DB BLOCK_FB BLOCK_FC BLOCK_SDB BLOCK_SFB BLOCK_SFC CONST COUNTER DATA_BLOCK END_CONST END_DATA_BLOCK
    END_LABEL END_ORGANIZATION_BLOCK END_REGION GOTO LABEL NIL OK ORGANIZATION_BLOCK REGION S5TIME TIMER VOID VARIANT
    DTL TITLE VERSION AUTHOR FAMILY NAME KNOW_HOW_PROTECT NETWORK UDT DB_ANY OB_ANY CONN_ANY HW_ANY EVENT_ANY REMOTE
    BLOCK_NUMBER INSTANCE STRUCTURE CONT_C CONT_S PULSEGEN TCONT_CP TCONT_S PID_COMPACT PID_3STEP PID_TEMP PIDCONV
    POLYLINE SPLITRANGE FILTER_PT1 FILTER_PT2 FILTER_DT1 INTEGRATION SQR NEG FRAC CEIL FLOOR INC DEC SWAP NORM_X SCALE_X
    SCALE UNSCALE PEEK POKE PEEK_BOOL POKE_BOOL POKE_BLK TONR RT PRESET_TIMER RESET_TIMER S_PULSE S_PEXT S_ODT S_ODTS
    S_OFFDT S_CU S_CD S_CUD COUNTOFELEMENTS ATTACH DETACH SERIALIZE DESERIALIZE TYPEOF TYPEOFELEMENTS IS_ARRAY
    MOVE_BLK UMOVE_BLK FILL_BLK UFILL_BLK MOVE_BLK_VARIANT VARIANTGET VARIANTPUT VARIANT_TO_DB_ANY RD_SYS_T WR_SYS_T
    RD_LOC_T T_CONV T_ADD T_SUB T_DIFF T_COMBINE RUNTIME STP ENDIS_PW RE_TRIGR GET_ERROR GET_ERR_ID BCD16 BCD32"""
    ),
    # Beremiz' and OpenPLC's matiec: stage1_2/iec_flex.ll, lib/*.txt; OpenPLC's communication_blocks.txt
    "a word of matiec": _words(
        """
    EOL TCP_CONNECT TCP_SEND TCP_RECEIVE TCP_CLOSE
    DATE_AND_TIME_TO_TIME_OF_DAY DATE_AND_TIME_TO_DATE"""
    ),
    # ISO/IEC 9899:1999, 6.4.1, and of C23 what is new; 7.12 and what math.h of POSIX has besides; macros of <stddef.h>
    # and <stdio.h>; words that compilers define unless told to keep to the standard
    "a word of C": _words(
        """
    auto break case char const continue default do double else enum extern float for goto if inline int long register
    restrict return short signed sizeof static struct switch typedef union unsigned void volatile while bool true false
    nullptr alignas alignof constexpr static_assert thread_local typeof typeof_unqual asm fortran main NULL EOF BUFSIZ
    stdin stdout stderr linux unix i386 INFINITY NAN DOMAIN SING OVERFLOW UNDERFLOW PLOSS TLOSS signgam errno
    printf fpclassify isfinite isinf isnan isnormal signbit isgreater isless labs div index rindex time"""
    ),
    # ISO/IEC 14882:2020, 5.11
    "a word of C++": _words(
        """
    alignas alignof and and_eq asm bitand bitor catch char8_t char16_t char32_t class compl concept consteval constexpr
    constinit const_cast co_await co_return co_yield decltype delete dynamic_cast explicit export friend mutable
    namespace new noexcept not not_eq nullptr operator or or_eq private protected public reinterpret_cast requires
    static_assert static_cast template this thread_local throw try typeid typename using virtual wchar_t xor xor_eq
    std import module"""
    ),
    # The Python Language Reference 3.13, 2.3, and its built-in functions and constants
    "a word of Python": _words(
        """
    False None True and as assert async await break class continue def del elif else except finally for from global if
    import in is lambda nonlocal not or pass raise return try while with yield match case type abs aiter all anext any
    ascii bin bool breakpoint bytearray bytes callable chr classmethod compile complex copyright credits delattr dict
    dir divmod enumerate eval exec exit filter float format frozenset getattr globals hasattr hash help hex id input int
    isinstance issubclass iter len license list locals map max memoryview min next object oct open ord pow print
    property quit range repr reversed round set setattr slice sorted staticmethod str sum super tuple vars zip Ellipsis
    NotImplemented math"""
    ),
    # ECMAScript 2024, 12.7.2, with what strict code reserves and the globals that no code may redefine
    "a word of JavaScript": _words(
        """
    await break case catch class const continue debugger default delete do else enum export extends false finally for
    function if import in instanceof new null return super switch this throw true try typeof var void while with yield
    let static implements interface package private protected public async of arguments eval undefined NaN Infinity
    Math globalThis window document"""
    ),
    "a word of the exported files": _words("restart runs sample_time self prepare start step least largest"),
}
"""Names that a language, one of its dialects, or the layout of a file has taken, in lower case, by what each is."""
PATTERNS: Mapping[str, re.Pattern[str]] = {
    "a conversion of IEC 61131-3": re.compile(rf"(?:{_TYPE}_)?(?:trunc|to)_{_TYPE}|{_TYPE}_trunc(?:_{_TYPE})?"),
    "a typed block of IEC 61131-3": re.compile(rf"(?:ctu|ctd|ctud|tp|ton|tof)_{_TYPE}"),
    "a type of PLCopen's safety": re.compile(rf"safe{_TYPE}"),
    "an address of SCL": re.compile(
        r"(?:[acdeilmpqtz]|[aeilmq][bdw]|p[aeiq][bdw]?|d[bil][bdwx]?|fb|fc|ob|sfb|sfc|sdb|udt)\d+"
    ),
    "a function of C's math.h": re.compile(rf"(?:{_MATH.replace(' ', '|')})[fl]?"),
    "a constant of C's math.h": re.compile(
        r"m_(?:e|log2e|log10e|ln2|ln10|pi|pi_2|pi_4|1_pi|2_pi|2_sqrtpi|sqrt2|sqrt1_2)[fl]?"
        r"|fp_(?:nan|infinite|zero|subnormal|normal|fast_fma[fl]?|ilogb0|ilogbnan)|huge_val[fl]?|math_err\w*"
    ),
}
"""Names that are taken as a kind, in lower case."""
RESERVED_FILES = _words(
    """
    run k worst wanted off con prn aux nul com0 com1 com2 com3 com4 com5 com6 com7 com8 com9 lpt0 lpt1 lpt2 lpt3 lpt4
    lpt5 lpt6 lpt7 lpt8 lpt9 assert complex ctype errno fenv float inttypes iso646 limits locale math setjmp signal
    stdarg stdbool stddef stdint stdio stdlib string tgmath time wchar wctype"""
)
"""What a block and its files cannot be called besides: a name of C's test, a device of Windows (learn.microsoft.com,
Naming Files), a header of C99 (7.1.2)."""


def reserved_as(name: str) -> str | None:
    """What a name is in one of the languages, in words; None for one that is free in all of them."""
    plain = name.casefold()
    listed = (what for what, words in RESERVED.items() if plain in words)
    return next(listed, None) or next((what for what, kind in PATTERNS.items() if kind.fullmatch(plain)), None)


class Identifiers:
    """The names that a program has, each an identifier in every language, given once whatever its case.

    Parameters
    ----------
    taken : iterable of str
        Names that are not to be given.
    """

    def __init__(self, taken: Iterable[str] = ()) -> None:
        self._taken: set[str] = set()
        self.take(*taken)

    def take(self, *names: str) -> None:
        """Keep names from being given."""
        self._taken |= {name.casefold() for name in names}

    def claim(self, *wishes: str) -> str:
        """The first of some wishes, worded as an identifier, that is free; else the last with a number after it."""
        worded = []
        for wish in wishes:  # ASCII letters, digits and single underscores between them, a letter first
            plain = unicodedata.normalize("NFKD", wish).encode("ascii", "ignore").decode()
            joined = "_".join(re.findall("[A-Za-z0-9]+", plain))
            joined = f"x_{joined}" if joined[:1].isdigit() else joined
            worded.append(joined[:MAX_IDENTIFIER].rstrip("_"))
        for name in filter(None, worded):
            if self._is_free(name):
                self.take(name)
                return name
        return self.claim_next(f"{worded[-1] or 'x'}_", 2)

    def claim_next(self, kind: str, first: int = 1) -> str:
        """The first free name of a kind and a number."""
        for number in itertools.count(first):
            end = f"_{number}" if kind.endswith("_") else str(number)
            name = f"{kind.rstrip('_')[: MAX_IDENTIFIER - len(end)].rstrip('_')}{end}"
            if self._is_free(name):
                break
        self.take(name)
        return name

    def _is_free(self, name: str) -> bool:
        return name.casefold() not in self._taken and reserved_as(name) is None
