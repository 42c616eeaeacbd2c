"""Translates each primitive of JAX into operations on scalars of a graph.

Every rule receives a `Writer`, an equation of the jaxpr and the values of its inputs, at least one of which depends on
the arguments of the function. It returns the values of the outputs.
"""

import functools
import itertools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from scalargraph.graph._arrays import Scalars, Value, Writer, nodes_of
from scalargraph.graph._constants import padded
from scalargraph.graph._graph import Graph
from scalargraph.graph._jax_forms import JaxprEquation
from scalargraph.graph._loops import LONG, MOST_UNROLLED, loop_of
from scalargraph.graph._lowered import LoweringError
from scalargraph.graph._places import at_places

FEW_ROWS = 2
"""Products with at most this number of rows are never written as loops over the rows."""
Rule = Callable[[Writer, JaxprEquation, list], list[Value]]


def _entrywise(op: str) -> Rule:
    return lambda write, eqn, values: [write.map(op, *values)]


def _same(write: Writer, eqn: JaxprEquation, values: list) -> list[Value]:
    return list(values)


def _of_ids(write: Writer, eqn: JaxprEquation, values: list, move: Callable[..., np.ndarray]) -> list[Value]:
    return [Scalars(move(*(nodes_of(write.graph, value) for value in values)))]


def _rearrangement(move: Callable[..., np.ndarray]) -> Rule:
    """Rule of a primitive that only moves entries: `move(parameters, *ids)` moves the indices of the nodes."""
    return lambda write, eqn, values: _of_ids(write, eqn, values, functools.partial(move, eqn.params))


def _broadcast(p: dict, ids: np.ndarray) -> np.ndarray:
    sides = [1] * len(p["shape"])
    for axis, side in zip(p["broadcast_dimensions"], ids.shape, strict=True):
        sides[axis] = side
    return np.broadcast_to(ids.reshape(sides), p["shape"])


def _slice(p: dict, ids: np.ndarray) -> np.ndarray:
    strides = p["strides"] or (1,) * ids.ndim
    return ids[tuple(slice(*part) for part in zip(p["start_indices"], p["limit_indices"], strides, strict=True))]


def _extreme(comparison: Callable[[Graph, int, int], int]) -> Rule:
    """Rule for the index of the largest or smallest entry, the first one of equal entries."""

    def rule(write: Writer, eqn: JaxprEquation, values: list) -> list[Value]:
        (axis,) = eqn.params["axes"]
        rows = np.moveaxis(values[0].ids, axis, -1)
        indices = []
        for row in rows.reshape(-1, rows.shape[-1]).tolist():
            best, place = row[0], write.graph.constant(0.0)
            for k, entry in enumerate(row[1:], start=1):
                # The comparison is strict, so that the first of several equal entries counts, as in JAX.
                better = comparison(write.graph, best, entry)
                best = write.graph.apply("select", better, entry, best)
                place = write.graph.apply("select", better, write.graph.constant(float(k)), place)
            indices.append(place)
        return [Scalars(np.array(indices, int).reshape(rows.shape[:-1]))]

    return rule


def _split_nodes(write: Writer, eqn: JaxprEquation, values: list) -> list[Value]:
    ends = np.cumsum(eqn.params["sizes"])[:-1]
    return [Scalars(part) for part in np.split(values[0].ids, ends, axis=eqn.params["axis"])]


def _dot(write: Writer, eqn: JaxprEquation, values: list) -> list[Value]:
    (over_a, over_b), (batch_a, batch_b) = eqn.params["dimension_numbers"]
    a, b = (nodes_of(write.graph, value) for value in values)

    def arranged(ids, batch, over):
        free = [axis for axis in range(ids.ndim) if axis not in (*batch, *over)]
        sizes = [[ids.shape[axis] for axis in axes] for axes in (batch, free, over)]
        counts = [int(np.prod(size)) for size in sizes]
        return np.transpose(ids, [*batch, *free, *over]).reshape(counts), sizes

    (a, (batch, rows, _)), (b, (_, columns, _)) = arranged(a, batch_a, over_a), arranged(b, batch_b, over_b)
    if write.tables and len(a) == 1 and 2 * b.size >= LONG:
        return [Scalars(_by_rows(write, a[0], b[0]).reshape([*rows, *columns]))]
    return [Scalars(_products(write, a, b).reshape([*batch, *rows, *columns]))]


