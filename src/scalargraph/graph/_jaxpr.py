"""Lowers a JAX function to a graph: interprets its jaxpr over scalars, with loops unrolled.

Integers are treated as integral real numbers, whose sums and products are exact. Operations that are not exact on them,
such as an integer division, are refused by name, as is every primitive without a rule. An entry at a place that depends
on the arguments becomes a choice among all possible entries, if these are few.
"""

import functools
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core, source_info_util

from scalargraph.graph import _stumpff
from scalargraph.graph._arrays import Scalars, Value, Writer, nodes_of
from scalargraph.graph._constants import compute
from scalargraph.graph._graph import Graph
from scalargraph.graph._jax_forms import (
    Branch,
    Call,
    ClosedJaxpr,
    JaxprEquation,
    Scan,
    While,
    equations,
    expanded,
    need_pure,
)
from scalargraph.graph._loops import LONG, MOST_UNROLLED, Turn, loop_of, operations
from scalargraph.graph._lowered import Conditions, Lowered, LoweringError
from scalargraph.graph._primitives import NOT_ON_INTEGERS, RULES

EXACT = 2.0**53
"""All integers up to this one are exact in doubles."""
MOST_ITERATIONS = 100_000
"""Largest number of iterations of a loop that is unrolled; a longer one is refused."""
Loops = Literal["unrolled", "long", "any"]


class TracedFunction(NamedTuple):
    """A function as its jaxpr, for `lower_traced`.

    Attributes:
        jaxpr: The closed jaxpr.
        results: Shapes of the results, in their pytree.

    Example:
        >>> import jax.numpy as jnp
        >>> import scalargraph
        >>> traced = scalargraph.trace(jnp.sin, jnp.zeros(3))
        >>> traced.results.shape
        (3,)
    """

    jaxpr: Any
    results: Any


def trace(function: Callable, *arguments: Any) -> TracedFunction:
    """Trace a function of arrays, once for several calls of `lower_traced`.

    Args:
        function: A function of arrays, or pytrees of them, that JAX can trace.
        arguments: Arrays, or their shapes as `jax.ShapeDtypeStruct`; values do not matter.

    Example:
        >>> import jax.numpy as jnp
        >>> import scalargraph
        >>> lowered = scalargraph.lower_traced(scalargraph.trace(lambda x: x + 1.0, jnp.array(0.0)))
        >>> float(scalargraph.numbers(lowered, 2.0))
        3.0
    """
    return TracedFunction(*jax.make_jaxpr(function, return_shape=True)(*arguments))


def lower(function: Callable, *arguments: Any, real: bool = False, loops: Loops = "unrolled") -> Lowered:
    """Lower a function of arrays of real numbers to a graph of scalar operations, which `scalargraph.FOLD` lists.

    Run-time checks (`equinox.error_if`) are left out of the graph.

    Use it once for a function, and then generate C, bounds or a count of operations from the result. It works for small
    systems of scalars: a large matrix product gives a node for each scalar operation. Keep `real=False` for code, where
    missing measurements are NaN, and use `real=True` for proofs.

    Args:
        function: A function of arrays, or pytrees of them, that JAX can trace.
        arguments: Arrays, or their shapes as `jax.ShapeDtypeStruct`; values do not matter.
        real: Whether all arguments are real numbers and none of them is missing (NaN). The result then has
            `conditions`, under which every operation of the function is defined and does not jump, whether or not a
            result needs the operation. Operations that round by definition, such as a conversion to a shorter type,
            are refused.
        loops: Which loops stay loops in the graph, for generated code. "unrolled": none; a loop whose length depends on
            the arguments is refused. "long": loops of known length with so much work in each turn that they are written
            once. "any": these, and loops whose length depends on the arguments. With "long" and "any", slices of known
            numbers, such as a metric on a grid, are looked up in a table.

    Raises:
        LoweringError: A primitive has no graph, such as a factorisation by LAPACK, or the length of a loop depends on
            the arguments. The message names it.

    Example:
        >>> import jax.numpy as jnp
        >>> import scalargraph
        >>> lowered = scalargraph.lower(lambda q: jnp.sin(q) * 0.0 + q, jnp.array(0.0))
        >>> [node.op for node in lowered.graph.nodes]  # the product with zero is pruned
        ['input']
    """
    return lower_traced(trace(function, *arguments), real, loops)


