"""Translates a NumPy formula that works entry by entry into C: the formula is called on symbols that record operations.

So a formula has one text, for NumPy and for C, and both do the same operations in the same order. Only operations that
IEEE 754 determines have a counterpart in C: sums, products, quotients, roots, comparisons, integers and operations on
bits. Formulas ask `any()` and `all()` about a whole array only to save work; the answers given here skip no work.
"""

import math
import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

REAL, TRUTH, BITS = "double", "int", "int64_t"

HEAD = """#include <float.h>
#include <math.h>
#include <stdint.h>
#include <string.h>

static inline int64_t bits_of(double x)
{
    int64_t bits;
    memcpy(&bits, &x, sizeof bits);
    return bits;
}

static inline double double_of(int64_t bits)
{
    double x;
    memcpy(&x, &bits, sizeof x);
    return x;
}

"""
"""Declarations that the C of formulas needs before it."""

OPERATORS: dict[Any, tuple[str, str | None]] = {
    np.add: ("{} + {}", None),
    np.subtract: ("{} - {}", None),
    np.multiply: ("{} * {}", None),
    np.divide: ("{} / {}", REAL),
    np.floor_divide: ("{} / {}", BITS),  # only for numbers that are not negative
    np.negative: ("-{}", None),
    np.absolute: ("fabs({})", REAL),
    np.sqrt: ("sqrt({})", REAL),
    np.floor: ("floor({})", REAL),
    np.ceil: ("ceil({})", REAL),
    np.rint: ("rint({})", REAL),
    np.copysign: ("copysign({}, {})", REAL),
    np.sign: ("{0} > 0 ? 1.0 : {0} < 0 ? -1.0 : {0}", REAL),  # zeros and NaN are returned unchanged
    # If either argument is NaN the result is NaN, as in NumPy; fmin and fmax would return the other argument.
    np.minimum: ("{1} != {1} ? {1} : {1} < {0} ? {1} : {0}", REAL),
    np.maximum: ("{1} != {1} ? {1} : {1} > {0} ? {1} : {0}", REAL),
    np.less: ("{} < {}", TRUTH),
    np.less_equal: ("{} <= {}", TRUTH),
    np.greater: ("{} > {}", TRUTH),
    np.greater_equal: ("{} >= {}", TRUTH),
    np.equal: ("{} == {}", TRUTH),
    np.not_equal: ("{} != {}", TRUTH),
    np.isnan: ("{0} != {0}", TRUTH),
    np.isfinite: ("fabs({}) <= DBL_MAX", TRUTH),
    np.bitwise_and: ("{} & {}", None),
    np.bitwise_or: ("{} | {}", None),
    np.bitwise_xor: ("{} ^ {}", None),
    np.invert: ("!{}", TRUTH),
    np.left_shift: ("(int64_t)((uint64_t){} << {})", BITS),
    np.right_shift: ("{} >> {}", BITS),
}
"""C of each function of NumPy on entries, and the type of its result; None for the type of its arguments."""


class Text:
    """A list of C assignments, each to a new variable; equal expressions share one variable.

    Args:
        tables: Names of constant tables by their entries, shared with other texts; new tables are added to it.
    """

    def __init__(self, tables: dict[str, str]) -> None:
        self.tables = tables
        self._known: dict[tuple[str, str], str] = {}

    def name(self, kind: str, expression: str) -> str:
        """Return the variable that holds an expression, adding its assignment where needed."""
        return self._known.setdefault((kind, expression), f"{kind[0]}{len(self._known)}")

    def table(self, values: Sequence[float]) -> str:
        """Return the name of a table, adding it where needed."""
        return self.tables.setdefault(", ".join(map(literal, values)), f"table{len(self.tables)}")

    def lines(self, results: Iterable[str]) -> list[str]:
        """Return the assignments that some expressions need, in order."""
        needed, lines = set(NAMES.findall(" ".join(results))), []
        for (kind, expression), name in reversed(self._known.items()):
            if name in needed:
                needed.update(NAMES.findall(expression))
                lines.append(f"const {kind} {name} = {expression};")
        return lines[::-1]


NAMES = re.compile(r"\b\w+\b")


