"""Evaluates a graph in any arithmetic that has its operations, such as numbers or intervals."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from scalargraph.errors import InputError
from scalargraph.graph._graph import FOLD, Graph
from scalargraph.graph._jaxpr import lower
from scalargraph.graph._loops import Repetition
from scalargraph.graph._lowered import Lowered, LoweringError

Domain = Mapping[str, Callable[..., Any]]
"""An arithmetic: a function for each operation of `FOLD`, and `constant`, which converts a number or truth value."""

NUMBERS: Domain = {"constant": lambda value: value, **FOLD}
"""The arithmetic of numbers; it also works on NumPy arrays, so that a whole batch is evaluated at once."""


def evaluate(lowered: Lowered, domain: Domain, inputs: Sequence[Any]) -> list[Any]:
    """Evaluate a lowered function in an arithmetic.

    Use it to evaluate a graph in another arithmetic, such as intervals, strings or operation counts. An arithmetic is
    a mapping from names of operations to functions. For numbers alone the JAX function is faster, and for rigorous
    bounds `enclose` is faster.

    Args:
        lowered: The function.
        domain: The arithmetic, such as `NUMBERS` or `INTERVALS`.
        inputs: Value of each scalar input, in this arithmetic.

    Returns:
        Value of each scalar output, in the order of `lowered.outputs`.

    Raises:
        ValueError: The number of inputs differs from the function's.

    Example:
        >>> import jax.numpy as jnp
        >>> import scalargraph
        >>> from scalargraph.graph import NUMBERS
        >>> total = scalargraph.lower(lambda x: jnp.sum(x), jnp.zeros(2))
        >>> float(scalargraph.evaluate(total, NUMBERS, [1.0, 2.0])[0])
        3.0
        >>> text = {"add": "({} + {})".format}  # an arithmetic on strings
        >>> scalargraph.evaluate(total, text, ["a", "b"])
        ['(a + b)']
    """
    if len(inputs) != lowered.inputs:
        raise InputError(f"the graph has {lowered.inputs} inputs; got {len(inputs)}")
    return evaluate_nodes(lowered.graph, lowered.outputs, domain, inputs)


def evaluate_nodes(graph: Graph, outputs: Sequence[int], domain: Domain, inputs: Sequence[Any]) -> list[Any]:
    """Evaluate some nodes of a graph in an arithmetic; values are released after their last use, to save memory."""
    nodes = graph.nodes
    last = [-1] * len(nodes)
    for i, node in enumerate(nodes):
        for a in node.arguments:
            last[a] = i
    # Outputs are read at the very end, so they are never released.
    for i in outputs:
        last[i] = len(nodes)
    values: list[Any] = [None] * len(nodes)
    for i, node in enumerate(nodes):
        if node.op == "input":
            values[i] = inputs[node.value]  # pyright: ignore[reportArgumentType, reportCallIssue]
        elif node.op == "constant":
            values[i] = domain["constant"](node.value)
        else:
            operands = [values[a] for a in node.arguments]
            if node.op == "part":
                values[i] = operands[0][node.value]
            elif node.op == "table":
                values[i] = node.value.at(operands[0])  # pyright: ignore[reportOptionalMemberAccess]
            else:
                values[i] = _run_loop(node.value, domain, operands) if node.op == "loop" else domain[node.op](*operands)
            for a in node.arguments:
                if last[a] == i:
                    values[a] = None
    return [values[i] for i in outputs]


def _run_loop(loop: Repetition, domain: Domain, values: Sequence[Any]) -> list[Any]:
    """Values carried by a loop after its last turn; lanes of a batch that have ended wait for the others."""
    fixed, carried = list(values[: loop.fixed]), list(values[loop.fixed :])
    if loop.going is None:
        for _ in range(loop.turns or 0):
            carried = evaluate(loop.body, domain, [*fixed, *carried])
        return carried
    while np.any(going := evaluate(loop.going, domain, [*fixed, *carried])[0]):
        advanced = evaluate(loop.body, domain, [*fixed, *carried])
        carried = [domain["select"](going, new, old) for new, old in zip(advanced, carried, strict=True)]
    return carried


def numbers(lowered: Lowered, *arguments: Any) -> Any:
    """Evaluate a lowered function in double precision by NumPy.

    Args:
        lowered: The function.
        arguments: Its arguments as arrays or pytrees of them, all with the same leading batch axes (...), which may be
            absent.

    Returns:
        The result of the function, with the batch axes first. Undefined operations give NaN or infinity, as in NumPy,
        without a warning.

    Example:
        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> import scalargraph
        >>> total = scalargraph.lower(lambda x: jnp.sum(x), jnp.zeros(2))
        >>> scalargraph.numbers(total, np.array([[1.0, 2.0], [3.0, 4.0]])).tolist()  # a batch of two
        [3.0, 7.0]
    """
    leaves = [np.asarray(leaf, float) for leaf in jax.tree.leaves(arguments)]
    inputs = [entry for leaf, shape in zip(leaves, lowered.arguments, strict=True) for entry in _entries(leaf, shape)]
    with np.errstate(all="ignore"):
        values = evaluate(lowered, NUMBERS, inputs)
    batch = np.broadcast_shapes(*(np.shape(entry) for entry in inputs)) if inputs else ()
    return lowered.rebuild(values, batch)


def on_batches(function: Callable, *arguments: Any) -> Callable:
    """Make a JAX function work on batches: NumPy evaluates its graph, or JAX the function if it has no graph.

    JAX compiles a program first, which takes seconds for a function of a robot; the graph is ready in a tenth of that.
    For some thousand values the compilation would be most of the time. For far more evaluations compile instead.

    Args:
        function: The function. It is unrolled, so it must have no long loops.
        arguments: Its arguments as arrays or pytrees of them; only shapes and types matter.

    Returns:
        A function of arguments with one leading batch axis (B, ...) each, or (1, ...) for an argument that is the same
        for all. It returns the results of the function with the batch axis first, as arrays of NumPy of the types that
        JAX gives them.

    Example:
        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> import scalargraph
        >>> sums = scalargraph.on_batches(lambda x: {"sum": jnp.sum(x)}, np.zeros(2))
        >>> sums(np.array([[1.0, 2.0], [3.0, 4.0]]))["sum"].tolist()
        [3.0, 7.0]
    """
    try:
        lowered = lower(function, *arguments)
    except LoweringError:
        compiled = jax.jit(jax.vmap(function))
        return lambda *batch: jax.tree.map(np.asarray, compiled(*_of_one_length(batch)))
    results = jax.tree.unflatten(lowered.tree, lowered.results)
    return lambda *batch: jax.tree.map(lambda leaf, like: leaf.astype(like.dtype), numbers(lowered, *batch), results)


def evaluate_batch(function: Callable, *batch: Any) -> Any:
    """Evaluate a JAX function at one batch of arguments, as `on_batches` does.

    Args:
        function: The function. It is unrolled, so it must have no long loops.
        batch: Its arguments as arrays or pytrees of them, all with one leading batch axis (B, ...).

    Returns:
        The result of the function, with the batch axis first, as arrays of NumPy of the types that JAX gives them.

    Example:
        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> import scalargraph
        >>> scalargraph.evaluate_batch(lambda x: jnp.sum(x), np.array([[1.0, 2.0], [3.0, 4.0]])).tolist()
        [3.0, 7.0]
    """
    return on_batches(function, *jax.tree.map(lambda leaf: leaf[0], batch))(*batch)


def _of_one_length(batch: tuple) -> tuple:
    """The arguments with all batch axes extended to the length of the longest."""
    longest = max((np.shape(leaf)[0] for leaf in jax.tree.leaves(batch)), default=1)
    return jax.tree.map(lambda leaf: np.broadcast_to(leaf, (longest, *np.shape(leaf)[1:])), batch)


def _entries(leaf: np.ndarray, shape: tuple[int, ...]) -> list[np.ndarray]:
    """The scalars of a leaf, each with its batch axes."""
    batch = leaf.shape[: leaf.ndim - len(shape)]
    return [np.asarray(entry) for entry in np.moveaxis(leaf.reshape(*batch, -1), -1, 0)]