def lower_traced(traced: TracedFunction, real: bool = False, loops: Loops = "unrolled") -> Lowered:
    """Lower a function that has been traced, as `lower` does.

    Args:
        traced: The function, from `trace`.
        real: Whether all arguments are real numbers; see `lower`.
        loops: Which loops stay loops in the graph; see `lower`.

    Raises:
        LoweringError: The function has no graph of scalars.

    Example:
        >>> import jax.numpy as jnp
        >>> import scalargraph
        >>> traced = scalargraph.trace(lambda x: jnp.sqrt(x), jnp.array(1.0))
        >>> plain, real = (scalargraph.lower_traced(traced, real=real) for real in (False, True))
        >>> plain.conditions is None, len(real.conditions.conditions)
        (True, 1)
    """
    closed, shape = traced
    graph, position = Graph(real), itertools.count()
    inputs: list[Value] = []
    for aval in closed.in_avals:
        if not jnp.issubdtype(aval.dtype, jnp.floating):
            raise LoweringError(f"an argument of type {aval.dtype} is not a real number; close over it instead")
        ids = [graph.input(next(position)) for _ in range(aval.size)]
        inputs.append(Scalars(np.array(ids, int).reshape(aval.shape)))
    results = Interpreter(graph, loops).run(ClosedJaxpr(closed.jaxpr, closed.consts), inputs)
    ids = [nodes_of(graph, value) for value in results]
    leaves, tree = jax.tree.flatten(shape)
    small, outputs = graph.pruned([int(i) for array in ids for i in array.ravel()])
    shapes = tuple(aval.shape for aval in closed.in_avals)
    conditions = Conditions.of(graph, list(graph.conditions.values()), next(position)) if real else None
    return Lowered(small, shapes, tuple(outputs), tuple(leaves), tree, conditions)


def graft(graph: Graph, function: Callable, *arguments: np.ndarray) -> np.ndarray:
    """Add the operations of a JAX function, applied to nodes of a graph, to that graph.

    Args:
        graph: The graph, which is changed.
        function: A function of arrays that JAX can trace; its result is one array.
        arguments: Integer arrays of nodes of the graph, of the shapes of the arguments.

    Returns:
        The nodes of the result, an integer array of its shape.

    Example:
        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> import scalargraph
        >>> from scalargraph.graph import graft
        >>> graph = scalargraph.Graph()
        >>> x = np.array([graph.input(0), graph.input(1)])
        >>> total = graft(graph, jnp.sum, x)
        >>> graph.nodes[int(total)].op
        'add'
    """
    shapes = [jax.ShapeDtypeStruct(ids.shape, jnp.float64) for ids in arguments]
    closed = jax.make_jaxpr(function)(*shapes)
    (result,) = Interpreter(graph).run(ClosedJaxpr(closed.jaxpr, closed.consts), [Scalars(ids) for ids in arguments])
    return nodes_of(graph, result)


def substitute(graph: Graph, nodes: Sequence[int], into: Graph, inputs: Mapping[int, int]) -> list[int]:
    """Copy nodes of a graph into another graph, replacing the inputs by nodes of that graph.

    Args:
        graph: The graph to copy from.
        nodes: Nodes to copy, with everything that they depend on.
        into: The graph to copy into, which is changed.
        inputs: For the position of each input that occurs, a node of `into`.

    Returns:
        The copied nodes, as indices in `into`.

    Example:
        >>> import scalargraph
        >>> from scalargraph.graph import substitute
        >>> graph, other = scalargraph.Graph(), scalargraph.Graph()
        >>> sine = graph.apply("sin", graph.input(0))
        >>> (value,) = substitute(graph, [sine], other, {0: other.constant(0.0)})
        >>> other.nodes[value].value  # sin 0, folded
        0.0
    """
    small, outputs = graph.pruned(nodes)
    place: list[int] = []
    for node in small.nodes:
        if node.op == "input":
            place.append(inputs[node.value])  # pyright: ignore[reportArgumentType]
        elif node.op == "constant":
            place.append(into.constant(node.value))  # pyright: ignore[reportArgumentType]
        else:
            place.append(into.apply(node.op, *(place[a] for a in node.arguments)))
    return [place[i] for i in outputs]


