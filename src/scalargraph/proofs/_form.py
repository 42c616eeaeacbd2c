"""Represents the matrix of a proof as a graph of scalars, with derivatives taken from the graph.

Conditions for contraction contain derivatives of a flow. JAX's derivatives ignore jumps of a `where`, a `sign` or a
table look-up, and trust custom derivative rules. Therefore a proof starts from values: they become a graph, with the
conditions under which they are defined and do not jump, and this graph is differentiated.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from scalargraph import Conditions, Graph, Lowered, lower, numbers, to_jax
from scalargraph._typing import Matrix
from scalargraph.graph import LARGEST, Condition, Derivative, graft, substitute


class Formed(NamedTuple):
    """A matrix as a graph of z (d,), with the conditions under which its parts are defined without jumps.

    Attributes:
        entries: Graph of the entries (n, n).
        conditions: Conditions on z and on further inputs that follow it: variables that are fixed at `pins`.
        pins: Values of these further inputs.

    Example:
        >>> import jax.numpy as jnp
        >>> from scalargraph.proofs import as_form
        >>> formed = as_form(lambda z: jnp.sqrt(z)[:, None]).graph(jnp.zeros(1))
        >>> formed.entries.results[0].shape, len(formed.conditions.conditions), formed.pins.tolist()
        ((1, 1), 1, [])
    """

    entries: Lowered
    conditions: Conditions
    pins: np.ndarray


class Form(NamedTuple):
    """A symmetric matrix of variables z (d,), as a graph of scalars; it can also be evaluated in numbers.

    Attributes:
        graph: Function that returns the graph, with conditions, for the shape of z.

    Example:
        >>> import jax.numpy as jnp
        >>> from scalargraph.proofs import as_form
        >>> form = as_form(lambda z: jnp.array([[2.0 + z[0], 1.0], [1.0, 2.0]]))
        >>> form(jnp.array([1.0])).tolist()
        [[3.0, 1.0], [1.0, 2.0]]
        >>> form.then(lambda matrix: matrix[:1, :1])(jnp.array([1.0])).tolist()
        [[3.0]]
    """

    graph: Callable[[Array], Formed]

    def __call__(self, z: Float[Array, "d"]) -> Matrix:
        return to_jax(self.graph(z).entries)(z)

    def at(self, points: Float[np.ndarray, "k d"]) -> Float[np.ndarray, "k *shape"]:
        """Compute the matrices at many points, in NumPy.

        Args:
            points: The points, one in each row.
        """
        return np.asarray(numbers(self.graph(jnp.asarray(points[0])).entries, points))

    def then(self, formula: Callable[[Array], Array]) -> "Form":
        """The form of a function of this matrix, such as one of its blocks.

        Args:
            formula: JAX function `(n, n) -> (k, k)` of the matrix.
        """
        return self.beside(lambda matrix, z: formula(matrix))

    def beside(self, formula: Callable[[Array, Array], Array]) -> "Form":
        """The form of a function of this matrix and of its variables.

        Args:
            formula: JAX function `((n, n), z (d,)) -> (k, k)`.

        Returns:
            A form with the conditions of this one; conditions of the formula itself are not collected.
        """

        def graph(z):
            formed = self.graph(z)
            grown = Graph.of(formed.entries.graph.nodes)
            place = np.array([grown.input(i) for i in range(formed.entries.inputs)], int)
            entries = graft(grown, formula, formed.entries.nodes(), place)
            return formed._replace(entries=_lower_entries(grown, entries, formed.entries.arguments))

        return Form(graph)


def as_form(matrix: Callable[[Array], Array]) -> Form:
    """Convert a JAX function to a form, with the conditions under which it is defined and does not jump.

    `prove` calls it itself. Use it to see the graph that a proof is about, or the conditions under which it is defined.
    The graph is built when it is first used, so an error in the function appears only then.

    Args:
        matrix: Function `z (d,) -> (n, n)`; a `Form` is returned unchanged.

    Returns:
        The form. Its `graph` raises `LoweringError` if the function has no graph of scalars.

    Example:
        >>> import jax.numpy as jnp
        >>> from scalargraph.proofs import as_form, graph_rows
        >>> formed = as_form(lambda z: jnp.array([[2.0 + z[0]]])).graph(jnp.zeros(1))
        >>> graph_rows(formed.entries)
        {'nodes': [['input', 0], ['constant', 2.0], ['add', 0, 1]], 'outputs': [2]}
    """
    if isinstance(matrix, Form):
        return matrix

    def graph(z):
        # real=True refuses conversions that round, and collects conditions: the proof is about real numbers.
        lowered = lower(matrix, z, real=True)
        assert lowered.conditions is not None
        return Formed(lowered._replace(conditions=None), lowered.conditions, np.zeros(0))

    return Form(graph)


class NodeDerivatives:
    """Derivatives of arrays of nodes of one graph, for the formulas of forms; they are added to the graph.

    Args:
        graph: The graph, which grows.

    Example:
        >>> import numpy as np
        >>> from scalargraph import Graph
        >>> from scalargraph.proofs._form import NodeDerivatives
        >>> graph = Graph()
        >>> x = graph.input(0)
        >>> slope = NodeDerivatives(graph).each(np.array([graph.apply("add", x, x)]), [0])
        >>> slope.shape, graph.nodes[int(slope[0, 0])].value
        ((1, 1), 2.0)
    """

    def __init__(self, graph: Graph):
        self.graph = graph

    def along(self, nodes: np.ndarray, direction: Mapping[int, int]) -> np.ndarray:
        """Derivatives along one direction."""
        return np.vectorize(Derivative(self.graph, direction), otypes=[int])(nodes)

    def each(self, nodes: np.ndarray, inputs: Sequence[int], sides: np.ndarray | None = None) -> np.ndarray:
        """Derivatives with respect to several inputs, or along several directions."""
        one, zero = self.graph.constant(1.0), self.graph.constant(0.0)
        columns = np.where(np.eye(len(inputs), dtype=bool), one, zero) if sides is None else sides
        derivatives = [self.along(nodes, dict(zip(inputs, side, strict=True))) for side in columns.T.tolist()]
        return np.stack(derivatives, axis=-1)


Values = Callable[[Array, Array, Array], tuple[Array, ...]]
"""Functions of time, state and variables, `(t, x (k,), z (d,)) -> arrays`."""
Parts = Callable[[NodeDerivatives, tuple[np.ndarray, ...], int], tuple[np.ndarray, ...]]
"""`(derivatives, nodes of the values, k) -> nodes of the arguments of a formula`; inputs are t, then x (k,), then z."""


def derivative_form(
    values: Values, state: Callable[[Array], Array], parts: Parts, formula: Callable[..., Array]
) -> Form:
    """The form of a matrix that depends on values and their derivatives at x = state(z), t = 0.

    The derivatives are taken from the graph of the values, not from JAX.

    At kinks, such as those of |x|, min and max, the derivatives in intervals contain all values between the one-sided
    derivatives, and therefore Clarke's generalised Jacobian. If all matrices enclosed in this way are positive
    definite,
    an inequality of contraction holds for Lipschitz flows as for smooth ones. The argument: for neighbouring solutions
    x and x + δ, the mean-value theorem (Clarke 1983, Optimization and Nonsmooth Analysis, 2.6.5) gives δ' = Aδ with a
    mean A of Jacobians on the segment between them. The inequality is affine in A, and its margin, which is positive on
    a compact set, outweighs terms of higher order in δ. So sufficiently short chords shrink, and so do all curves, as
    limits of polygons.

    Args:
        values: Functions `(t, x (k,), z (d,)) -> arrays` of time, state and variables.
        state: Function `z (d,) -> x (k,)`, the state at which the matrix is evaluated.
        parts: Function `(derivatives, nodes of the values, k) -> nodes of the arguments of the formula`; inputs are t,
            then x, then z.
        formula: JAX function of these arguments, to a matrix (n, n).

    Returns:
        The form, with the conditions under which the values are defined and do not jump.

    Example:
        >>> import jax.numpy as jnp
        >>> from scalargraph.proofs import box, derivative_form, prove
        >>> flow = lambda t, x, z: (-x - x**3,)  # contracts: −f'(x) = 1 + 3x²
        >>> parts = lambda derivatives, nodes, k: (derivatives.each(nodes[0], range(1, 1 + k)),)
        >>> form = derivative_form(flow, lambda z: z, parts, lambda a: -a)
        >>> prove(form, box(x=(-2.0, 2.0))).verdict
        'holds'
    """

    def graph(z):
        at = lower(state, z)
        value = lower(values, jnp.zeros(()), jnp.zeros(len(at.outputs)), z, real=True)
        grown = Graph.of(value.graph.nodes)
        entries = graft(grown, formula, *parts(NodeDerivatives(grown), value.nodes(), len(at.outputs)))
        return _at_state(value, grown, entries, at)

    return Form(graph)


def _at_state(value: Lowered, grown: Graph, outputs: np.ndarray, at: Lowered) -> Formed:
    """The entries and conditions as functions of z alone, with x = state(z) and t = 0."""
    assert value.conditions is not None
    d, count = at.inputs, len(at.outputs)

    def inputs(into: Graph, embed: Callable[[float], int]) -> dict[int, int]:
        variables = {j: into.input(j) for j in range(d)}
        nodes = [at.graph.nodes[i] for i in at.outputs]
        states = [
            embed(node.value) if node.op == "constant" else substitute(at.graph, [i], into, variables)[0]  # pyright: ignore[reportArgumentType]
            for node, i in zip(nodes, at.outputs, strict=True)
        ]
        return {0: embed(0.0), **dict(enumerate(states, start=1)), **{1 + count + j: variables[j] for j in range(d)}}

    small = Graph()
    entries = np.array(substitute(grown, outputs.ravel().tolist(), small, inputs(small, small.constant)), int)
    # A fixed variable remains an input of the conditions, so that a jump in it is detected.
    free, pins = Graph(), []

    def pinned(number: float) -> int:
        pins.append(number)
        return free.input(d + len(pins) - 1)

    noted = value.conditions
    nodes = substitute(noted.graph, [c.node for c in noted.conditions], free, inputs(free, pinned))
    unmet = [c._replace(node=i) for c, i in zip(noted.conditions, nodes, strict=True) if not _is_met(free, c, i)]
    conditions = Conditions.of(free, unmet, d + len(pins))
    return Formed(_lower_entries(small, entries.reshape(outputs.shape), at.arguments), conditions, np.array(pins))


def _is_met(graph: Graph, condition: Condition, node: int) -> bool:
    """Whether a condition holds whose node has become a constant."""
    if graph.nodes[node].op != "constant":
        return False
    value = graph.nodes[node].value
    # The node of a condition of kind "finite" is a number; the nodes of all others are statements.
    return abs(float(value or 0)) < LARGEST if condition.kind == "finite" else bool(value)


def _lower_entries(graph: Graph, entries: np.ndarray, arguments: tuple[tuple[int, ...], ...]) -> Lowered:
    small, outputs = graph.pruned(entries.ravel().tolist())
    result = jax.ShapeDtypeStruct(entries.shape, jnp.float64)
    return Lowered(small, arguments, tuple(outputs), (result,), jax.tree.structure(result))
