"""Writes C that evaluates a function for several arguments at once, in lanes: each number is a vector of the compiler.

The text of a function is the same as for plain numbers; this file writes the operations that differ. A comparison gives
a mask, and a choice evaluates both sides and selects lane by lane, so NaN in one lane does not spread to the others.
gcc and clang support such vectors on every processor, and use the vector instructions that it has.

Sources: Cody & Waite 1980, Software Manual for the Elementary Functions, for the reduction of arguments; the
polynomials are those of Sun's fdlibm (1993) in double precision and of Moshier's Cephes (1992) in single precision.
"""

from collections.abc import Iterable
from string import Template
from typing import NamedTuple

OPERATORS = {
    "and": "{0} & {1}",
    "or": "{0} | {1}",
    "not": "~{0}",
    "select": "{type}_choose({0}, {1}, {2})",
    "choose_truth": "({0} & {1}) | (~{0} & {2})",
    "either": "{type}_choose({0} < {1}, {2}, {3})",
}
"""C operators whose text for lanes differs from the text for plain numbers."""

HEAD = """typedef $scalar $type __attribute__((vector_size($bytes)));
typedef $whole ${type}_truth __attribute__((vector_size($bytes)));

static inline __attribute__((always_inline, unused)) $type ${type}_all($scalar a)
{
    return a - ($type){0};
}

static inline __attribute__((always_inline, unused)) $type ${type}_choose(${type}_truth p, $type a, $type b)
{
    return ($type)((p & (${type}_truth)a) | (~p & (${type}_truth)b));
}

static inline __attribute__((always_inline, unused)) int ${type}_any(${type}_truth p)
{
    int i, found = 0;
    for (i = 0; i < $lanes; ++i)
        found |= p[i] != 0;
    return found;
}
"""

EACH = """static inline __attribute__((unused)) $type ${type}_$op($type a)
{
    $type y;
    int i;
    for (i = 0; i < $lanes; ++i)
        y[i] = $function(a[i]);
    return y;
}
"""
"""A function of <math.h>, lane by lane; compilers make one instruction of a square root or a rounding."""
EACH_OF_TWO = """static inline __attribute__((unused)) $type ${type}_$op($type a, $type b)
{
    $type y;
    int i;
    for (i = 0; i < $lanes; ++i)
        y[i] = $function(a[i], b[i]);
    return y;
}
"""
"""The same for a function of two numbers."""

CIRCULAR = """static __attribute__((noinline, unused)) $type ${type}_far_$op($type a, $type near)
{
    int i;
    for (i = 0; i < $lanes; ++i)
        if (!(a[i] <= $far && a[i] >= -$far))
            near[i] = $function(a[i]);
    return near;
}

static inline __attribute__((always_inline, unused)) $type ${type}_$op($type a)
{
    /* k, the nearest number of quarter turns, is in the last bits of a sum with a large number. */
    const $type sum = a * $quarters + $large, k = sum - $large;
    const $type r = ((a - k * $first) - k * $second) - k * $third, z = r * r;
    const ${type}_truth turns = (${type}_truth)sum$ahead;
    const $type sine = r + r * z * ($sine), half = $half * z, w = $one - half;
    const $type cosine = w + ((($one - w) - half) + z * z * ($cosine));
    const $type part = ${type}_choose((turns & 1) == 0, sine, cosine);
    const $type found = (${type})((${type}_truth)part ^ ((turns << $shift) & (${type}_truth)${type}_all(-$zero)));
    if (${type}_any(~((a <= $far) & (a >= -$far))))
        return ${type}_far_$op(a, found);
    return found;
}
"""
"""Sine and cosine: one of two series, chosen by the quarter turn, with the sign of that quarter turn.

Sine and cosine of one argument share all but the last lines, so that a compiler computes these lines once. Arguments
beyond `far`, for which the reduction is not exact, and NaN and infinity go to <math.h>.
"""

OTHERS = {
    "abs": "static inline __attribute__((unused)) $type ${type}_abs($type a)\n{\n"
    "    return ($type)((${type}_truth)a & ~(${type}_truth)${type}_all(-$zero));\n}\n",
    "min": "static inline __attribute__((unused)) $type ${type}_min($type a, $type b)\n{\n"
    "    return ${type}_choose((a < b) | (a != a), a, b);\n}\n",
    "max": "static inline __attribute__((unused)) $type ${type}_max($type a, $type b)\n{\n"
    "    return ${type}_choose((a > b) | (a != a), a, b);\n}\n",
    "is_finite": "static inline __attribute__((unused)) ${type}_truth ${type}_is_finite($type a)\n{\n"
    "    return a - a == $zero;\n}\n",
    "sign": "static inline __attribute__((unused)) $type ${type}_sign($type a)\n{\n"
    "    return ${type}_choose(a > $zero, ${type}_all($one), ${type}_choose(a < $zero, ${type}_all(-$one), a));\n}\n",
    "table": "static inline __attribute__((unused)) $type ${type}_table(const $scalar *row, $type place, int last)\n{\n"
    "    $type y;\n    int i;\n    for (i = 0; i < $lanes; ++i) {\n        const $scalar at = place[i];\n"
    "        y[i] = row[at > $zero ? at < ($scalar)last ? (int)at : last : 0];\n    }\n    return y;\n}\n",
}
"""Operations that lanes write as functions of their own, with the same results as for plain numbers."""