class Interpreter:
    """Runs a jaxpr on arrays of nodes: computes what is known, and adds all other operations to the graph."""

    def __init__(self, graph: Graph, loops: Loops = "unrolled"):
        self.graph, self.write = graph, Writer(graph, loops != "unrolled")
        self.loops: Loops = loops

    def run(self, body: ClosedJaxpr, inputs: Sequence[Value], replaces: bool = False) -> list[Value]:
        """Outputs of a jaxpr. With `replaces` it stands for a primitive, and its nodes get the primitive's line."""
        known: dict = {}

        def read(atom) -> Value:
            return np.asarray(atom.val) if isinstance(atom, core.Literal) else known[atom]

        consts = (c if isinstance(c, Scalars) else np.asarray(c) for c in body.consts)
        known.update(zip(body.jaxpr.constvars, consts, strict=True))
        known.update(zip(body.jaxpr.invars, inputs, strict=True))
        outer = self.graph.line
        for eqn in equations(body.jaxpr):
            if not replaces:
                self.graph.line = functools.partial(_line, eqn, outer)
            outputs = self.equation(eqn, [read(atom) for atom in eqn.invars])
            if self.graph.real:
                self.bounded(eqn, outputs)
            known.update(zip(eqn.outvars, outputs, strict=True))
        return [read(atom) for atom in body.jaxpr.outvars]

    def equation(self, eqn: JaxprEquation, values: list[Value]) -> list[Value]:
        _need_reals(eqn, self.graph.real)
        match eqn.form:
            case Call(body, replaces):
                return self.run(body, values, replaces)
            case Scan():
                return self.scan(eqn.form, values)
            case While():
                return self.while_loop(eqn.form, values)
            case Branch(bodies):
                return self.branch(bodies, values)
        need_pure(eqn)
        if not any(isinstance(value, Scalars) for value in values):
            return compute(eqn, values)
        if eqn.primitive is _stumpff.STUMPFF:
            return [self.write.map("stumpff", np.asarray(float(eqn.params["k"])), *values)]
        if eqn.name not in RULES:
            return self.run(expanded(eqn).body, values, replaces=True)
        if eqn.unknown is not None:
            raise LoweringError(f"'{eqn.name}' with the parameter '{eqn.unknown}' has no graph of scalars")
        if eqn.name in NOT_ON_INTEGERS and jnp.issubdtype(eqn.invars[0].aval.dtype, jnp.integer):
            raise LoweringError(f"'{eqn.name}' on integers that depend on the arguments has no graph of real numbers")
        return RULES[eqn.name](self.write, eqn, values)

    def bounded(self, eqn, values: list[Value]) -> None:
        """Note the condition that integers stay within the range of their type; beyond it they would wrap around."""
        for atom, value in zip(eqn.outvars, values, strict=True):
            if isinstance(value, Scalars) and jnp.issubdtype(atom.aval.dtype, jnp.integer):
                limits = jnp.iinfo(atom.aval.dtype)
                # `within` is strict, so the bounds are the first integers beyond the type, and at most what doubles
                # resolve.
                self.write.within(value, max(float(limits.min) - 1, -EXACT), min(float(limits.max) + 1, EXACT))

    def scan(self, scan: Scan, values: list[Value]) -> list[Value]:
        ends = scan.fixed, scan.fixed + scan.carried
        fixed, carry, over = values[: ends[0]], values[ends[0] : ends[1]], values[ends[1] :]
        if self.loops == "unrolled" or scan.body.results[scan.carried :] or scan.length < 2:
            unrolled = self.unrolled(scan, fixed, carry, over)
            assert unrolled is not None
            return unrolled
        if any(not isinstance(value, Scalars) for value in over):
            # Turns over known rows, such as the links of a robot, may differ in their zeros and ones. Unrolled turns
            # use this to save operations; a loop cannot.
            mark = self.graph.mark()
            unrolled = self.unrolled(scan, fixed, carry, over, MOST_UNROLLED * self.operations_of_turn(scan, fixed))
            if unrolled is not None:
                return unrolled
            self.graph.rollback(mark)
        looped = self.counted(scan, fixed, carry, over)
        if looped is None:
            looped = self.unrolled(scan, fixed, carry, over)
            assert looped is not None
        return looped

    def unrolled(
        self, scan: Scan, fixed: list[Value], carry: list[Value], over: list[Value], most: float = np.inf
    ) -> list[Value] | None:
        """A scan, turn by turn; None if turns have more than `most` operations on average."""
        # A reversed scan visits the last row first and still stacks its results in the order of the rows.
        order = range(scan.length)[:: -1 if scan.reverse else 1]
        collected: dict[int, list[Value]] = {}
        begin = len(self.graph.nodes)
        for turn, i in enumerate(order, 1):
            outputs = self.run(scan.body, [*fixed, *carry, *(_take(value, i) for value in over)])
            carry, collected[i] = outputs[: scan.carried], outputs[scan.carried :]
            # The first turn is often the shortest, as it starts from zeros, so it alone decides nothing.
            if turn > 1 and operations(self.graph.nodes[begin:]) > turn * most:
                return None
        rows = [collected[i] for i in sorted(collected)]
        empty = [np.zeros((0, *aval.shape)) for aval in scan.body.results[scan.carried :]]
        stacked = [self.write.stack(list(column)) for column in zip(*rows, strict=True)] if rows else empty
        return [*carry, *stacked]

    def operations_of_turn(self, scan: Scan, fixed: list[Value]) -> float:
        """Operations of a turn written as a loop, which knows only the fixed numbers; infinite if it cannot be one."""
        graph, position = Graph(), itertools.count()

        def unknown(shape: tuple[int, ...]) -> Scalars:
            ids = [graph.input(next(position)) for _ in range(math.prod(shape))]
            return Scalars(np.array(ids, int).reshape(shape))

        shapes = [atom.aval.shape for atom in scan.body.jaxpr.invars]
        values = [value if not isinstance(value, Scalars) else unknown(value.ids.shape) for value in fixed]
        try:
            Interpreter(graph, self.loops).run(scan.body, [*values, *map(unknown, shapes[scan.fixed :])])
        except LoweringError:  # a turn needs a number that is known only if the loop is unrolled
            return math.inf
        return operations(graph.nodes)

    def counted(
        self, scan: Scan, fixed: list[Value], carry: list[Value], over: list[Value] | None = None
    ) -> list[Value] | None:
        """A scan as a loop of the graph; None if a turn is too little work for that.

        A turn reads the first row and moves it behind the others, so that the next turn finds its row in first place.
        """
        rows, count = over or [], scan.fixed + scan.carried
        if scan.reverse:
            rows = [_reverse_rows(value) for value in rows]

        def turn(graph: Graph, values: list[Value]):
            left = values[count:]
            now = [*values[:count], *(_take(value, 0) for value in left)]
            results = Interpreter(graph, self.loops).run(scan.body, now)
            return [*results, *(_rotate_rows(value) for value in left)], None

        types = [atom.aval.dtype for atom in scan.body.jaxpr.invars]
        try:
            outputs = self.loop(turn, types, fixed, [*carry, *rows], scan.length, LONG)
        except LoweringError:  # a turn may need the number of the turn, for example as an index
            return None
        return None if outputs is None else outputs[: scan.carried]

    def loop(
        self,
        turn: Turn,
        types: Sequence[Any],
        fixed: list[Value],
        carry: list[Value],
        count: int | None = None,
        least: int = 0,
    ) -> list[Value] | None:
        """Add a loop to the graph. A loop passes numbers only, so a statement is passed as 0 or 1; see `loop_of`."""
        of_truth = [np.dtype(dtype).kind == "b" for dtype in types]

        def turned(graph: Graph, values: list[Value]):
            inner = Writer(graph)
            results, going = turn(graph, [_statement(inner, *pair) for pair in zip(values, of_truth, strict=True)])
            return [_number(inner, *pair) for pair in zip(results, of_truth[len(fixed) :], strict=True)], going

        numbers = [_number(self.write, *pair) for pair in zip([*fixed, *carry], of_truth, strict=True)]
        outputs = loop_of(self.graph, turned, numbers[: len(fixed)], numbers[len(fixed) :], count, least)
        if outputs is None:
            return None
        return [_statement(self.write, *pair) for pair in zip(outputs, of_truth[len(fixed) :], strict=True)]

    def turns(self, loop: While, values: list[Value]) -> list[Value]:
        """A while loop as a loop of the graph."""
        ends = loop.of_condition, loop.of_condition + loop.of_body

        def turn(graph: Graph, values: list[Value]):
            inner = Interpreter(graph, self.loops)
            condition, body, carry = values[: ends[0]], values[ends[0] : ends[1]], values[ends[1] :]
            (going,) = inner.run(loop.condition, [*condition, *carry])
            return inner.run(loop.body, [*body, *carry]), going

        types = [atom.aval.dtype for body in (loop.condition, loop.body) for atom in body.jaxpr.invars]
        # Condition and body both list the types of the carried values; one of the two lists is dropped.
        types = [*types[: ends[0]], *types[len(loop.condition.jaxpr.invars) :]]
        outputs = self.loop(turn, types, values[: ends[1]], values[ends[1] :])
        assert outputs is not None
        return outputs

    def while_loop(self, loop: While, values: list[Value]) -> list[Value]:
        ends = loop.of_condition, loop.of_condition + loop.of_body
        condition, body, carry = values[: ends[0]], values[ends[0] : ends[1]], values[ends[1] :]
        for _ in range(MOST_ITERATIONS):
            (go,) = self.run(loop.condition, [*condition, *carry])
            going = self.write.truth(go)  # one for each lane of a batch
            if going is None and self.loops == "any":
                return self.turns(loop, [*condition, *body, *carry])
            if going is None:
                raise LoweringError("a 'while' loop runs until something the arguments decide; give it a fixed length")
            if not going.any():
                return carry
            advanced = self.run(loop.body, [*body, *carry])
            if not going.all():
                advanced = [self.write.chosen(going, *pair) for pair in zip(advanced, carry, strict=True)]
            carry = advanced
        raise LoweringError(f"a 'while' loop of more than {MOST_ITERATIONS} iterations is too long to unroll")

    def branch(self, bodies: Sequence[ClosedJaxpr], values: list[Value]) -> list[Value]:
        chosen, *rest = values
        if isinstance(chosen, Scalars):
            pure = [body for body in bodies if not _calls_back(body)]
            if len(pure) == 1 and not self.graph.real:  # `equinox.error_if`: the other branch raises an error
                return self.run(pure[0], rest)
            if self.loops != "unrolled" and len(pure) == len(bodies) == 2:
                return self.choice(chosen, bodies, rest)
            raise LoweringError("a 'cond' chooses by the arguments; compute both ways and take one by jnp.where")
        # JAX clips the index of a branch, too.
        return self.run(bodies[int(np.clip(int(chosen), 0, len(bodies) - 1))], rest)

    def choice(self, chosen: Scalars, bodies: Sequence[ClosedJaxpr], values: list[Value]) -> list[Value]:
        """One of two branches: the longer one as a loop of at most one turn, or both and a choice of the results.

        As a loop it costs nothing when the other branch is taken, but the time of a step then varies.
        """
        long = int(len(bodies[1].jaxpr.eqns) >= len(bodies[0].jaxpr.eqns))
        short = self.run(bodies[1 - long], values)
        # The index is a truth value, or an integer that JAX clips to 0 or 1; 0.5 separates the two branches.
        asked = self.write.map("lt", *((np.asarray(0.5), chosen) if long else (chosen, np.asarray(0.5))))
        if self.loops == "any":
            types = [atom.aval.dtype for atom in bodies[long].jaxpr.invars]
            results = [aval.dtype for aval in bodies[long].results]

            def turn(graph: Graph, inputs: list[Value]):
                once, going = Writer(graph), inputs[len(values)]
                outputs = Interpreter(graph, self.loops).run(bodies[long], inputs[: len(values)])
                return [np.zeros(()), *outputs], once.map("lt", np.asarray(0.5), going)

            go = self.write.map("select", asked, np.asarray(1.0), np.asarray(0.0))
            outputs = self.loop(turn, [*types, float, *results], values, [go, *short], None, LONG)
            if outputs is not None:
                return outputs[1:]
        taken = self.run(bodies[long], values)
        return [
            self.write.map("select", asked, *pair)
            if any(isinstance(v, Scalars) for v in pair) or _differ(*pair)
            else pair[0]
            for pair in zip(taken, short, strict=True)
        ]


