"""From a JAX function to its graph: the jaxpr interpreted over scalars, loops unrolled.

Integers are whole real numbers: sums and products of them are exact, and operations that are not, such as a division
that rounds, are refused by name, as is every primitive that is not known here. An entry taken at a place that the
arguments decide becomes a choice between all entries it may be, where these are few. Nothing is guessed.
"""

import functools
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core, source_info_util

from covariant.lowering import _stumpff
from covariant.lowering._constants import compute
from covariant.lowering._graph import Condition, Graph

MOST_PLACES = 64
"""Places that an index which depends on the arguments may have."""
EXACT = 2.0**53
"""Whole numbers below this are doubles, each of them."""
MOST_ITERATIONS = 100_000
"""Iterations of a loop that is unrolled, before it counts as endless."""


class LoweringError(NotImplementedError):
    """A function that cannot be written as a graph of scalars: which operation, and why."""


class Scalars(NamedTuple):
    """An array of nodes, by their indices."""

    ids: np.ndarray


Value = Scalars | np.ndarray
"""An array that depends on the arguments, or one whose numbers are known."""


class Lowered(NamedTuple):
    """A function as a graph.

    - `arguments`: shapes of the leaves of the arguments, whose entries are the inputs, in order.
    - `outputs`: nodes of the entries of the results; `results`, `tree`: their leaves, and how these hang together.
    - `conditions`: where the function is defined and does not jump, if it was asked for as one of real numbers.
    """

    graph: Graph
    arguments: tuple[tuple[int, ...], ...]
    outputs: tuple[int, ...]
    results: tuple[jax.ShapeDtypeStruct, ...]
    tree: Any
    conditions: "Conditions | None" = None

    @property
    def inputs(self) -> int:
        """Number of inputs."""
        return sum(math.prod(shape) for shape in self.arguments)

    def nodes(self) -> Any:
        """The function's result with the nodes in the places of their values."""
        left = iter(self.outputs)
        leaves = [np.array([next(left) for _ in range(leaf.size)], int).reshape(leaf.shape) for leaf in self.results]
        return jax.tree.unflatten(self.tree, leaves)

    def rebuild(self, values: Sequence[np.ndarray]) -> Any:
        """The function's result from the values of the outputs, arrays of one batch shape (...)."""
        left = iter(values)
        leaves = []
        for leaf in self.results:
            part = np.array(list(itertools.islice(left, leaf.size)))
            kind = float if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf.dtype
            leaves.append(np.moveaxis(part, 0, -1).reshape((*part.shape[1:], *leaf.shape)).astype(kind))
        return jax.tree.unflatten(self.tree, leaves)


class Conditions(NamedTuple):
    """What must be so wherever a function is defined and does not jump: a graph of its own, and what its nodes mean."""

    graph: Graph
    conditions: tuple[Condition, ...]
    inputs: int

    @classmethod
    def of(cls, graph: Graph, conditions: Sequence[Condition], inputs: int) -> "Conditions":
        """These conditions on nodes of a graph, without what they do not need of it."""
        small, places = graph.pruned([condition.node for condition in conditions])
        noted = tuple(c._replace(node=place) for c, place in zip(conditions, places, strict=True))
        return cls(small, noted, inputs)


def lower(function: Callable, *arguments: Any, real: bool = False) -> Lowered:
    """The graph of a function of arrays of real numbers, at the shapes of the arguments (arrays, or their shapes).

    Its operations are those of `covariant.lowering.FOLD`. With `real` all arguments are real numbers, none of them
    missing (NaN), and the result has `conditions`: where the function is defined and does not jump, for everything that
    it computes, whether a result needs it or not. What rounds by its nature, as a number made shorter, is then refused.

    Raises `LoweringError` naming the primitive that has no graph, such as a factorisation by LAPACK, or a loop whose
    length depends on the arguments.
    """
    closed, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
    graph, position = Graph(real), itertools.count()
    inputs: list[Value] = []
    for aval in closed.in_avals:
        if not jnp.issubdtype(aval.dtype, jnp.floating):
            raise LoweringError(f"an argument of type {aval.dtype} is not a real number; close over it instead")
        ids = [graph.input(next(position)) for _ in range(aval.size)]
        inputs.append(Scalars(np.array(ids, int).reshape(aval.shape)))
    results = _Interpreter(graph).run(closed.jaxpr, closed.consts, inputs)
    ids = [_nodes(graph, value) for value in results]
    leaves, tree = jax.tree.flatten(shape)
    small, outputs = graph.pruned([int(i) for array in ids for i in array.ravel()])
    shapes = tuple(aval.shape for aval in closed.in_avals)
    conditions = Conditions.of(graph, list(graph.conditions.values()), next(position)) if real else None
    return Lowered(small, shapes, tuple(outputs), tuple(leaves), tree, conditions)


