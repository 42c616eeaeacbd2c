"""A graph as C99: a function of scalars without memory management, or variables outside it.

The text depends on the graph alone, so that it is the same on every machine. Numbers are written with as many digits as
identify them.
"""

from collections.abc import Sequence
from typing import Literal

from covariant.lowering._c_operations import Words, helpers, literal
from covariant.lowering._c_tables import TablesOnce, TablesThroughout
from covariant.lowering._c_writer import CText, Signature, Writer
from covariant.lowering._lowered import Lowered
from covariant.lowering._peephole import simplified

Real = Literal["double", "float"]
Tables = Literal["none", "once", "all"]

WRITERS = {"none": Writer, "once": TablesOnce, "all": TablesThroughout}

MOST_STATEMENTS = 500
"""Longest function: gcc takes minutes for one with ten thousand statements, and seconds for the same in parts."""
MOST_IN_LANES = 2000
"""The same in lanes, where what one function leaves to another takes so many times the memory."""


def c_function(
    lowered: Lowered,
    name: str,
    signature: Signature | None = None,
    real: Real = "double",
    prefix: str = "",
    static: bool = False,
    most_statements: int | None = None,
    lanes: int = 1,
    tables: Tables = "none",
) -> CText:
    """A lowered function as C.

    - `signature`: by default `void name(const real *x, real *y)`, from all inputs to all results.
    - `real`: the type of all numbers. For "float" lower the function with arguments of single precision.
    - `prefix`: of the names of the helpers that it calls, which `c_helpers` writes.
    - `lanes`: how many arguments it is evaluated for at once, a power of 2. Above 1 a number is a vector of the
      compilers gcc and clang, of the type `{prefix}lanes`, with one entry for each argument.
    - `tables`: which statements that are alike are done by loops over tables of the places of their numbers: none,
      those that a call does once, or all, those in loops too. For small memories: they take less of it, and five times
      the instructions. The operations are the same.

    Raises `ValueError` for lanes with tables, and where the signature has another number of inputs or results.
    """
    lowered = simplified(lowered)
    chosen = signature or _flat(lowered, Words(real, prefix, lanes).real)
    for what, given, needed in (
        ("inputs", chosen.inputs, lowered.inputs),
        ("results", chosen.outputs, len(lowered.outputs)),
    ):
        if len(given) != needed:
            raise ValueError(f"{name}: the function has {needed} {what}; the signature names {len(given)}")
    most = most_statements or (MOST_STATEMENTS if lanes == 1 else MOST_IN_LANES)
    if tables != "none" and lanes > 1:
        raise ValueError(f"{name}: tables save memory and lanes time; choose one of them")
    return WRITERS[tables](lowered, name, chosen, Words(real, prefix, lanes), static, most).written()


def c_helpers(names: Sequence[str] | frozenset[str], real: Real = "double", prefix: str = "", lanes: int = 1) -> str:
    """The static functions, and for lanes the types, of C of graphs, to stand before it; it needs <math.h>."""
    return helpers(names, Words(real, prefix, lanes))


def c_number(value: float, real: Real = "double") -> str:
    """A number in C, in the fewest digits that identify it."""
    return literal(value, Words(real, ""))


def _flat(lowered: Lowered, real: str) -> Signature:
    inputs = tuple(f"x[{i}]" for i in range(lowered.inputs))
    outputs = tuple(f"y[{i}]" for i in range(len(lowered.outputs)))
    return Signature(f"const {real} *x, {real} *y", ("x", "y"), inputs, outputs)