def _calls_back(body: ClosedJaxpr) -> bool:
    """Whether a branch calls Python, as a branch that raises an error does."""
    return any(eqn.name == "pure_callback" for eqn in equations(body.jaxpr))


def _need_reals(eqn: JaxprEquation, real: bool) -> None:
    """Refuse operations whose results are not numbers and, with `real`, conversions to shorter types."""
    name, sources = eqn.name, [atom.aval.dtype for atom in eqn.invars if hasattr(atom.aval, "dtype")]
    targets = [atom.aval.dtype for atom in eqn.outvars if hasattr(atom.aval, "dtype")]
    for dtype in targets:
        if not _is_real(dtype):
            raise LoweringError(f"'{name}' makes {dtype}, which is no real number")
    digits = [[d for t in types if (d := _digits(t)) is not None] for types in (sources, targets)]
    if real and all(digits) and min(digits[1]) < max(digits[0]):
        raise LoweringError(f"'{name}' makes numbers shorter, to {targets[0]}, and is no function of real numbers")


@functools.cache
def _is_real(dtype) -> bool:
    return any(jnp.issubdtype(dtype, kind) for kind in (jnp.bool_, jnp.integer, jnp.floating))


@functools.cache
def _digits(dtype) -> int | None:
    """Number of binary digits after the point of a floating-point type."""
    return jnp.finfo(dtype).nmant if jnp.issubdtype(dtype, jnp.floating) else None


