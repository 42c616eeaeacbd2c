"""Writes C that applies a function to every row of an array, several rows at once in lanes."""

from scalargraph.c._c import Real, c_function, c_helpers
from scalargraph.graph import Lowered
from scalargraph.template import fill


def c_rows(lowered: Lowered, name: str, lanes: int, real: Real = "double", most_statements: int | None = None) -> str:
    """Generate the C of a function that is applied to the rows of an array, several rows at once in lanes.

    It is `void name(const real *x, real *y, long long count)`, from x (count, inputs) to y (count, results). If the
    last rows do not fill all lanes, the last row fills the rest; nothing beyond it is read or written.

    Args:
        lowered: The function.
        name: Name of the C function.
        lanes: How many rows are evaluated at once, a power of 2 and more than 1.
        real: Type of all numbers.
        most_statements: Longest function in statements, as in `c_function`.

    Returns:
        A complete source file, for gcc and clang.

    Example:
        >>> import jax.numpy as jnp
        >>> import scalargraph
        >>> text = scalargraph.c_rows(scalargraph.lower(lambda x: jnp.sum(x), jnp.zeros(2)), "total", lanes=4)
        >>> "void total(const double *x, double *y, long long count);" in text
        True
    """
    text = c_function(lowered, f"{name}_lanes", real=real, static=True, most_statements=most_statements, lanes=lanes)
    words = {
        "NAME": name,
        "REAL": real,
        "LANES": lanes,
        "INPUTS": lowered.inputs,
        "OUTPUTS": len(lowered.outputs),
        "HELPERS": [c_helpers(text.helpers, real, lanes=lanes)],
        "CORE": [text.text],
    }
    return fill("scalargraph", "rows.c", words)
