"""Operations of a graph in C: what is an operator, a function of <math.h>, or a function that is written out."""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np


class Words(NamedTuple):
    """How numbers are written: their type, and the prefix of the names of the functions written out."""

    real: str
    prefix: str

    @property
    def suffix(self) -> str:
        """What the names of functions of <math.h> end in, and numbers."""
        return "f" if self.real == "float" else ""


OPERATORS = {
    "add": "{} + {}",
    "sub": "{} - {}",
    "mul": "{} * {}",
    "div": "{} / {}",
    "neg": "-{}",
    "lt": "{} < {}",
    "le": "{} <= {}",
    "eq": "{} == {}",
    "and": "{} && {}",
    "or": "{} || {}",
    "not": "!{}",
    "select": "{} ? {} : {}",
    "either": "{} < {} ? {} : {}",
}
"""Operations that are operators of C."""
TRUTHS = {"lt", "le", "eq", "and", "or", "not", "is_finite"}
"""Operations whose result is a truth value."""
LIBRARY = {
    "abs": "fabs",
    "floor": "floor",
    "ceil": "ceil",
    "round": "rint",
    "pow": "pow",
    "sqrt": "sqrt",
    "cbrt": "cbrt",
    "exp": "exp",
    "expm1": "expm1",
    "log": "log",
    "log1p": "log1p",
    **{name: name for name in ("sin", "cos", "tan", "asin", "acos", "atan", "atan2")},
    **{name: name for name in ("sinh", "cosh", "tanh", "asinh", "acosh", "atanh")},
}
"""Operations that are functions of <math.h>."""
HELPERS = {
    # NaN goes through both, as in NumPy and unlike fmin and fmax.
    "min": "static {real} {prefix}min({real} a, {real} b)\n{{\n    return a < b || a != a ? a : b;\n}}\n",
    "max": "static {real} {prefix}max({real} a, {real} b)\n{{\n    return a > b || a != a ? a : b;\n}}\n",
    "is_finite": "static int {prefix}is_finite({real} a)\n{{\n    return a - a == {zero};\n}}\n",
    "table": "static int {prefix}table({real} place, int last)\n{{\n"
    "    return place > {zero} ? place < ({real})last ? (int)place : last : 0;\n}}\n",
    "sign": "static {real} {prefix}sign({real} a)\n{{\n    return a > {zero} ? {one} : a < {zero} ? -{one} : a;\n}}\n",
}
"""Operations that are functions of a few lines."""


def expression(op: str, operands: Sequence[str], words: Words) -> str:
    """An operation on operands, each of them one name, one number, one call, or in brackets."""
    if op == "stumpff":
        return f"{words.prefix}stumpff{round(float(operands[0].strip('()').removesuffix('f')))}({operands[1]})"
    if op in HELPERS:
        return f"{words.prefix}{op}({', '.join(map(_unwrapped, operands))})"
    if op in LIBRARY:
        return f"{LIBRARY[op]}{words.suffix}({', '.join(map(_unwrapped, operands))})"
    return OPERATORS[op].format(*operands)


def _unwrapped(operand: str) -> str:
    """An operand as an argument of a call, without the brackets around all of it."""
    depth = 0
    for k, letter in enumerate(operand):
        depth += (letter == "(") - (letter == ")")
        if depth == 0 and k < len(operand) - 1:
            return operand
    return operand[1:-1] if operand.startswith("(") else operand


def literal(value: float | bool, words: Words) -> str:
    """A number in C, in the fewest digits that identify it; a truth value as 0 or 1."""
    if isinstance(value, bool):
        return str(int(value))
    number = np.float32(value) if words.real == "float" else np.float64(value)
    if math.isnan(number):
        return f"({words.real})NAN"
    if math.isinf(number):
        return f"{'-' if number < 0 else ''}({words.real})INFINITY"
    digits = repr(float(str(number))) if words.real == "float" else repr(float(number))
    return digits + words.suffix


def helpers(names: Iterable[str], words: Words) -> str:
    """The functions written out, each once, those that others call first."""
    needed = set(names)
    for name in sorted(needed):
        if name.startswith("stumpff"):
            needed |= _below(int(name.removeprefix("stumpff")))
    fill = {"real": words.real, "prefix": words.prefix, "zero": literal(0.0, words), "one": literal(1.0, words)}
    written = [HELPERS[name].format(**fill) for name in HELPERS if name in needed]
    orders = sorted(int(name.removeprefix("stumpff")) for name in needed if name.startswith("stumpff"))
    return "\n".join([*written, *(_stumpff(k, words) for k in orders)])


def _below(k: int) -> set[str]:
    """The functions that the closed form of Stumpff's c_k calls."""
    if k < 2:
        return set()
    return {"stumpff1"} if k == 2 else {f"stumpff{k - 2}"} | _below(k - 2)


def _stumpff(k: int, words: Words) -> str:
    """Stumpff's function c_k: a series where the closed form loses digits, as in JAX."""
    threshold = max(1.0, k * (k - 1.0))
    smallest = np.finfo(np.float32 if words.real == "float" else np.float64).eps / 256
    coefficients = [1 / math.factorial(k)]
    while coefficients[-1] * threshold ** (len(coefficients) - 1) > smallest * coefficients[0]:
        coefficients.append(1 / math.factorial(2 * len(coefficients) + k))
    series = literal(coefficients[-1], words)
    for coefficient in reversed(coefficients[:-1]):
        series = f"{literal(coefficient, words)} - x * ({series})"
    root = f"sqrt{words.suffix}(x)"
    quarter, half = literal(0.25, words), literal(0.5, words)
    if k == 0:
        closed = [f"return cos{words.suffix}({root});"]
    elif k == 1:
        closed = [f"const {words.real} angle = {root};", f"return sin{words.suffix}(angle) / angle;"]
    elif k == 2:
        closed = [
            f"const {words.real} part = {words.prefix}stumpff1({quarter} * x);",
            f"return {half} * part * part;",
        ]
    else:
        first = literal(1 / math.factorial(k - 2), words)
        closed = [f"return ({first} - {words.prefix}stumpff{k - 2}(x)) / x;"]
    lines = [
        f"static {words.real} {words.prefix}stumpff{k}({words.real} x)",
        "{",
        f"    if (x < {literal(threshold, words)})",
        f"        return {series};",
        *(f"    {line}" for line in closed),
        "}",
    ]
    return "\n".join(lines) + "\n"
