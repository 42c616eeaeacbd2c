"""Differentiates JAX functions by their values, without the derivative rules that a function declares.

JAX follows the rules `stop_gradient`, `custom_jvp` and `custom_vjp`, which may be wrong. A graph contains only the
computation of values, so its derivatives are correct. JAX differentiates a function that has no graph, and the result
is compared with differences of its values.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from scalargraph.graph._arrays import Scalars, Value, nodes_of
from scalargraph.graph._differentiate import Derivative
from scalargraph.graph._graph import FOLD, Graph, no_collection
from scalargraph.graph._jax_forms import Branch, Call, ClosedJaxpr, Scan, While, equations
from scalargraph.graph._jaxpr import Interpreter, trace
from scalargraph.graph._lowered import Lowered, LoweringError
from scalargraph.graph._read import Domain, evaluate
from scalargraph.graph._stumpff import stumpff

LONGEST = 50_000
"""Largest number of operations of a function that is written as a graph; JAX has to compile the derivative graph."""
STEPS = (1e-3, 1e-5, 1e-7)
"""Steps of the difference quotients; a derivative by JAX must agree with the quotient of at least one step."""
AGREES, OF_LARGEST = 1e-4, 1e-8
"""Largest deviation from the difference quotient, relative to the derivative and to the largest derivative."""

_RENAMED = {
    "neg": "negative", "sub": "subtract", "mul": "multiply", "div": "divide", "add": "add", "abs": "abs",
    "round": "rint", "min": "minimum", "max": "maximum", "pow": "power", "asin": "arcsin", "acos": "arccos",
    "atan": "arctan", "atan2": "arctan2", "asinh": "arcsinh", "acosh": "arccosh", "atanh": "arctanh", "lt": "less",
    "le": "less_equal", "eq": "equal", "and": "logical_and", "or": "logical_or", "not": "logical_not",
    "is_finite": "isfinite", "select": "where",
}  # fmt: skip
IN_JAX: Domain = {
    "constant": lambda value: value,
    **{op: getattr(jnp, _RENAMED.get(op, op)) for op in FOLD if op not in ("either", "stumpff")},
    "either": lambda a, b, x, y: jnp.where(jnp.less(a, b), x, y),
    "stumpff": lambda k, x: stumpff(int(k), x),
}
"""The arithmetic of JAX arrays."""


def to_jax(lowered: Lowered) -> Callable:
    """Write a lowered function as a JAX function, without the derivative rules and the state of the original.

    Use it before you give the function to code that traces or differentiates it: each trace then yields the same graph,
    and JAX computes the derivatives of the values.

    Args:
        lowered: The function, without loops.

    Returns:
        A function of the same arguments, flattened to arrays of the shapes `lowered.arguments`.

    Example:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> import scalargraph
        >>> held = lambda x: jax.lax.stop_gradient(x) ** 2
        >>> jax.grad(held)(3.0).item(), jax.grad(scalargraph.to_jax(scalargraph.lower(held, 3.0)))(3.0).item()
        (0.0, 6.0)
    """

    def function(*arguments: Any) -> Any:
        arrays = [jnp.asarray(argument) for argument in arguments]
        inputs = [entry for array in arrays for entry in array.ravel()]
        return _assemble(lowered, evaluate(lowered, IN_JAX, inputs), jnp.result_type(float, *arrays))

    return function


def along(function: Callable, primals: Sequence[Any], tangents: Sequence[Any]) -> tuple[Any, Any]:
    """Compute value and directional derivative of a function, with the arguments of `jax.jvp`.

    Use it wherever a statement needs a derivative: unlike `jax.jvp` it ignores derivative rules that the function
    declares. It works inside `jit` and `vmap`, and may be nested.

    Args:
        function: A function of arrays, whose result is one array.
        primals: Its arguments, arrays of real numbers.
        tangents: The direction, arrays of the same shapes.

    Returns:
        The value, and the derivative in the direction, in the shape of the value.

    Example:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> import scalargraph
        >>> held = lambda x: jax.lax.stop_gradient(x) ** 2
        >>> scalargraph.along(held, (jnp.array(3.0),), (jnp.array(1.0),))[1].item()
        6.0
    """
    primals, tangents = tuple(map(jnp.asarray, primals)), tuple(map(jnp.asarray, tangents))
    try:
        traced = _Traced.of(function, primals)
    except LoweringError:
        return _differentiate_along(function, primals, tangents)
    graph, places = traced.graph, itertools.count(traced.count)
    size = sum(array.size for array in primals)
    # The entries of the direction become further inputs of the graph.
    derivative = Derivative(graph, {i: graph.input(next(places)) for i in range(size)})
    with no_collection():
        outputs = [*traced.outputs, *map(derivative, traced.outputs)]
    value, slope = traced.evaluate(outputs, (*primals, *traced.constants, *tangents), 2)
    return value, slope


def jacobian(function: Callable, x: jax.typing.ArrayLike) -> jax.Array:
    """Compute the Jacobian of a function of one array as `jax.jacfwd` does, but from values as in `along`.

    Args:
        function: A function `x (…) -> array`.
        x: The point, an array of real numbers.

    Returns:
        The derivatives, in the shape of the result followed by that of x.

    Example:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> import scalargraph
        >>> held = lambda x: jax.lax.stop_gradient(x) ** 2
        >>> scalargraph.jacobian(held, jnp.array([1.0, 2.0])).tolist()
        [[2.0, 0.0], [0.0, 4.0]]
    """
    x = jnp.asarray(x)
    directions = jnp.eye(x.size, dtype=x.dtype).reshape(x.size, *x.shape)
    try:
        traced = _Traced.of(function, (x,))
    except LoweringError:
        columns = jax.vmap(lambda d: _differentiate_along(function, (x,), (d,))[1])(directions)
    else:
        graph = traced.graph
        with no_collection():
            slopes = [Derivative(graph, {i: graph.constant(1.0)}) for i in range(x.size)]
            outputs = [slope(node) for slope in slopes for node in traced.outputs]
        parts = traced.evaluate(outputs, (x, *traced.constants), x.size)
        columns = jnp.stack(parts) if x.size else jnp.zeros((0, *traced.result.shape), x.dtype)
    return jnp.moveaxis(columns, 0, -1).reshape(*columns.shape[1:], *x.shape)


def change(function: Callable, *, aux: bool = False) -> tuple[Any, Any]:
    """Compute value and derivative at zero of a function of one number; the function may be too large for a graph.

    JAX computes the derivative. If it differs from the difference quotients at all of `STEPS`, a declared rule is
    wrong, and a difference quotient is returned instead. `along` is more accurate for small functions.

    Args:
        function: A function of a number, of the order of 1, whose result is a pytree of arrays.
        aux: Whether it returns a pair; the second part is not differentiated, and is returned too.

    Returns:
        Value and derivative; with `aux`, value, derivative and the other part.

    Example:
        >>> import jax
        >>> from scalargraph.graph import change
        >>> held = lambda s: jax.lax.stop_gradient(3.0 * s) + 1.0
        >>> value, slope = change(held)
        >>> value.item(), round(slope.item(), 6)
        (1.0, 3.0)
    """
    zero = jnp.zeros(())
    both = function if aux else lambda s: (function(s), ())
    # One loop over all points, so that the function is compiled once.
    stamps = jnp.asarray([0.0, *(sign * step for step in STEPS for sign in (1, -1))])
    values, slopes, others = jax.lax.map(lambda s: jax.jvp(both, (s,), (jnp.ones_like(zero),), has_aux=True), stamps)
    leaves, tree = jax.tree.flatten(values)
    checked = [_confirm_slope(value, slope[0]) for value, slope in zip(leaves, jax.tree.leaves(slopes), strict=True)]
    first = jax.tree.map(lambda leaf: leaf[0], (values, others))
    return (first[0], jax.tree.unflatten(tree, checked), *([first[1]] if aux else []))


def _differentiate_along(function: Callable, primals: Sequence[Any], tangents: Sequence[Any]) -> tuple[Any, Any]:
    """Apply `change` along a line, scaled so that its steps suit the size of the arguments."""
    largest = [jnp.max(jnp.stack([jnp.max(jnp.abs(a), initial=0.0) for a in arrays])) for arrays in (primals, tangents)]
    unit = jnp.maximum(largest[0], 1.0) / jnp.where(largest[1] > 0, largest[1], 1.0)
    value, slope = change(lambda s: function(*(x + s * unit * d for x, d in zip(primals, tangents, strict=True))))
    return value, slope / unit


def _confirm_slope(values: jax.Array, declared: jax.Array) -> jax.Array:
    """Return the derivative by JAX if a quotient confirms it, else the quotient of the middle step."""
    steps = jnp.asarray(STEPS, values.dtype).reshape(-1, *[1] * (values.ndim - 1))
    quotients = (values[1::2] - values[2::2]) / (2 * steps)
    size = jnp.max(jnp.abs(values[0]), initial=0.0)
    # The error of a quotient that a few roundings of the values cause.
    rounding = 16 * jnp.finfo(values.dtype).eps * size / steps
    largest = jnp.max(jnp.abs(declared), initial=0.0)
    most = (AGREES * jnp.abs(declared) + OF_LARGEST * largest)[None] + rounding
    # Each entry may agree at a different step, since steep entries need shorter steps.
    agrees = jnp.any(jnp.abs(quotients - declared[None]) <= most, axis=0)
    return jnp.where(jnp.all(agrees) | ~jnp.all(jnp.isfinite(quotients)), declared, quotients[1])


class _Traced:
    """A function as a graph of its arguments and of the traced numbers that its closure contains."""

    def __init__(self, graph: Graph, outputs: list[int], result: jax.ShapeDtypeStruct, constants: list, count: int):
        self.graph, self.outputs, self.result = graph, outputs, result
        self.constants, self.count = constants, count

    @classmethod
    def of(cls, function: Callable, arguments: Sequence[Any]) -> "_Traced":
        (jaxpr, consts), shape = _trace_function(function, arguments)
        if _count_operations(jaxpr) > LONGEST:
            raise LoweringError("the function has too many operations for a graph of scalars")
        graph, place = Graph(real=True), itertools.count()

        def unknown(array: Any) -> Value:
            if not jnp.issubdtype(array.dtype, jnp.floating):
                raise LoweringError(f"an argument of type {array.dtype} is not a real number")
            ids = [graph.input(next(place)) for _ in range(array.size)]
            return Scalars(np.array(ids, int).reshape(array.shape))

        inputs = [unknown(array) for array in arguments]
        traced = [c for c in consts if isinstance(c, Tracer)]
        known = [unknown(c) if isinstance(c, Tracer) else c for c in consts]
        with no_collection():
            (value,) = Interpreter(graph).run(ClosedJaxpr(jaxpr, known), inputs)
        outputs = nodes_of(graph, value).ravel().tolist()
        if len(graph.nodes) > LONGEST:
            raise LoweringError("the function has too many operations for a graph of scalars")
        return cls(graph, outputs, shape, traced, next(place))

    def evaluate(self, outputs: list[int], arguments: Sequence[Any], parts: int) -> list[jax.Array]:
        """Evaluate the nodes, as `parts` arrays of the shape of the result."""
        small, places = self.graph.pruned(outputs)
        shapes = tuple(array.shape for array in arguments)
        kind = jnp.result_type(*arguments)
        results = tuple(jax.ShapeDtypeStruct(self.result.shape, kind) for _ in range(parts))
        lowered = Lowered(small, shapes, tuple(places), results, jax.tree.structure(results))
        return to_jax(lowered)(*arguments) if parts else []


def _trace_function(function: Callable, arguments: Sequence[Any]) -> tuple[ClosedJaxpr, Any]:
    closed, shape = trace(function, *arguments)
    return ClosedJaxpr(closed.jaxpr, closed.consts), shape


def _count_operations(jaxpr: Any) -> int:
    """Count the scalar results of a jaxpr, over all turns of its loops."""
    total = 0
    for eqn in equations(jaxpr):
        match eqn.form:
            case Scan(body=body, length=turns):
                total += turns * _count_operations(body.jaxpr)
            case Call(body):
                total += _count_operations(body.jaxpr)
            case Branch(bodies):
                total += sum(_count_operations(body.jaxpr) for body in bodies)
            case While():
                raise LoweringError("a 'while' loop runs until something the arguments decide")
            case None:
                total += sum(variable.aval.size for variable in eqn.outvars)
    return total


def _assemble(lowered: Lowered, values: list[Any], kind: Any) -> Any:
    """Assemble the result of a lowered function from its scalars in JAX."""
    remaining, leaves = iter(values), []
    for leaf in lowered.results:
        dtype = kind if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf.dtype
        flat = [jnp.asarray(value, dtype) for value in itertools.islice(remaining, leaf.size)]
        leaves.append(jnp.stack(flat).reshape(leaf.shape) if flat else jnp.zeros(leaf.shape, dtype))
    return jax.tree.unflatten(lowered.tree, leaves)