class Traced:
    """A symbol for an entry of an array, or for several stacked entries; operations on it are recorded as C variables.

    Args:
        text: The C that operations are added to.
        kind: C type of the variables.
        parts: Names of the variables: one, or one for each stacked entry.
    """

    def __init__(self, text: Text, kind: str, parts: tuple[str, ...]):
        self.text, self.kind, self.parts = text, kind, parts

    def __array_ufunc__(self, function: np.ufunc, method: str, *arguments: Any, **options: object) -> "Traced":
        if method != "__call__" or options:
            raise TypeError(f"{function.__name__}.{method} has no C for each entry")
        # C's && would branch. For truth values 0 and 1, & gives the same result and can be vectorised.
        if function is np.logical_and:
            function = np.bitwise_and
        # A finite number times a truth value, as in `TINY * mask`, is written as a choice.
        if function is np.multiply and isinstance(arguments[0], float) and arguments[1].kind == TRUTH:
            return _where(arguments[1], arguments[0], 0.0)
        expression, result = OPERATORS[function]
        kinds = [a.kind if isinstance(a, Traced) else kind_of(a) for a in arguments]
        common = next(kind for kind in (REAL, BITS, TRUTH) if kind in kinds)
        return self.each(result or common, expression, *(self.of(a, common) for a in arguments))

    def __array_function__(
        self, function: Callable, types: Iterable[type], arguments: tuple, options: dict
    ) -> "Traced":
        return FUNCTIONS[function](*arguments, **options)

    def of(self, value: "Traced | float", kind: str) -> "Traced":
        """Convert a known number to a symbol; a symbol is returned unchanged."""
        if isinstance(value, Traced):
            return value
        return Traced(self.text, kind, (literal(float(value) if kind == REAL else value),))

    def each(self, kind: str, expression: str, *arguments: "Traced") -> "Traced":
        """Add an expression for each stacked entry."""
        count = max(len(a.parts) for a in arguments)
        rows = zip(*(a.parts * (count if len(a.parts) == 1 else 1) for a in arguments), strict=True)
        return Traced(self.text, kind, tuple(self.text.name(kind, expression.format(*row)) for row in rows))

    def __getitem__(self, index: int) -> "Traced":
        return Traced(self.text, self.kind, (self.parts[index],))

    def __iter__(self):
        return (self[i] for i in range(len(self.parts)))

    def _ends(self, function: np.ufunc) -> "Traced":
        first, second = self
        return function(first, second)

    def min(self, axis: int) -> "Traced":
        """The smaller of two stacked entries."""
        return self._ends(np.minimum)

    def max(self, axis: int) -> "Traced":
        """The larger of two stacked entries."""
        return self._ends(np.maximum)

    def all(self, axis: int | None = None) -> "Traced | bool":
        """Whether both of two stacked entries are true."""
        return False if axis is None else self._ends(np.bitwise_and)

    def any(self) -> bool:
        """Always True: the question concerns a whole array, and no entry is known, so no work may be skipped."""
        return True

    def view(self, kind: type) -> "Traced":
        """The bits of a double as an int64, or back."""
        return self.each(BITS, "bits_of({})", self) if kind is np.int64 else self.each(REAL, "double_of({})", self)

    def astype(self, kind: type) -> "Traced":
        """Convert to another type."""
        return self.each(TRUTH, "{} != 0", self) if kind is bool else self.each(REAL, "(double){}", self)


def _operator(function: np.ufunc, swapped: bool = False) -> Callable:
    return (lambda a, b: function(b, a)) if swapped else (lambda a, *b: function(a, *b))


for _name, _function in {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "truediv": np.divide,
    "floordiv": np.floor_divide,
    "and": np.bitwise_and,
    "or": np.bitwise_or,
    "xor": np.bitwise_xor,
    "lshift": np.left_shift,
    "rshift": np.right_shift,
}.items():
    setattr(Traced, f"__{_name}__", _operator(_function))
    setattr(Traced, f"__r{_name}__", _operator(_function, swapped=True))
for _name, _function in {
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "eq": np.equal,
    "ne": np.not_equal,
    "neg": np.negative,
    "abs": np.absolute,
    "invert": np.invert,
}.items():
    setattr(Traced, f"__{_name}__", _operator(_function))


def kind_of(value: float | np.generic) -> str:
    """C type of a known number."""
    return TRUTH if isinstance(value, bool | np.bool_) else BITS if isinstance(value, int | np.integer) else REAL


def literal(value: float | np.generic) -> str:
    """Write a known number in C, exactly: real numbers as hexadecimal constants."""
    if kind_of(value) != REAL:
        return f"{int(value)}" if kind_of(value) == TRUTH else f"INT64_C({int(value)})"
    number = float(value)
    # In C, NAN and INFINITY have the type float, hence the conversion.
    if math.isnan(number):
        return "(double)NAN"
    if math.isinf(number):
        return f"({'-' if number < 0 else ''}(double)INFINITY)"
    # Brackets avoid `--` if a minus sign precedes the number.
    return f"({number.hex()})" if math.copysign(1.0, number) < 0 else number.hex()


def _where(condition: Traced | bool, a: Traced | float, b: Traced | float) -> Traced:
    symbol = next(x for x in (condition, a, b) if isinstance(x, Traced))
    kind = next((x.kind for x in (a, b) if isinstance(x, Traced)), REAL)
    return symbol.each(kind, "{} ? {} : {}", symbol.of(condition, TRUTH), symbol.of(a, kind), symbol.of(b, kind))


def _stack(arrays: Sequence[Traced | float]) -> Traced:
    symbol = next(x for x in arrays if isinstance(x, Traced))
    (parts,) = zip(*(symbol.of(a, symbol.kind).parts for a in arrays), strict=True)
    return Traced(symbol.text, symbol.kind, parts)


def _choose(index: Traced, choices: np.ndarray) -> Traced:
    return index.each(REAL, f"{index.text.table(choices.tolist())}[{{}}]", index)


FUNCTIONS: dict[Any, Callable] = {
    np.where: _where,
    np.stack: _stack,
    np.choose: _choose,
    np.array_equal: lambda a, b: False,
    np.zeros_like: lambda x: x.of(0.0, x.kind),
    np.ones_like: lambda x: x.of(True, x.kind) if x.kind == TRUTH else x.of(1.0, x.kind),
}
"""NumPy functions that do not work entry by entry, and the methods that replace them here."""
