"""Writes a complete C99 source file of a JAX function, with a comment that says how its arrays are passed."""

import inspect
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np

from scalargraph.c._c import Real, c_function, c_helpers
from scalargraph.c._c_names import check_name
from scalargraph.c._c_writer import Signature
from scalargraph.errors import InputError
from scalargraph.graph import lower

RESTRICT_IN_CPP = "#ifdef __cplusplus\n#define restrict\n#endif\n"
"""C++ has no keyword `restrict`. Leaving it out changes no result, since it only permits faster code."""


def to_c(function: Callable, *examples: Any, name: str = "f", real: Real = "double") -> str:
    """Generate a C99 source file that computes a JAX function.

    The C function is `void name(const real *in1, const real *in2, ..., real *out1, ...)`: a pointer for each array of
    the arguments, then one for each array of the result, in the order of `jax.tree.leaves`. A single one is called
    `in` or `out`. Arrays are contiguous and in row-major order; a scalar is an array of one number. Truth values
    and integers in the result are written as numbers. The comment at the head of the file lists all arrays.

    The file allocates no memory, has no variables outside functions, and includes nothing but `<math.h>`.

    Args:
        function: A function of arrays of real numbers, or pytrees of them, that JAX can trace. It returns an array, or
            a pytree of arrays.
        examples: An example of each argument: arrays, numbers, or shapes as `jax.ShapeDtypeStruct`. Only the shapes
            matter.
        name: Name of the C function. The names of all helper functions and tables begin with it.
        real: Type of all numbers, "double" or "float".

    Returns:
        The text of the file, for `gcc -std=c99 -c`.

    Raises:
        LoweringError: The function calls LAPACK or Python, or cannot be written as a graph of scalars for another
            reason; the message names the operation.
        TypeError: An example has entries that are not floating-point numbers.
        ValueError: The name is not valid for a C function, `real` is another type, or the function returns no array.

    Example:
        >>> import jax.numpy as jnp
        >>> import scalargraph
        >>> print(scalargraph.to_c(lambda a, x: a @ x, jnp.zeros((1, 2)), jnp.zeros(2), name="product"))
        /* product: C99 of a JAX function of real numbers.
         *
         * Arguments:
         *   in1[2]  a, shape (1, 2)
         *   in2[2]  x, shape (2,)
         * Results:
         *   out[1]  result, shape (1,)
         *
         * Arrays are contiguous and in row-major order: the last index varies fastest.
         * Results must not overlap arguments.
         */
        #include <math.h>
        <BLANKLINE>
        void product(const double *in1, const double *in2, double *out);
        <BLANKLINE>
        void product(const double *in1, const double *in2, double *out)
        {
            const double v0 = (in1[0] * in2[0]) + (in1[1] * in2[1]);
            out[0] = v0;
        }
        <BLANKLINE>
    """
    check_name(name)
    if real not in get_args(Real):
        raise InputError(f'real is {real!r}; it is "double" or "float"')
    labels = _parameters(function, len(examples))
    shapes = [_shapes(example, label, real) for label, example in zip(labels, examples, strict=True)]
    lowered = lower(function, *shapes, loops="any")
    if not lowered.results:
        raise InputError(f"{name}: the function returns no array, so there is nothing to compute")
    labelled = [pair for label, tree in zip(labels, shapes, strict=True) for pair in _label_arrays(label, tree)]
    ins = _name_arguments("in", labelled)
    outs = _name_arguments("out", _label_arrays("result", jax.tree.unflatten(lowered.tree, lowered.results)))
    arrays = [*(f"const {real} *{array.name}" for array in ins), *(f"{real} *{array.name}" for array in outs)]
    declared = ", ".join(arrays)
    passed = tuple(array.name for array in (*ins, *outs))
    signature = Signature(declared, passed, _entries(ins), _entries(outs))
    text = c_function(lowered, name, signature, real, prefix=f"{name}_")
    helpers = c_helpers(text.helpers, real, prefix=f"{name}_")
    needs_restrict = [RESTRICT_IN_CPP] if "restrict" in f"{helpers}{text.text}" else []
    head = f"{_comment(name, ins, outs)}#include <math.h>\n"
    parts = [head, *needs_restrict, helpers, f"void {name}({declared});\n", text.text]
    return "\n".join(part for part in parts if part)