def _line(eqn: JaxprEquation, outer: Callable[[], str]) -> str:
    """The line of the user's code that called for an operation; for a function inside JAX, the line of its caller."""
    place, _, function = source_info_util.summarize(eqn.source_info).partition(" ")
    file, *rest = place.split(":")
    return f"at {':'.join([Path(file).name, *rest[:1]])} {function}".strip() if rest else outer()


def _differ(a: Value, b: Value) -> bool:
    return not np.array_equal(a, b, equal_nan=True)  # pyright: ignore[reportArgumentType]


def _statement(write: Writer, value: Value, is_truth: bool) -> Value:
    """A number 0 or 1 as a statement, if it was one before it entered the loop."""
    if not is_truth:
        return value
    return write.map("lt", np.asarray(0.5), value) if isinstance(value, Scalars) else np.asarray(value) > 0.5


def _number(write: Writer, value: Value, is_truth: bool) -> Value:
    """A statement as the number 0 or 1."""
    if not is_truth:
        return value
    if isinstance(value, Scalars):
        return write.map("select", value, np.asarray(1.0), np.asarray(0.0))
    return np.asarray(value, float)


def _reverse_rows(value: Value) -> Value:
    return Scalars(value.ids[::-1]) if isinstance(value, Scalars) else np.asarray(value)[::-1]


def _rotate_rows(value: Value) -> Value:
    """The rows in rotated order: the first one becomes the last."""
    return Scalars(np.roll(value.ids, -1, 0)) if isinstance(value, Scalars) else np.roll(value, -1, 0)


def _take(value: Value, i: int) -> Value:
    return Scalars(np.asarray(value.ids[i])) if isinstance(value, Scalars) else np.asarray(value[i])