def graft(graph: Graph, function: Callable, *arguments: np.ndarray) -> np.ndarray:
    """The nodes of a function's result, an array, whose arguments are nodes of a graph, which grows by it."""
    shapes = [jax.ShapeDtypeStruct(ids.shape, jnp.float64) for ids in arguments]
    closed = jax.make_jaxpr(function)(*shapes)
    (result,) = _Interpreter(graph).run(closed.jaxpr, closed.consts, [Scalars(ids) for ids in arguments])
    return _nodes(graph, result)


def substitute(graph: Graph, nodes: Sequence[int], into: Graph, inputs: Mapping[int, int]) -> list[int]:
    """The nodes of a graph, its inputs having become nodes of another graph, which grows by them."""
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


def _nodes(graph: Graph, value: Value) -> np.ndarray:
    if isinstance(value, Scalars):
        return value.ids
    flat = [graph.constant(v) for v in np.asarray(value).ravel().tolist()]
    return np.array(flat, int).reshape(np.shape(value))


class _Interpreter:
    def __init__(self, graph: Graph):
        self.graph = graph

    def run(self, jaxpr, consts: Sequence, inputs: Sequence[Value]) -> list[Value]:
        """Values of a jaxpr's outputs."""
        known: dict = {}

        def read(atom) -> Value:
            return np.asarray(atom.val) if isinstance(atom, core.Literal) else known[atom]

        known.update(zip(jaxpr.constvars, map(_known, consts), strict=True))
        known.update(zip(jaxpr.invars, inputs, strict=True))
        outer = self.graph.line
        for eqn in jaxpr.eqns:
            self.graph.line = functools.partial(_line, eqn, outer)
            found = self.equation(eqn, [read(atom) for atom in eqn.invars])
            if self.graph.real:
                self.bounded(eqn, found)
            known.update(zip(eqn.outvars, found, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def equation(self, eqn, values: list[Value]) -> list[Value]:
        name, parameters = eqn.primitive.name, eqn.params
        _need_reals(eqn, self.graph.real)
        if name in _CALLS:
            return self.call(parameters[_CALLS[name]], values)
        if name in ("scan", "while", "cond"):
            return getattr(self, name + "_loop")(parameters, values)
        if not any(isinstance(value, Scalars) for value in values):
            return compute(eqn, values)
        if eqn.primitive is _stumpff.STUMPFF:
            return [self.map("stumpff", np.asarray(float(parameters["k"])), *values)]
        if name not in _RULES:
            raise LoweringError(f"the primitive '{name}' has no graph of scalars; write the function without it")
        if name in _NOT_ON_INTEGERS and jnp.issubdtype(eqn.invars[0].aval.dtype, jnp.integer):
            raise LoweringError(f"'{name}' on integers that depend on the arguments has no graph of real numbers")
        return _RULES[name](self, eqn, values)

    def bounded(self, eqn, values: list[Value]) -> None:
        """Note that whole numbers stay within their type, beyond which they would begin again at its other end."""
        for atom, value in zip(eqn.outvars, values, strict=True):
            if isinstance(value, Scalars) and jnp.issubdtype(atom.aval.dtype, jnp.integer):
                limits = jnp.iinfo(atom.aval.dtype)
                self.within(value, max(float(limits.min) - 1, -EXACT), min(float(limits.max) + 1, EXACT))

    def within(self, value: Scalars, low: float, high: float) -> None:
        for node in set(value.ids.ravel().tolist()):
            self.graph.need_between(low, node, high)

    def call(self, inner, values: list[Value]) -> list[Value]:
        closed = inner if hasattr(inner, "jaxpr") else core.ClosedJaxpr(inner, ())
        return self.run(closed.jaxpr, closed.consts, values)

    def scan_loop(self, p: dict, values: list[Value]) -> list[Value]:
        consts, carried = p["num_consts"], p["num_carry"]
        fixed, carry, over = values[:consts], values[consts : consts + carried], values[consts + carried :]
        order = range(p["length"])[:: -1 if p["reverse"] else 1]
        collected: dict[int, list[Value]] = {}
        for i in order:
            found = self.call(p["jaxpr"], [*fixed, *carry, *(_take(value, i) for value in over)])
            carry, collected[i] = found[:carried], found[carried:]
        rows = [collected[i] for i in sorted(collected)]
        empty = [np.zeros(aval.shape) for aval in p["jaxpr"].out_avals[carried:]]
        stacked = [self.stack(list(column)) for column in zip(*rows, strict=True)] if rows else empty
        return [*carry, *stacked]

    def while_loop(self, p: dict, values: list[Value]) -> list[Value]:
        of_condition, of_body = p["cond_nconsts"], p["body_nconsts"]
        condition, body = values[:of_condition], values[of_condition : of_condition + of_body]
        carry = values[of_condition + of_body :]
        for _ in range(MOST_ITERATIONS):
            (go,) = self.call(p["cond_jaxpr"], [*condition, *carry])
            go = self.truth(go)
            if go is None:
                raise LoweringError("a 'while' loop runs until something the arguments decide; give it a fixed length")
            if not go:
                return carry
            carry = self.call(p["body_jaxpr"], [*body, *carry])
        raise LoweringError(f"a 'while' loop of more than {MOST_ITERATIONS} iterations is too long to unroll")

    def cond_loop(self, p: dict, values: list[Value]) -> list[Value]:
        chosen, *rest = values
        if isinstance(chosen, Scalars):
            raise LoweringError("a 'cond' chooses by the arguments; compute both ways and take one by jnp.where")
        index = int(np.clip(int(chosen), 0, len(p["branches"]) - 1))
        return self.call(p["branches"][index], rest)

    def truth(self, value: Value) -> bool | None:
        if not isinstance(value, Scalars):
            return bool(value)
        node = self.graph.nodes[int(value.ids)]
        return bool(node.value) if node.op == "constant" else None

    def stack(self, values: list[Value]) -> Value:
        if not any(isinstance(value, Scalars) for value in values):
            return np.stack(values)
        return Scalars(np.stack([_nodes(self.graph, value) for value in values]))

    def map(self, op: str, *values: Value) -> Scalars:
        """An operation on arrays of one shape, entry by entry."""
        arrays = np.broadcast_arrays(*(_nodes(self.graph, value) for value in values))
        flat = [self.graph.apply(op, *map(int, ids)) for ids in zip(*(a.ravel() for a in arrays), strict=True)]
        return Scalars(np.array(flat, int).reshape(arrays[0].shape))

    def reduce(self, op: str, ids: np.ndarray, axes: Sequence[int]) -> Scalars:
        """An operation over some axes, halves first, which rounds less than one after the other."""
        kept = [axis for axis in range(ids.ndim) if axis not in axes]
        shape = [ids.shape[axis] for axis in kept]
        rows = np.transpose(ids, [*kept, *axes]).reshape(math.prod(shape), math.prod(ids.shape[a] for a in axes))

        def together(row: list[int]) -> int:
            if len(row) < 2:
                return row[0] if row else self.graph.constant(_NEUTRAL[op])
            middle = len(row) // 2
            return self.graph.apply(op, together(row[:middle]), together(row[middle:]))

        return Scalars(np.array([together(row) for row in rows.tolist()], int).reshape(shape))


_NEUTRAL = {"add": 0.0, "mul": 1.0, "and": True, "or": False, "max": -np.inf, "min": np.inf}
"""What nothing sums up to."""


def _need_reals(eqn, real: bool) -> None:
    """Refuse what makes of numbers something else, and where they are `real`, what makes them shorter."""
    name, given = eqn.primitive.name, [atom.aval.dtype for atom in eqn.invars if hasattr(atom.aval, "dtype")]
    made = [atom.aval.dtype for atom in eqn.outvars if hasattr(atom.aval, "dtype")]
    for dtype in made:
        if not any(jnp.issubdtype(dtype, kind) for kind in (jnp.bool_, jnp.integer, jnp.floating)):
            raise LoweringError(f"'{name}' makes {dtype}, which is no real number")
    digits = [[jnp.finfo(t).nmant for t in types if jnp.issubdtype(t, jnp.floating)] for types in (given, made)]
    if real and all(digits) and min(digits[1]) < max(digits[0]):
        raise LoweringError(f"'{name}' makes numbers shorter, to {made[0]}, and is no function of real numbers")


def _line(eqn, outer: Callable[[], str]) -> str:
    """Where in somebody's code an operation was asked for; in a function of JAX's, where that was."""
    place, _, function = source_info_util.summarize(eqn.source_info).partition(" ")
    file, *rest = place.split(":")
    return f"at {':'.join([Path(file).name, *rest[:1]])} {function}".strip() if rest else outer()


def _known(value) -> np.ndarray:
    return np.asarray(value)


def _take(value: Value, i: int) -> Value:
    return Scalars(np.asarray(value.ids[i])) if isinstance(value, Scalars) else np.asarray(value[i])


_CALLS = {
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "core_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "custom_lin": "call_jaxpr",
    "remat2": "jaxpr",
    "checkpoint": "jaxpr",
}
"""Primitives that call a function, and the parameter that holds it."""

Rule = Callable[[_Interpreter, Any, list], list[Value]]


def _entrywise(op: str) -> Rule:
    return lambda run, eqn, values: [run.map(op, *values)]


def _same(run: _Interpreter, eqn, values: list) -> list[Value]:
    return [values[0]]


def _of_ids(run: _Interpreter, eqn, values: list, move: Callable[..., np.ndarray]) -> list[Value]:
    return [Scalars(move(*(_nodes(run.graph, value) for value in values)))]


def _moves(move: Callable[..., np.ndarray]) -> Rule:
    """A primitive that only moves entries: `move(parameters, *ids)` does it with the indices of the nodes."""
    return lambda run, eqn, values: _of_ids(run, eqn, values, functools.partial(move, eqn.params))


def _broadcast(p: dict, ids: np.ndarray) -> np.ndarray:
    sides = [1] * len(p["shape"])
    for axis, side in zip(p["broadcast_dimensions"], ids.shape, strict=True):
        sides[axis] = side
    return np.broadcast_to(ids.reshape(sides), p["shape"])


def _slice(p: dict, ids: np.ndarray) -> np.ndarray:
    strides = p["strides"] or (1,) * ids.ndim
    return ids[tuple(slice(*part) for part in zip(p["start_indices"], p["limit_indices"], strides, strict=True))]


def _places(name: str, p: dict, shapes: Sequence[tuple[int, ...]]) -> tuple[range, list[int]]:
    """Which arguments say where, and how far each of their numbers (the last axis of one) may go."""
    operand = shapes[0]
    if name == "dynamic_slice":
        return range(1, len(shapes)), [a - b for a, b in zip(operand, p["slice_sizes"], strict=True)]
    if name == "dynamic_update_slice":
        return range(2, len(shapes)), [a - b for a, b in zip(operand, shapes[1], strict=True)]
    numbers = p["dimension_numbers"]
    if name == "gather":
        return range(1, 2), [operand[d] - p["slice_sizes"][d] for d in numbers.start_index_map]
    free = [d for d in range(len(operand)) if d not in (*numbers.inserted_window_dims, *numbers.operand_batching_dims)]
    window = dict(zip(free, (shapes[2][k] for k in numbers.update_window_dims), strict=True))
    return range(1, 2), [operand[d] - window.get(d, 1) for d in numbers.scatter_dims_to_operand_dims]


def _at_places(run: _Interpreter, eqn, values: list) -> list[Value]:
    """A primitive that moves entries to or from places, or adds them there: known ones, or a choice of few."""
    name = eqn.primitive.name
    move = _added if name == "scatter-add" else _moved
    where, ends = _places(name, eqn.params, [atom.aval.shape for atom in eqn.invars])
    fills = name == "gather" and eqn.params["mode"] == jax.lax.GatherScatterMode.FILL_OR_DROP
    drops = name.startswith("scatter") and eqn.params["mode"] == jax.lax.GatherScatterMode.FILL_OR_DROP
    places = [_nodes(run.graph, values[i]) for i in where]
    flat = [int(node) for place in places for node in place.ravel()]
    known = [run.graph.nodes[node].value if run.graph.nodes[node].op == "constant" else None for node in flat]

    def moved(numbers: Sequence) -> np.ndarray:
        left, arguments = iter(numbers), []
        for i, value in enumerate(values):
            if i in where:
                shape, dtype = eqn.invars[i].aval.shape, eqn.invars[i].aval.dtype
                arguments.append(np.array([next(left) for _ in range(math.prod(shape))], dtype).reshape(shape))
            else:
                arguments.append(_nodes(run.graph, value))
        return move(run, eqn, arguments)

    if None not in known:
        return [Scalars(moved([value for value in known if value is not None]))]
    reach = [ends[k % len(ends)] for k in range(len(flat))]
    choices = [range(end + 1) if value is None else (value,) for end, value in zip(reach, known, strict=True)]
    count = math.prod(len(choice) for choice in choices)
    if not 0 < count <= MOST_PLACES:
        raise LoweringError(f"'{name}' at one of {count} places that the arguments decide has no graph of scalars")
    if not (fills or drops):  # places out of bounds are brought back
        limits = [(run.graph.constant(0.0), run.graph.constant(end)) for end in reach]
        flat = [
            node if value is not None else run.graph.apply("min", run.graph.apply("max", node, low), high)
            for node, value, (low, high) in zip(flat, known, limits, strict=True)
        ]
    outside = [float(end + 1) for end in reach]
    result = moved([o if v is None else v for o, v in zip(outside, known, strict=True)]) if fills or drops else None
    for combination in itertools.product(*choices):
        here = run.graph.constant(True)
        for node, value, number in zip(flat, known, combination, strict=True):
            if value is None:
                here = run.graph.apply("and", here, run.graph.apply("eq", node, run.graph.constant(number)))
        ids = moved(combination)
        result = (
            ids if result is None else run.map("select", Scalars(np.array(here)), Scalars(ids), Scalars(result)).ids
        )
    assert result is not None
    return [Scalars(result)]


def _extreme(comparison: Callable[[Graph, int, int], int]) -> Rule:
    """The place of the first largest or smallest entry."""

    def rule(run: _Interpreter, eqn, values: list) -> list[Value]:
        (axis,) = eqn.params["axes"]
        rows = np.moveaxis(values[0].ids, axis, -1)
        found = []
        for row in rows.reshape(-1, rows.shape[-1]).tolist():
            best, place = row[0], run.graph.constant(0.0)
            for k, entry in enumerate(row[1:], start=1):
                better = comparison(run.graph, best, entry)
                best = run.graph.apply("select", better, entry, best)
                place = run.graph.apply("select", better, run.graph.constant(float(k)), place)
            found.append(place)
        return [Scalars(np.array(found, int).reshape(rows.shape[:-1]))]

    return rule


def _moved(run: _Interpreter, eqn, arguments: list[np.ndarray]) -> np.ndarray:
    """Nodes moved by the primitive itself, which does not care what the numbers stand for."""
    parameters = dict(eqn.params) | ({"fill_value": -1} if eqn.primitive.name == "gather" else {})
    with jax.ensure_compile_time_eval():
        ids = np.array(eqn.primitive.bind(*map(jnp.asarray, arguments), **parameters))
    ids[ids < 0] = run.graph.constant(float("nan"))  # what a gather out of bounds is filled with
    return ids


def _added(run: _Interpreter, eqn, arguments: list[np.ndarray]) -> np.ndarray:
    operand, places, updates = arguments
    total = operand.ravel().copy()
    for k, node in enumerate(updates.ravel().tolist()):
        # Where one update goes is found by letting it alone be one.
        one = np.zeros(updates.size)
        one[k] = 1.0
        with jax.ensure_compile_time_eval():
            arrays = map(jnp.asarray, (np.zeros(operand.shape), places, one.reshape(updates.shape)))
            goes = np.asarray(eqn.primitive.bind(*arrays, **eqn.params))
        for i in np.flatnonzero(goes.ravel()):
            total[i] = run.graph.apply("add", int(total[i]), node)
    return total.reshape(operand.shape)


def _pad(run: _Interpreter, eqn, values: list) -> list[Value]:
    ids, fill = (_nodes(run.graph, value) for value in values)
    with jax.ensure_compile_time_eval():
        return [Scalars(np.asarray(eqn.primitive.bind(jnp.asarray(ids), jnp.asarray(fill), **eqn.params)))]


def _split(run: _Interpreter, eqn, values: list) -> list[Value]:
    ends = np.cumsum(eqn.params["sizes"])[:-1]
    return [Scalars(part) for part in np.split(values[0].ids, ends, axis=eqn.params["axis"])]


def _dot(run: _Interpreter, eqn, values: list) -> list[Value]:
    (over_a, over_b), (batch_a, batch_b) = eqn.params["dimension_numbers"]
    a, b = (_nodes(run.graph, value) for value in values)

    def arranged(ids, batch, over):
        free = [axis for axis in range(ids.ndim) if axis not in (*batch, *over)]
        sizes = [[ids.shape[axis] for axis in axes] for axes in (batch, free, over)]
        counts = [int(np.prod(size)) for size in sizes]
        return np.transpose(ids, [*batch, *free, *over]).reshape(counts), sizes

    (a, (batch, rows, _)), (b, (_, columns, _)) = arranged(a, batch_a, over_a), arranged(b, batch_b, over_b)
    products = run.map("mul", Scalars(a[:, :, None, :]), Scalars(b[:, None, :, :]))
    total = run.reduce("add", products.ids, [3])
    return [Scalars(total.ids.reshape([*batch, *rows, *columns]))]


def _reduction(op: str) -> Rule:
    return lambda run, eqn, values: [run.reduce(op, values[0].ids, [int(axis) for axis in eqn.params["axes"]])]


def _cumulative(op: str) -> Rule:
    def rule(run: _Interpreter, eqn, values: list) -> list[Value]:
        axis = eqn.params["axis"]
        rows = np.moveaxis(values[0].ids, axis, 0)[:: -1 if eqn.params["reverse"] else 1]
        found = itertools.accumulate(map(np.asarray, rows), lambda a, b: run.map(op, Scalars(a), Scalars(b)).ids)
        stacked = np.stack(list(found))[:: -1 if eqn.params["reverse"] else 1]
        return [Scalars(np.moveaxis(stacked, 0, axis))]

    return rule


def _integer_pow(run: _Interpreter, eqn, values: list) -> list[Value]:
    exponent = eqn.params["y"]
    result: Value = np.ones(values[0].ids.shape)
    power, left = values[0], abs(exponent)
    while left:  # by squaring
        result = run.map("mul", result, power) if left % 2 else result
        left //= 2
        power = run.map("mul", power, power) if left else power
    return [run.map("div", np.array(1.0), result) if exponent < 0 else result]


def _chain(*ops: str) -> Rule:
    """Operations one after the other."""

    def rule(run: _Interpreter, eqn, values: list) -> list[Value]:
        found = run.map(ops[0], *values)
        for op in ops[1:]:
            found = run.map(op, found)
        return [found]

    return rule


def _turned(op: str, negate: bool = False) -> Rule:
    """A comparison with its sides exchanged, or denied."""

    def rule(run: _Interpreter, eqn, values: list) -> list[Value]:
        found = run.map(op, *(values if negate else values[::-1]))
        return [run.map("not", found) if negate else found]

    return rule


def _select(run: _Interpreter, eqn, values: list) -> list[Value]:
    which, *cases = values
    if jnp.issubdtype(eqn.invars[0].aval.dtype, jnp.bool_):
        no, yes = cases
        return [run.map("select", which, yes, no)]
    result = cases[0]
    for k, case in enumerate(cases[1:], start=1):
        result = run.map("select", run.map("eq", which, np.array(float(k))), case, result)
    return [result]


def _clamp(run: _Interpreter, eqn, values: list) -> list[Value]:
    low, x, high = values
    return [run.map("min", run.map("max", x, low), high)]


def _convert(run: _Interpreter, eqn, values: list) -> list[Value]:
    source, target = eqn.invars[0].aval.dtype, eqn.params["new_dtype"]
    kinds = [next(k for k in (jnp.bool_, jnp.integer, jnp.floating) if jnp.issubdtype(t, k)) for t in (source, target)]
    if kinds[0] == jnp.bool_ and kinds[1] != jnp.bool_:
        return [run.map("select", values[0], np.array(1.0), np.array(0.0))]
    if kinds == [jnp.floating, jnp.integer]:  # towards zero
        negative = run.map("lt", values[0], np.array(0.0))
        return [run.map("select", negative, run.map("ceil", values[0]), run.map("floor", values[0]))]
    if kinds == [jnp.integer, jnp.floating] and run.graph.real:  # of which it must be able to tell each
        run.within(values[0], *(sign * 2.0 ** (jnp.finfo(target).nmant + 1) for sign in (-1, 1)))
    if kinds[1] == jnp.bool_ and kinds[0] != jnp.bool_:
        return [run.map("not", run.map("eq", values[0], np.array(0.0)))]
    return [values[0]]


def _shortened(run: _Interpreter, eqn, values: list) -> list[Value]:
    if run.graph.real and eqn.params["mantissa_bits"] < jnp.finfo(eqn.invars[0].aval.dtype).nmant:
        raise LoweringError("'reduce_precision' is no function of real numbers")
    return [values[0]]


def _rounded(run: _Interpreter, eqn, values: list) -> list[Value]:
    if eqn.params["rounding_method"] != jax.lax.RoundingMethod.TO_NEAREST_EVEN:
        raise LoweringError("'round' away from zero has no graph; jnp.round goes to the nearest even number")
    return [run.map("round", values[0])]


def _logistic(run: _Interpreter, eqn, values: list) -> list[Value]:
    below = run.map("add", np.array(1.0), run.map("exp", run.map("neg", values[0])))
    return [run.map("div", np.array(1.0), below)]


def _reciprocal_root(run: _Interpreter, eqn, values: list) -> list[Value]:
    return [run.map("div", np.array(1.0), run.map("sqrt", values[0]))]


def _square(run: _Interpreter, eqn, values: list) -> list[Value]:
    return [run.map("mul", values[0], values[0])]


_ENTRYWISE = (
    "add sub mul div neg abs sign floor ceil min max pow sqrt cbrt log log1p exp expm1 sin cos tan asin acos atan "
    "atan2 sinh cosh tanh asinh acosh atanh lt le eq and or not is_finite"
)
_NOT_ON_INTEGERS = {"div", "pow", "and", "or", "not", "reduce_and", "reduce_or"}
"""Primitives that round on integers, or work on their bits."""
_RULES: dict[str, Rule] = {
    **{name: _entrywise(name) for name in _ENTRYWISE.split()},
    "add_any": _entrywise("add"),
    "gt": _turned("lt"),
    "ge": _turned("le"),
    "ne": _turned("eq", negate=True),
    "round": _rounded,
    "logistic": _logistic,
    "rsqrt": _reciprocal_root,
    "exp2": lambda run, eqn, values: [run.map("pow", np.array(2.0), values[0])],
    "square": _square,
    "integer_pow": _integer_pow,
    "select_n": _select,
    "clamp": _clamp,
    "convert_element_type": _convert,
    "copy": _same,
    "copy_p": _same,
    "stop_gradient": _same,
    "reduce_precision": _shortened,
    "optimization_barrier": lambda run, eqn, values: list(values),
    "broadcast_in_dim": _moves(_broadcast),
    "reshape": _moves(lambda p, ids: ids.reshape(p["new_sizes"])),
    "squeeze": _moves(lambda p, ids: np.squeeze(ids, tuple(p["dimensions"]))),
    "expand_dims": _moves(lambda p, ids: np.expand_dims(ids, tuple(p["dimensions"]))),
    "transpose": _moves(lambda p, ids: np.transpose(ids, p["permutation"])),
    "rev": _moves(lambda p, ids: np.flip(ids, p["dimensions"])),
    "slice": _moves(_slice),
    "concatenate": _moves(lambda p, *ids: np.concatenate(ids, p["dimension"])),
    "split": _split,
    "pad": _pad,
    "dynamic_slice": _at_places,
    "dynamic_update_slice": _at_places,
    "gather": _at_places,
    "scatter": _at_places,
    "argmax": _extreme(lambda graph, best, entry: graph.apply("lt", best, entry)),
    "argmin": _extreme(lambda graph, best, entry: graph.apply("lt", entry, best)),
    "scatter-add": _at_places,
    "dot_general": _dot,
    "reduce_sum": _reduction("add"),
    "reduce_prod": _reduction("mul"),
    "reduce_max": _reduction("max"),
    "reduce_min": _reduction("min"),
    "reduce_and": _reduction("and"),
    "reduce_or": _reduction("or"),
    "cumsum": _cumulative("add"),
    "cumprod": _cumulative("mul"),
    "cummax": _cumulative("max"),
    "cummin": _cumulative("min"),
}
"""What each primitive is in scalars."""
