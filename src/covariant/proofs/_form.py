"""A matrix of variables in a box that is to be proved positive definite, as a function of numbers and as a graph.

Contraction of a flow involves derivatives. Those of JAX do not see jumps: a `where`, a `sign` or a table look-up has
none, and custom derivative rules are trusted. A proof therefore starts from values alone. They become a graph once,
with the conditions under which they are defined and do not jump, and this graph is differentiated.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._typing import Matrix
from covariant.lowering import LARGEST, Condition, Conditions, Derivative, Graph, Lowered, graft, lower, substitute


class Formed(NamedTuple):
    """A matrix as a graph of z (d,): its entries, and the conditions under which its parts are defined without jumps.

    The conditions have further inputs after z: variables that are held fixed at the numbers `pins`.
    """

    entries: Lowered
    conditions: Conditions
    pins: np.ndarray


class Form(NamedTuple):
    """A symmetric matrix of variables z (d,): `numbers` computes it, `graph` makes its graph for the shape of z."""

    numbers: Callable[[Array], Array]
    graph: Callable[[Array], Formed]

    def __call__(self, z: Float[Array, "d"]) -> Matrix:
        return self.numbers(z)

    def then(self, formula: Callable[[Array], Array]) -> "Form":
        """The form of a formula of the matrix, such as one of its blocks."""
        return self.beside(lambda matrix, z: formula(matrix))

    def beside(self, formula: Callable[[Array, Array], Array]) -> "Form":
        """The form of a formula of the matrix and of z."""

        def graph(z):
            formed = self.graph(z)
            grown = Graph.of(formed.entries.graph.nodes)
            place = np.array([grown.input(i) for i in range(formed.entries.inputs)], int)
            made = graft(grown, formula, formed.entries.nodes(), place)
            return formed._replace(entries=_lowered(grown, made, formed.entries.arguments))

        return Form(lambda z: formula(self.numbers(z), z), graph)


def as_form(matrix: Callable[[Array], Array]) -> Form:
    """A function `z (d,) -> (n, n)` as a form, with the conditions that it is defined and has no jump."""
    if isinstance(matrix, Form):
        return matrix

    def graph(z):
        lowered = lower(matrix, z, real=True)
        assert lowered.conditions is not None
        return Formed(lowered._replace(conditions=None), lowered.conditions, np.zeros(0))

    return Form(matrix, graph)


class NodeDerivatives:
    """Derivatives of arrays of nodes of one graph, for the formulas of forms."""

    def __init__(self, graph: Graph):
        self.graph = graph

    def along(self, nodes: np.ndarray, direction: Mapping[int, int]) -> np.ndarray:
        """Derivatives along a direction: for the position of each input that changes, the node of its change."""
        return np.vectorize(Derivative(self.graph, direction), otypes=[int])(nodes)

    def each(self, nodes: np.ndarray, inputs: Sequence[int], sides: np.ndarray | None = None) -> np.ndarray:
        """Derivatives in each of the inputs (k,), or along the columns of `sides` (k, m); on a new last axis."""
        one, zero = self.graph.constant(1.0), self.graph.constant(0.0)
        columns = np.where(np.eye(len(inputs), dtype=bool), one, zero) if sides is None else sides
        found = [self.along(nodes, dict(zip(inputs, side, strict=True))) for side in columns.T.tolist()]
        return np.stack(found, axis=-1)


Values = Callable[[Array, Array, Array], tuple[Array, ...]]
"""Functions of time, state and variables, `(t, x (k,), z (d,)) -> arrays`."""
Parts = Callable[[NodeDerivatives, tuple[np.ndarray, ...], int], tuple[np.ndarray, ...]]
"""`(derivatives, nodes of the values, k) -> nodes of the arguments of a formula`; inputs are t, then x (k,), then z."""


def derivative_form(
    values: Values, state: Callable[[Array], Array], parts: Parts, formula: Callable[..., Array], numbers: Callable
) -> Form:
    """A formula of values and of their derivatives at x = state(z), t = 0, with the derivatives of the graph.

    At kinks, such as those of |x|, min and max, the derivatives in intervals contain all values between those of both
    sides, and so Clarke's generalised Jacobian. Where all matrices found in this way are positive definite, an
    inequality of contraction holds for Lipschitz flows as for smooth ones. The argument: for neighbouring solutions x
    and x + δ, the mean-value theorem (Clarke 1983, Optimization and Nonsmooth Analysis, 2.6.5) gives δ' = Aδ with a
    mean A of Jacobians on the segment between them. The inequality is affine in A, and its margin, which is positive on
    a compact set, outweighs terms of higher order in δ. So sufficiently short chords shrink, and with them every curve,
    as the limit of polygons.
    """

    def graph(z):
        at = lower(state, z)
        value = lower(values, jnp.zeros(()), jnp.zeros(len(at.outputs)), z, real=True)
        grown = Graph.of(value.graph.nodes)
        made = graft(grown, formula, *parts(NodeDerivatives(grown), value.nodes(), len(at.outputs)))
        return _at_state(value, grown, made, at)

    return Form(numbers, graph)


def _at_state(value: Lowered, grown: Graph, made: np.ndarray, at: Lowered) -> Formed:
    """The entries and conditions as functions of z alone, with x = state(z) and t = 0."""
    assert value.conditions is not None
    d, count = at.inputs, len(at.outputs)

    def inputs(into: Graph, held: Callable[[float], int]) -> dict[int, int]:
        own = {j: into.input(j) for j in range(d)}
        nodes = [at.graph.nodes[i] for i in at.outputs]
        states = [
            held(node.value) if node.op == "constant" else substitute(at.graph, [i], into, own)[0]  # pyright: ignore[reportArgumentType]
            for node, i in zip(nodes, at.outputs, strict=True)
        ]
        return {0: held(0.0), **dict(enumerate(states, start=1)), **{1 + count + j: own[j] for j in range(d)}}

    small = Graph()
    entries = np.array(substitute(grown, made.ravel().tolist(), small, inputs(small, small.constant)), int)
    # A variable that is held fixed is still an input of the conditions, so that a jump in it is found.
    free, pins = Graph(), []

    def pinned(number: float) -> int:
        pins.append(number)
        return free.input(d + len(pins) - 1)

    noted = value.conditions
    nodes = substitute(noted.graph, [c.node for c in noted.conditions], free, inputs(free, pinned))
    kept = [c._replace(node=i) for c, i in zip(noted.conditions, nodes, strict=True) if not _is_met(free, c, i)]
    conditions = Conditions.of(free, kept, d + len(pins))
    return Formed(_lowered(small, entries.reshape(made.shape), at.arguments), conditions, np.array(pins))


def _is_met(graph: Graph, condition: Condition, node: int) -> bool:
    """Whether a condition that has become one on a number is met."""
    if graph.nodes[node].op != "constant":
        return False
    value = graph.nodes[node].value
    return abs(float(value or 0)) < LARGEST if condition.kind == "finite" else bool(value)


def _lowered(graph: Graph, made: np.ndarray, arguments: tuple[tuple[int, ...], ...]) -> Lowered:
    small, outputs = graph.pruned(made.ravel().tolist())
    result = jax.ShapeDtypeStruct(made.shape, jnp.float64)
    return Lowered(small, arguments, tuple(outputs), (result,), jax.tree.structure(result))
