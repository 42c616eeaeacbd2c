"""Writes each operation of a graph in C: as an operator, as a call of <math.h>, or as a call of a helper function."""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from scalargraph.c import _c_lanes


class Words(NamedTuple):
    """How numbers are written in C.

    Attributes:
        scalar: C type of one number, `double` or `float`.
        prefix: Prefix of the names of helper functions.
        lanes: Number of entries of a vector; 1 for plain numbers.
    """

    scalar: str
    prefix: str
    lanes: int = 1

    @property
    def real(self) -> str:
        """Type of the numbers of the function: the scalar, or a vector with an entry for each lane."""
        return self.scalar if self.lanes == 1 else f"{self.prefix}lanes"

    @property
    def truth(self) -> str:
        """The type of truth values."""
        return "int" if self.lanes == 1 else f"{self.real}_truth"

    @property
    def suffix(self) -> str:
        """Suffix of literals and of the names of functions of <math.h>: "f" in single precision."""
        return "f" if self.scalar == "float" else ""

    @property
    def owner(self) -> str:
        """Prefix of the names of helper functions, which for lanes contains the type."""
        return self.prefix if self.lanes == 1 else f"{self.real}_"


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
    # If either argument is NaN the result is NaN, as in NumPy; fmin and fmax would return the other argument.
    "min": "static {real} {prefix}min({real} a, {real} b)\n{{\n    return a < b || a != a ? a : b;\n}}\n",
    "max": "static {real} {prefix}max({real} a, {real} b)\n{{\n    return a > b || a != a ? a : b;\n}}\n",
    # a − a is NaN if a is infinite or NaN, and NaN equals nothing. This test needs no macro of <math.h>.
    "is_finite": "static int {prefix}is_finite({real} a)\n{{\n    return a - a == {zero};\n}}\n",
    "table": "static int {prefix}table({real} place, int last)\n{{\n"
    "    return place > {zero} ? place < ({real})last ? (int)place : last : 0;\n}}\n",
    "sign": "static {real} {prefix}sign({real} a)\n{{\n    return a > {zero} ? {one} : a < {zero} ? -{one} : a;\n}}\n",
}
"""Operations that are helper functions of a few lines."""


def expression(op: str, operands: Sequence[str], words: Words, truth: bool = False) -> str:
    """Write an operation on operands in C."""
    if op == "stumpff":
        order = round(float(_plain(operands[0])))
        return f"{words.owner}stumpff{order}({_strip_brackets(operands[1])})"
    if op in HELPERS or (op in LIBRARY and words.lanes > 1):
        return f"{words.owner}{op}({', '.join(map(_strip_brackets, operands))})"
    if op in LIBRARY:
        return f"{LIBRARY[op]}{words.suffix}({', '.join(map(_strip_brackets, operands))})"
    if words.lanes > 1:
        chosen = "choose_truth" if op == "select" and truth else op
        return _c_lanes.OPERATORS.get(chosen, OPERATORS[op]).format(*operands, type=words.real)
    return OPERATORS[op].format(*operands)


def looked_up(table: str, place: str, last: int, words: Words) -> str:
    """Write the lookup of an entry of an array in C."""
    if words.lanes > 1:
        return f"{words.owner}table({table}, {place}, {last})"
    return f"{table}[{words.owner}table({place}, {last})]"


def of_truth(value: str, words: Words) -> str:
    """Write a truth value as the number 0 or 1 in C."""
    if words.lanes > 1:
        return f"{words.real}_choose({value}, {literal(1.0, words)}, {literal(0.0, words)})"
    return f"({words.real})({value})"


def _plain(text: str) -> str:
    """The digits of a number that `literal` wrote."""
    return text.rpartition("(")[2].rstrip(")").removesuffix("f")


def _strip_brackets(operand: str) -> str:
    """An operand as an argument of a call, without enclosing brackets, which a call does not need."""
    depth = 0
    for k, letter in enumerate(operand):
        depth += (letter == "(") - (letter == ")")
        if depth == 0 and k < len(operand) - 1:
            return operand
    return operand[1:-1] if operand.startswith("(") else operand


