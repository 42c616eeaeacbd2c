"""Writes a graph as a C99 function of scalars, without memory management or global variables.

The text depends on the graph alone, so that it is the same on every machine. Numbers are written with just enough
digits to identify them.
"""

from collections.abc import Sequence
from typing import Literal

from scalargraph.c._c_operations import Words, helpers, literal
from scalargraph.c._c_writer import CText, Signature, Writer
from scalargraph.c._peephole import simplified
from scalargraph.errors import InputError
from scalargraph.graph import Lowered

Real = Literal["double", "float"]
MOST_STATEMENTS = 500
"""Largest number of statements in one C function: for ten thousand gcc takes minutes, for several parts seconds."""
MOST_IN_LANES = 2000
"""The same limit with several lanes; a value passed between functions then takes a number of memory for each lane."""


def c_function(
    lowered: Lowered,
    name: str,
    signature: Signature | None = None,
    real: Real = "double",
    prefix: str = "",
    static: bool = False,
    most_statements: int | None = None,
    lanes: int = 1,
) -> CText:
    """Generate the C of a lowered function.

    Use it for C of one function within a file of your own. `to_c` writes a complete file and is the simpler start. The
    helpers that the text calls come from `c_helpers`, and "float" needs a function that was lowered in single
    precision.

    Args:
        lowered: The function.
        name: Name of the C function.
        signature: Its declaration; by default `void name(const real *x, real *y)`, from all inputs to all
            results.
        real: Type of all numbers. For "float" lower the function with arguments of single precision.
        prefix: Prefix of the names of the helpers that it calls, which `c_helpers` generates.
        static: Whether it is declared `static`.
        most_statements: Longest function in statements; longer ones are written in parts. By default `MOST_STATEMENTS`,
            or `MOST_IN_LANES` for several lanes.
        lanes: Number of argument vectors evaluated at once, a power of 2. Above 1 a number is a vector of the
            compilers gcc and clang, of the type `{prefix}lanes`, with one entry for each argument.

    Raises:
        ValueError: The signature has another number of inputs or results.

    Example:
        >>> import jax.numpy as jnp
        >>> import scalargraph
        >>> lowered = scalargraph.lower(lambda x: x * x + 1.0, jnp.array(0.0))
        >>> print(scalargraph.c_function(lowered, "f").text)
        void f(const double *x, double *y)
        {
            const double v0 = (x[0] * x[0]) + 1.0;
            y[0] = v0;
        }
        <BLANKLINE>
    """
    lowered = simplified(lowered)
    chosen = signature or _flat(lowered, Words(real, prefix, lanes).real)
    counts = {"inputs": (chosen.inputs, lowered.inputs), "results": (chosen.outputs, len(lowered.outputs))}
    for role, (names, count) in counts.items():
        if len(names) != count:
            raise InputError(f"{name}: the function has {count} {role}; the signature names {len(names)}")
    most = most_statements or (MOST_STATEMENTS if lanes == 1 else MOST_IN_LANES)
    return Writer(lowered, name, chosen, Words(real, prefix, lanes), static, most).written()


def c_helpers(names: Sequence[str] | frozenset[str], real: Real = "double", prefix: str = "", lanes: int = 1) -> str:
    """Generate the static functions that generated C calls, and for lanes the types; they precede it in the file.

    The file needs `#include <math.h>`.

    Args:
        names: Names of the helpers, `CText.helpers`.
        real: Type of all numbers.
        prefix: Prefix of their names, as in `c_function`.
        lanes: Number of lanes, as in `c_function`.

    Example:
        >>> import jax.numpy as jnp
        >>> import scalargraph
        >>> graph = scalargraph.lower(lambda x: jnp.maximum(x, 0.0), jnp.array(0.0))
        >>> text = scalargraph.c_function(graph, "f", prefix="my_")
        >>> print(scalargraph.c_helpers(text.helpers, prefix="my_"))
        static double my_max(double a, double b)
        {
            return a > b || a != a ? a : b;
        }
        <BLANKLINE>
    """
    return helpers(names, Words(real, prefix, lanes))


def c_number(value: float, real: Real = "double") -> str:
    """Write a number in C, in the fewest digits that identify it.

    Args:
        value: The number; NaN and infinities give expressions with the macros of <math.h>.
        real: Type of the number; "float" rounds it to single precision.

    Example:
        >>> import scalargraph
        >>> scalargraph.c_number(0.1), scalargraph.c_number(0.1, "float"), scalargraph.c_number(float("inf"))
        ('0.1', '0.1f', '(double)INFINITY')
    """
    return literal(value, Words(real, ""))


def _flat(lowered: Lowered, real: str) -> Signature:
    inputs = tuple(f"x[{i}]" for i in range(lowered.inputs))
    outputs = tuple(f"y[{i}]" for i in range(len(lowered.outputs)))
    return Signature(f"const {real} *x, {real} *y", ("x", "y"), inputs, outputs)