def _products(write: Writer, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The nodes (..., m, n) of the product of a (..., m, k) and b (..., n, k)."""
    products = write.map("mul", Scalars(a[..., :, None, :]), Scalars(b[..., None, :, :]))
    # Sums by halving, whose rounding errors grow with the logarithm of the length.
    return write.reduce("add", products.ids, [a.ndim]).ids


def _by_rows(write: Writer, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The nodes (m, n) of a product; rows of a with entries at the same places become turns of a loop if that pays."""
    graph = write.graph
    nonzero_a, nonzero_b = (~np.vectorize(graph.is_zero, otypes=[bool])(ids) for ids in (a, b))
    groups: dict[bytes, list[int]] = {}
    for i, row in enumerate(nonzero_a):
        groups.setdefault(row.tobytes(), []).append(i)
    result = np.empty((len(a), len(b)), int)
    for group in groups.values():
        places = np.flatnonzero(nonzero_a[group[0]])
        some_a, some_b = a[group][:, places], b[:, places]
        dense = np.mean(nonzero_b[:, places]) > MOST_UNROLLED if some_b.size else False
        looped = dense and len(group) > FEW_ROWS and 2 * some_b.size >= LONG
        result[group] = _row_by_row(graph, some_a, some_b) if looped else _products(write, a[group], b)
    return result


def _row_by_row(graph: Graph, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The nodes (m, n) of the product of a (m, k) and b (n, k), with a turn of a loop for each row of a."""

    def turn(inner: Graph, values: list[Value]) -> tuple[list[Value], None]:
        fixed, left, done = (nodes_of(inner, value) for value in values)
        row = _products(Writer(inner), left[:1], fixed)
        # Rows are rotated so that the next turn finds its row first; after the last turn the results are in order.
        return [Scalars(np.roll(left, -1, 0)), Scalars(np.concatenate([done[1:], row]))], None

    start = np.full((len(a), len(b)), graph.constant(0.0))
    done = loop_of(graph, turn, [Scalars(b)], [Scalars(a), Scalars(start)], len(a), all_change=True)
    assert done is not None
    return nodes_of(graph, done[1])


def _reduction(op: str) -> Rule:
    return lambda write, eqn, values: [write.reduce(op, values[0].ids, [int(axis) for axis in eqn.params["axes"]])]


def _any(write: Writer, eqn: JaxprEquation, values: list) -> list[Value]:
    return [write.reduce("or", values[0].ids, range(values[0].ids.ndim))]


def _cumulative(op: str) -> Rule:
    def rule(write: Writer, eqn: JaxprEquation, values: list) -> list[Value]:
        axis = eqn.params["axis"]
        rows = np.moveaxis(values[0].ids, axis, 0)[:: -1 if eqn.params["reverse"] else 1]
        partial = itertools.accumulate(map(np.asarray, rows), lambda a, b: write.map(op, Scalars(a), Scalars(b)).ids)
        stacked = np.stack(list(partial))[:: -1 if eqn.params["reverse"] else 1]
        return [Scalars(np.moveaxis(stacked, 0, axis))]

    return rule


def _integer_pow(write: Writer, eqn: JaxprEquation, values: list) -> list[Value]:
    exponent = eqn.params["y"]
    result: Value = np.ones(values[0].ids.shape)
    power, remaining = values[0], abs(exponent)
    while remaining:  # exponentiation by squaring
        result = write.map("mul", result, power) if remaining % 2 else result
        remaining //= 2
        power = write.map("mul", power, power) if remaining else power
    return [write.map("div", np.array(1.0), result) if exponent < 0 else result]


def _swap_sides(op: str, negate: bool = False) -> Rule:
    """Rule of a comparison with its sides exchanged, or negated."""

    def rule(write: Writer, eqn: JaxprEquation, values: list) -> list[Value]:
        truth = write.map(op, *(values if negate else values[::-1]))
        return [write.map("not", truth) if negate else truth]

    return rule


def _select(write: Writer, eqn: JaxprEquation, values: list) -> list[Value]:
    which, *cases = values
    if jnp.issubdtype(eqn.invars[0].aval.dtype, jnp.bool_):
        no, yes = cases
        return [write.map("select", which, yes, no)]
    result = cases[0]
    for k, case in enumerate(cases[1:], start=1):
        result = write.map("select", write.map("eq", which, np.array(float(k))), case, result)
    return [result]


def _clamp(write: Writer, eqn: JaxprEquation, values: list) -> list[Value]:
    low, x, high = values
    return [write.map("min", write.map("max", x, low), high)]


def _convert(write: Writer, eqn: JaxprEquation, values: list) -> list[Value]:
    source, target = eqn.invars[0].aval.dtype, eqn.params["new_dtype"]
    kinds = [next(k for k in (jnp.bool_, jnp.integer, jnp.floating) if jnp.issubdtype(t, k)) for t in (source, target)]
    if kinds[0] == jnp.bool_ and kinds[1] != jnp.bool_:
        return [write.map("select", values[0], np.array(1.0), np.array(0.0))]
    if kinds == [jnp.floating, jnp.integer]:  # towards zero
        negative = write.map("lt", values[0], np.array(0.0))
        return [write.map("select", negative, write.map("ceil", values[0]), write.map("floor", values[0]))]
    if kinds == [jnp.integer, jnp.floating] and write.graph.real:  # the type must represent every integer exactly
        write.within(values[0], *(sign * 2.0 ** (jnp.finfo(target).nmant + 1) for sign in (-1, 1)))
    if kinds[1] == jnp.bool_ and kinds[0] != jnp.bool_:
        return [write.map("not", write.map("eq", values[0], np.array(0.0)))]
    return [values[0]]


def _reduce_precision(write: Writer, eqn: JaxprEquation, values: list) -> list[Value]:
    if write.graph.real and eqn.params["mantissa_bits"] < jnp.finfo(eqn.invars[0].aval.dtype).nmant:
        raise LoweringError("'reduce_precision' is no function of real numbers")
    return [values[0]]


def _round_to_even(write: Writer, eqn: JaxprEquation, values: list) -> list[Value]:
    if eqn.params["rounding_method"] != jax.lax.RoundingMethod.TO_NEAREST_EVEN:
        raise LoweringError("'round' away from zero has no graph; jnp.round goes to the nearest even number")
    return [write.map("round", values[0])]


def _logistic(write: Writer, eqn: JaxprEquation, values: list) -> list[Value]:
    below = write.map("add", np.array(1.0), write.map("exp", write.map("neg", values[0])))
    return [write.map("div", np.array(1.0), below)]


def _mirror_upper(write: Writer, eqn: JaxprEquation, values: list) -> list[Value]:
    """The first matrix; if the second matrix has symmetric nodes, with the first one's upper triangle mirrored down."""
    matrix, source = (nodes_of(write.graph, value) for value in values)
    if not np.array_equal(source, source.swapaxes(-1, -2)):
        return [values[0]]
    upper = np.triu(np.ones(matrix.shape[-2:], bool))
    return [Scalars(np.where(upper, matrix, matrix.swapaxes(-1, -2)))]


_ENTRYWISE = (
    "add sub mul div neg abs sign floor ceil min max pow sqrt cbrt log log1p exp expm1 sin cos tan asin acos atan "
    "atan2 sinh cosh tanh asinh acosh atanh lt le eq and or not is_finite"
)
NOT_ON_INTEGERS = {"div", "pow", "and", "or", "not", "reduce_and", "reduce_or"}
"""Primitives that would round if applied to integers, or act on their bits."""
RULES: dict[str, Rule] = {
    **{name: _entrywise(name) for name in _ENTRYWISE.split()},
    "add_any": _entrywise("add"),
    "gt": _swap_sides("lt"),
    "ge": _swap_sides("le"),
    "ne": _swap_sides("eq", negate=True),
    "round": _round_to_even,
    "logistic": _logistic,
    "rsqrt": lambda write, eqn, values: [write.map("div", np.array(1.0), write.map("sqrt", values[0]))],
    "exp2": lambda write, eqn, values: [write.map("pow", np.array(2.0), values[0])],
    "square": lambda write, eqn, values: [write.map("mul", values[0], values[0])],
    "integer_pow": _integer_pow,
    "select_n": _select,
    "clamp": _clamp,
    "convert_element_type": _convert,
    "mirrored": _mirror_upper,
    "copy": _same,
    "copy_p": _same,
    "stop_gradient": _same,
    "reduce_precision": _reduce_precision,
    "optimization_barrier": _same,
    "broadcast_in_dim": _rearrangement(_broadcast),
    "reshape": _rearrangement(lambda p, ids: ids.reshape(p["new_sizes"])),
    "squeeze": _rearrangement(lambda p, ids: np.squeeze(ids, tuple(p["dimensions"]))),
    "expand_dims": _rearrangement(lambda p, ids: np.expand_dims(ids, tuple(p["dimensions"]))),
    "transpose": _rearrangement(lambda p, ids: np.transpose(ids, p["permutation"])),
    "rev": _rearrangement(lambda p, ids: np.flip(ids, p["dimensions"])),
    "slice": _rearrangement(_slice),
    "concatenate": _rearrangement(lambda p, *ids: np.concatenate(ids, p["dimension"])),
    "split": _split_nodes,
    "pad": _rearrangement(padded),
    "dynamic_slice": at_places,
    "dynamic_update_slice": at_places,
    "gather": at_places,
    "scatter": at_places,
    "argmax": _extreme(lambda graph, best, entry: graph.apply("lt", best, entry)),
    "argmin": _extreme(lambda graph, best, entry: graph.apply("lt", entry, best)),
    "scatter-add": at_places,
    "dot_general": _dot,
    "reduce_sum": _reduction("add"),
    "reduce_prod": _reduction("mul"),
    "reduce_max": _reduction("max"),
    "reduce_min": _reduction("min"),
    "reduce_and": _reduction("and"),
    "reduce_or": _reduction("or"),
    "unvmap_any": _any,  # of `equinox.error_if`
    "cumsum": _cumulative("add"),
    "cumprod": _cumulative("mul"),
    "cummax": _cumulative("max"),
    "cummin": _cumulative("min"),
}
"""The rule of each primitive."""