def literal(value: float | bool, words: Words) -> str:
    """Write a number in C with the fewest digits that identify it, in every lane; a truth value becomes 0 or 1."""
    if words.lanes > 1 and isinstance(value, bool):
        return f"{'~' if value else ''}({words.truth}){{0}}"
    if words.lanes > 1:
        return f"{words.real}_all({literal(value, words._replace(lanes=1))})"
    if isinstance(value, bool):
        return str(int(value))
    number = np.float32(value) if words.scalar == "float" else np.float64(value)
    if math.isnan(number):
        return f"({words.scalar})NAN"
    if math.isinf(number):
        return f"{'-' if number < 0 else ''}({words.scalar})INFINITY"
    # The shortest digits of the single-precision number, not those of its conversion to double.
    digits = repr(float(str(number))) if words.scalar == "float" else repr(float(number))
    return digits + words.suffix


def helpers(names: Iterable[str], words: Words) -> str:
    """Write each needed type and helper function once in C; a helper that another one calls comes first."""
    needed = set(names)
    orders = {int(name.removeprefix("stumpff")) for name in needed if name.startswith("stumpff")}
    orders = sorted(orders.union(*(_below(k) for k in orders)))
    if words.lanes > 1:
        if orders:
            needed |= {"sqrt", "sin", "cos"}
        written = [_c_lanes.head(words.scalar, words.real, words.lanes)]
        for op in (*LIBRARY, *HELPERS):
            if op in needed:
                function = f"{LIBRARY.get(op, '')}{words.suffix}"
                written.append(_c_lanes.helper(op, function, words.scalar, words.real, words.lanes))
    else:
        fill = {"real": words.real, "prefix": words.prefix, "zero": literal(0.0, words), "one": literal(1.0, words)}
        written = [HELPERS[name].format(**fill) for name in HELPERS if name in needed]
    return "\n".join([*written, *(_stumpff(k, words) for k in orders)])


def _below(k: int) -> set[int]:
    """The orders of all Stumpff functions that the closed form of c_k calls."""
    if k < 2:
        return set()
    return {1} if k == 2 else {k - 2} | _below(k - 2)


def _stumpff(k: int, words: Words) -> str:
    """Stumpff's function c_k: a series where the closed form loses digits, with the same threshold as in JAX."""
    # As in `_stumpff`: from c₃ on the closed form loses digits below k(k − 1).
    threshold = max(1.0, k * (k - 1.0))
    # Terms below eps/256 of the first one are lost in its rounding.
    smallest = np.finfo(np.float32 if words.scalar == "float" else np.float64).eps / 256
    coefficients = [1 / math.factorial(k)]
    while coefficients[-1] * threshold ** (len(coefficients) - 1) > smallest * coefficients[0]:
        coefficients.append(1 / math.factorial(2 * len(coefficients) + k))
    series = literal(coefficients[-1], words)
    for coefficient in reversed(coefficients[:-1]):
        series = f"{literal(coefficient, words)} - x * ({series})"
    declarations, closed = _closed_form(k, words)
    if words.lanes == 1:
        lines = [f"if (x < {literal(threshold, words)})", f"    return {series};", *declarations, f"return {closed};"]
    else:
        lines = [
            f"const {words.truth} near = x < {literal(threshold, words)};",
            f"const {words.real} series = {series};",
            f"if (!{words.real}_any(~near))",
            "    return series;",
            *declarations,
            f"return {words.real}_choose(near, series, {closed});",
        ]
    body = "\n".join(f"    {line}" for line in lines)
    return f"static {words.real} {words.owner}stumpff{k}({words.real} x)\n{{\n{body}\n}}\n"


def _closed_form(k: int, words: Words) -> tuple[list[str], str]:
    """Stumpff's function c_k away from zero: the declarations that come first, and the expression."""

    def call(op: str, text: str) -> str:
        return expression(op, [text], words)

    root = call("sqrt", "x")
    if k == 0:
        return [], call("cos", root)
    if k == 1:
        return [f"const {words.real} angle = {root};"], f"{call('sin', 'angle')} / angle"
    if k == 2:
        part = f"{words.owner}stumpff1({literal(0.25, words)} * x)"
        return [f"const {words.real} part = {part};"], f"{literal(0.5, words)} * part * part"
    return [], f"({literal(1 / math.factorial(k - 2), words)} - {words.owner}stumpff{k - 2}(x)) / x"
