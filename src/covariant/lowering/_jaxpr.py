"""From a JAX function to its graph: the jaxpr interpreted over scalars, with loops unrolled.

Integers are treated as integral real numbers: their sums and products are exact. Operations that are not, such as an
integer division, are refused by name, as is every primitive without a rule. An entry taken at a place that depends on
the arguments becomes a choice between all entries it may be, where these are few. Nothing is guessed.
"""

import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core, source_info_util

from covariant.lowering import _stumpff
from covariant.lowering._arrays import Scalars, Value, Writer, nodes_of
from covariant.lowering._constants import compute
from covariant.lowering._graph import Graph
from covariant.lowering._jax_forms import (
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
from covariant.lowering._loops import loop_of
from covariant.lowering._lowered import Conditions, Lowered, LoweringError
from covariant.lowering._primitives import NOT_ON_INTEGERS, RULES

EXACT = 2.0**53
"""All integers up to this one are doubles."""
MOST_ITERATIONS = 100_000
"""Largest number of iterations of a loop that is unrolled; a longer one is refused."""
LONG = 400
"""Operations of a turn from which a loop of known length is not unrolled."""
Loops = Literal["unrolled", "long", "any"]


class TracedFunction(NamedTuple):
    """A function as its closed jaxpr, and the shapes of its results in their structure."""

    jaxpr: Any
    results: Any


def trace(function: Callable, *arguments: Any) -> TracedFunction:
    """A function of arrays traced at the shapes of the arguments (arrays, or their shapes), once for `lower_traced`."""
    return TracedFunction(*jax.make_jaxpr(function, return_shape=True)(*arguments))


def lower(function: Callable, *arguments: Any, real: bool = False, loops: Loops = "unrolled") -> Lowered:
    """The graph of a function of arrays of real numbers, at the shapes of the arguments (arrays, or their shapes).

    - `real`: all arguments are real numbers, none of them missing (NaN). The result then has `conditions`: where the
      function is defined and does not jump, for everything that it computes, whether a result needs it or not. What
      rounds by its nature, such as conversion to a shorter type, is refused.
    - `loops`: which loops stay loops in the graph, for code: none, so that one whose length the arguments decide is
      refused; "long" ones, whose turns are so much work that they are written once; or "any" of these two kinds. Code
      also looks up slices of known numbers, such as a metric on a grid, in a table.

    Its operations are those of `covariant.lowering.FOLD`. Errors at run time (`equinox.error_if`) are left out of it.
    Raises `LoweringError` naming the primitive that has no
    graph, such as a factorisation by LAPACK, or a loop whose length depends on the arguments.
    """
    return lower_traced(trace(function, *arguments), real, loops)


def lower_traced(traced: TracedFunction, real: bool = False, loops: Loops = "unrolled") -> Lowered:
    """As `lower`, of a function that has been traced."""
    closed, shape = traced
    graph, position = Graph(real), itertools.count()
    inputs: list[Value] = []
    for aval in closed.in_avals:
        if not jnp.issubdtype(aval.dtype, jnp.floating):
            raise LoweringError(f"an argument of type {aval.dtype} is not a real number; close over it instead")
        ids = [graph.input(next(position)) for _ in range(aval.size)]
        inputs.append(Scalars(np.array(ids, int).reshape(aval.shape)))
    results = _Interpreter(graph, loops).run(ClosedJaxpr(closed.jaxpr, closed.consts), inputs)
    ids = [nodes_of(graph, value) for value in results]
    leaves, tree = jax.tree.flatten(shape)
    small, outputs = graph.pruned([int(i) for array in ids for i in array.ravel()])
    shapes = tuple(aval.shape for aval in closed.in_avals)
    conditions = Conditions.of(graph, list(graph.conditions.values()), next(position)) if real else None
    return Lowered(small, shapes, tuple(outputs), tuple(leaves), tree, conditions)


def graft(graph: Graph, function: Callable, *arguments: np.ndarray) -> np.ndarray:
    """Add a function of nodes of a graph to this graph, and return the nodes of its result, an array."""
    shapes = [jax.ShapeDtypeStruct(ids.shape, jnp.float64) for ids in arguments]
    closed = jax.make_jaxpr(function)(*shapes)
    (result,) = _Interpreter(graph).run(ClosedJaxpr(closed.jaxpr, closed.consts), [Scalars(ids) for ids in arguments])
    return nodes_of(graph, result)


def substitute(graph: Graph, nodes: Sequence[int], into: Graph, inputs: Mapping[int, int]) -> list[int]:
    """Nodes of a graph copied into another graph, with given nodes there in place of the inputs."""
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


class _Interpreter:
    """Runs a jaxpr on arrays of nodes: what is known is computed, everything else is added to the graph."""

    def __init__(self, graph: Graph, loops: Loops = "unrolled"):
        self.graph, self.write = graph, Writer(graph, loops != "unrolled")
        self.loops: Loops = loops

    def run(self, body: ClosedJaxpr, inputs: Sequence[Value], replaces: bool = False) -> list[Value]:
        """Values of the outputs of a jaxpr; `replaces`: it stands for a primitive, and has its place in code."""
        known: dict = {}

        def read(atom) -> Value:
            return np.asarray(atom.val) if isinstance(atom, core.Literal) else known[atom]

        known.update(zip(body.jaxpr.constvars, map(np.asarray, body.consts), strict=True))
        known.update(zip(body.jaxpr.invars, inputs, strict=True))
        outer = self.graph.line
        for eqn in equations(body.jaxpr):
            if not replaces:
                self.graph.line = functools.partial(_line, eqn, outer)
            found = self.equation(eqn, [read(atom) for atom in eqn.invars])
            if self.graph.real:
                self.bounded(eqn, found)
            known.update(zip(eqn.outvars, found, strict=True))
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
        """Note the condition that integers stay within the range of their type, beyond which they would wrap around."""
        for atom, value in zip(eqn.outvars, values, strict=True):
            if isinstance(value, Scalars) and jnp.issubdtype(atom.aval.dtype, jnp.integer):
                limits = jnp.iinfo(atom.aval.dtype)
                self.write.within(value, max(float(limits.min) - 1, -EXACT), min(float(limits.max) + 1, EXACT))

    def scan(self, scan: Scan, values: list[Value]) -> list[Value]:
        ends = scan.fixed, scan.fixed + scan.carried
        fixed, carry, over = values[: ends[0]], values[ends[0] : ends[1]], values[ends[1] :]
        of_rows = scan.body.results[scan.carried :]
        if self.loops != "unrolled" and not over and not of_rows and scan.length > 1:
            found = self.counted(scan, fixed, carry)
            if found is not None:
                return found
        order = range(scan.length)[:: -1 if scan.reverse else 1]
        collected: dict[int, list[Value]] = {}
        for i in order:
            found = self.run(scan.body, [*fixed, *carry, *(_take(value, i) for value in over)])
            carry, collected[i] = found[: scan.carried], found[scan.carried :]
        rows = [collected[i] for i in sorted(collected)]
        empty = [np.zeros((0, *aval.shape)) for aval in of_rows]
        stacked = [self.write.stack(list(column)) for column in zip(*rows, strict=True)] if rows else empty
        return [*carry, *stacked]

    def counted(self, scan: Scan, fixed: list[Value], carry: list[Value]) -> list[Value] | None:
        """A scan over nothing as a loop of the graph, or None where a turn is too little work for that."""

        def turn(graph: Graph, values: list[Value]):
            return _Interpreter(graph, self.loops).run(scan.body, values), None

        try:
            return loop_of(self.graph, turn, fixed, carry, scan.length, LONG)
        except LoweringError:  # a turn may need its number, to take an entry at a place
            return None

    def turns(self, loop: While, values: list[Value]) -> list[Value]:
        """A while loop as a loop of the graph."""
        ends = loop.of_condition, loop.of_condition + loop.of_body

        def turn(graph: Graph, values: list[Value]):
            inner = _Interpreter(graph, self.loops)
            condition, body, carry = values[: ends[0]], values[ends[0] : ends[1]], values[ends[1] :]
            (going,) = inner.run(loop.condition, [*condition, *carry])
            return inner.run(loop.body, [*body, *carry]), going

        found = loop_of(self.graph, turn, values[: ends[1]], values[ends[1] :])
        assert found is not None
        return found

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
            moved = self.run(loop.body, [*body, *carry])
            carry = (
                moved if going.all() else [self.write.chosen(going, *pair) for pair in zip(moved, carry, strict=True)]
            )
        raise LoweringError(f"a 'while' loop of more than {MOST_ITERATIONS} iterations is too long to unroll")

    def branch(self, bodies: Sequence[ClosedJaxpr], values: list[Value]) -> list[Value]:
        chosen, *rest = values
        if isinstance(chosen, Scalars):
            sound = [body for body in bodies if not _calls_back(body)]
            if len(sound) == 1 and not self.graph.real:  # `equinox.error_if`: the other branch raises an error
                return self.run(sound[0], rest)
            raise LoweringError("a 'cond' chooses by the arguments; compute both ways and take one by jnp.where")
        return self.run(bodies[int(np.clip(int(chosen), 0, len(bodies) - 1))], rest)


def _calls_back(body: ClosedJaxpr) -> bool:
    """Whether a branch calls Python, as one does that raises an error."""
    return any(eqn.name == "pure_callback" for eqn in equations(body.jaxpr))


def _need_reals(eqn: JaxprEquation, real: bool) -> None:
    """Refuse operations whose results are not numbers and, with `real`, those that shorten numbers."""
    name, given = eqn.name, [atom.aval.dtype for atom in eqn.invars if hasattr(atom.aval, "dtype")]
    made = [atom.aval.dtype for atom in eqn.outvars if hasattr(atom.aval, "dtype")]
    for dtype in made:
        if not _is_real(dtype):
            raise LoweringError(f"'{name}' makes {dtype}, which is no real number")
    digits = [[d for t in types if (d := _digits(t)) is not None] for types in (given, made)]
    if real and all(digits) and min(digits[1]) < max(digits[0]):
        raise LoweringError(f"'{name}' makes numbers shorter, to {made[0]}, and is no function of real numbers")


@functools.cache
def _is_real(dtype) -> bool:
    return any(jnp.issubdtype(dtype, kind) for kind in (jnp.bool_, jnp.integer, jnp.floating))


@functools.cache
def _digits(dtype) -> int | None:
    """Binary digits behind the point of a floating-point type."""
    return jnp.finfo(dtype).nmant if jnp.issubdtype(dtype, jnp.floating) else None


def _line(eqn: JaxprEquation, outer: Callable[[], str]) -> str:
    """The place in the user's code that asked for an operation; for a function inside JAX, that of its caller."""
    place, _, function = source_info_util.summarize(eqn.source_info).partition(" ")
    file, *rest = place.split(":")
    return f"at {':'.join([Path(file).name, *rest[:1]])} {function}".strip() if rest else outer()


def _take(value: Value, i: int) -> Value:
    return Scalars(np.asarray(value.ids[i])) if isinstance(value, Scalars) else np.asarray(value[i])