class _Precision(NamedTuple):
    """Constants of sine and cosine: π/2 in three parts, whose products with a count of quarter turns are exact."""

    first: str
    second: str
    third: str
    quarters: str
    large: str
    far: str
    shift: int
    sine: tuple[str, ...]
    cosine: tuple[str, ...]


PRECISIONS = {
    "double": _Precision(
        "1.57079632673412561417e+00",
        "6.07710050630396597660e-11",
        "2.02226624879595063154e-21",
        "6.36619772367581382433e-01",
        # 1.5·2⁵²: added to it, a number leaves its nearest integer in the last bits of the sum.
        "6755399441055744.0",
        # Up to here k < 2¹⁶, and its products with the first two parts, of 33 bits, are exact; <math.h> does the rest.
        "100000.0",
        # From the second bit of the count of quarter turns to the sign bit.
        62,
        (
            "-1.66666666666666324348e-01",
            "8.33333333332248946124e-03",
            "-1.98412698298579493134e-04",
            "2.75573137070700676789e-06",
            "-2.50507602534068634195e-08",
            "1.58969099521155010221e-10",
        ),
        (
            "4.16666666666666019037e-02",
            "-1.38888888888741095749e-03",
            "2.48015872894767294178e-05",
            "-2.75573143513906633035e-07",
            "2.08757232129817482790e-09",
            "-1.13596475577881948265e-11",
        ),
    ),
    "float": _Precision(
        "1.5703125f",
        "4.837512969970703125e-4f",
        "7.54978995489188216e-8f",
        "6.36619772367581382433e-01f",
        # 1.5·2²³, the same for single precision.
        "12582912.0f",
        "8192.0f",
        # The same for 32 bits.
        30,
        ("-1.6666654611e-1f", "8.3321608736e-3f", "-1.9515295891e-4f"),
        ("4.166664568298827e-2f", "-1.388731625493765e-3f", "2.443315711809948e-5f"),
    ),
}
BYTES = {"double": 8, "float": 4}
WHOLE = {"double": "long long", "float": "int"}
"""Integer types of the same size as the numbers, from which masks are made."""
OF_TWO = ("pow", "atan2")


def head(scalar: str, kind: str, lanes: int) -> str:
    """Write the types and functions that every file with lanes needs."""
    return _fill_template(HEAD, scalar, kind, lanes)


def helper(op: str, function: str, scalar: str, kind: str, lanes: int) -> str:
    """Write an operation on vectors as a function in C."""
    if op in OTHERS:
        return _fill_template(OTHERS[op], scalar, kind, lanes)
    if op in ("sin", "cos"):
        precision = PRECISIONS[scalar]
        series = {"sine": _horner(precision.sine), "cosine": _horner(precision.cosine)}
        fields = precision._asdict() | series | {"half": _number(0.5, scalar), "ahead": " + 1" if op == "cos" else ""}
        return _fill_template(CIRCULAR, scalar, kind, lanes, op=op, function=function, **fields)
    # One call of <math.h> for each lane: only sine and cosine have a polynomial here.
    return _fill_template(EACH_OF_TWO if op in OF_TWO else EACH, scalar, kind, lanes, op=op, function=function)


def _fill_template(text: str, scalar: str, kind: str, lanes: int, **fields: object) -> str:
    plain = {"type": kind, "scalar": scalar, "lanes": lanes, "bytes": lanes * BYTES[scalar], "whole": WHOLE[scalar]}
    return Template(text).substitute(plain, zero=_number(0.0, scalar), one=_number(1.0, scalar), **fields)


def _number(value: float, scalar: str) -> str:
    return f"{value}{'f' if scalar == 'float' else ''}"


def _horner(coefficients: Iterable[str]) -> str:
    """A polynomial in z."""
    *rest, text = coefficients
    for coefficient in reversed(rest):
        text = f"{coefficient} + z * ({text})" if " " in text or text.startswith("-") else f"{coefficient} + z * {text}"
    return text