class _Passed(NamedTuple):
    """An array that is passed to a C function by a pointer: the pointer's name and the array's description."""

    name: str
    label: str
    array: jax.ShapeDtypeStruct


def _parameters(function: Callable, count: int) -> list[str]:
    """The names of the positional arguments of a function, or numbers if Python cannot inspect the function."""
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):  # functions that are not written in Python may have no signature
        return [f"argument {k + 1}" for k in range(count)]
    rest = next((p.name for p in parameters if p.kind is p.VAR_POSITIONAL), "argument")
    known = [p.name for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    return [*known, *(f"{rest}[{k}]" for k in range(count - len(known)))][:count]


def _shapes(example: Any, label: str, real: Real) -> Any:
    """The shapes of the arrays of an example, all with the type of the generated code."""
    dtype = {"double": jnp.float64, "float": jnp.float32}[real]
    # JAX treats None as a pytree without arrays and would skip it without an error.
    for where, leaf in [(label, None)] if example is None else _label_arrays(label, example):
        dtype_of_leaf = getattr(leaf, "dtype", None)
        if not jnp.issubdtype(np.asarray(leaf).dtype if dtype_of_leaf is None else dtype_of_leaf, jnp.floating):
            raise TypeError(
                f"the example of {where} is {leaf!r:.40}, of the type {dtype_of_leaf or type(leaf).__name__}; give "
                "floating-point numbers, and let the function close over everything else"
            )
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(np.shape(leaf), dtype), example)


def _label_arrays(label: str, tree: Any) -> list[tuple[str, Any]]:
    """The arrays of a pytree, each labelled with the keys that lead to it."""
    return [(label + jax.tree_util.keystr(path), leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(tree)]


def _name_arguments(role: str, arrays: Sequence[tuple[str, jax.ShapeDtypeStruct]]) -> list[_Passed]:
    names = [role] if len(arrays) == 1 else [f"{role}{k + 1}" for k in range(len(arrays))]
    return [_Passed(name, *array) for name, array in zip(names, arrays, strict=True)]


def _entries(arrays: Sequence[_Passed]) -> tuple[str, ...]:
    return tuple(f"{name}[{i}]" for name, _, array in arrays for i in range(array.size))


def _comment(name: str, ins: Sequence[_Passed], outs: Sequence[_Passed]) -> str:
    """The comment at the head of the file."""
    lines = [f"{name}: C99 of a JAX function of real numbers.", ""]
    for title, arrays in (("Arguments:", ins), ("Results:", outs)):
        sizes = [f"{each.name}[{each.array.size}]" for each in arrays]
        width = max(map(len, sizes), default=0)
        lines += [title] if arrays else []
        for size, (_, label, array) in zip(sizes, arrays, strict=True):
            lines.append(f"  {size.ljust(width)}  {_plain(label)}, shape {array.shape}{_meaning(array)}")
    lines += ["", "Arrays are contiguous and in row-major order: the last index varies fastest."]
    lines += ["Results must not overlap arguments."]
    return "/* " + "\n".join([lines[0], *(f" * {line}".rstrip() for line in lines[1:])]) + "\n */\n"


def _plain(label: str) -> str:
    """A label that cannot end the comment or its line and that is ASCII: keys of a dictionary may be any text."""
    line = " ".join(label.split()).replace("*/", "* /").replace("/*", "/ *")
    return line.encode("ascii", "backslashreplace").decode()


def _meaning(array: jax.ShapeDtypeStruct) -> str:
    if jnp.issubdtype(array.dtype, jnp.bool_):
        return ", 0 for false and 1 for true"
    return ", whole numbers" if jnp.issubdtype(array.dtype, jnp.integer) else ""
