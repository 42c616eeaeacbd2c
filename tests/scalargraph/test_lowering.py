"""A graph of scalars gives what JAX gives, with first and second derivatives, or is refused: never a wrong value."""

import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import scalargraph
from scalargraph import LoweringError, evaluate_batch, expand, lower, numbers, on_batches, operations, stumpff
from scalargraph.graph import NUMBERS, equations, pairs
from scalargraph.graph._constants import compute, padded, part_at, updated_at
from scalargraph.graph._loops import MOST_UNROLLED

TABLE = jnp.array([0.5, -1.0, 2.0, 0.3])


def loop(x):
    return jax.lax.fori_loop(0, 4, lambda i, y: y * x[0] + jnp.sin(y) * i, x)


def scanned(x):
    def step(carry, row):
        carry = carry * row + x[1]
        return carry, jnp.stack([carry, row * x[2]])

    return jax.lax.scan(step, x[0], TABLE, reverse=True)[1]


def while_counted(x):
    return jax.lax.while_loop(lambda s: s[0] < 3, lambda s: (s[0] + 1, s[1] * x[2] + s[1] ** 2), (0, x[0]))[1]


def while_in_lanes(x):
    """Each lane of a batch takes its own number of turns."""

    def turn(s):
        return s[0] + 1, s[1] * x[2] + jnp.sin(s[1])

    return jax.vmap(lambda n: jax.lax.while_loop(lambda s: s[0] < n, turn, (0, x[0]))[1])(jnp.array([3, 0, 1])) * x


def custom(x):
    @jax.custom_jvp
    def f(y):
        return jnp.sinh(y)

    f.defjvp(lambda p, t: (f(*p), jnp.cosh(p[0]) * t[0]))
    return f(x[0] * x[1])


def solved(a, b):
    """Gauss' elimination without pivots, written out."""
    for k in range(3):
        b, a = b.at[k].set(b[k] / a[k, k]), a.at[k].set(a[k] / a[k, k])
        for i in (i for i in range(3) if i != k):
            b, a = b.at[i].add(-a[i, k] * b[k]), a.at[i].add(-a[i, k] * a[k])
    return b


def double_pendulum(x):
    """Accelerations of two point masses on rods, by the inverse of the inertia matrix."""
    s, c = jnp.sin(x[1]), jnp.cos(x[1])
    inertia = jnp.array([[3.0, 1.0], [1.0, 1.0]]) + jnp.array([[2.0, 1.0], [1.0, 0.0]]) * c
    forces = s * jnp.stack([x[2] * (2 * x[0] + x[2]), -(x[0] ** 2)]) - jnp.sin(x[:2]) - 0.1 * x[1:]
    (a, b), (_, d) = inertia
    return jnp.stack([d * forces[0] - b * forces[1], a * forces[1] - b * forces[0]]) / (a * d - b * b)


def rotated(x):
    """Rodrigues' formula, by Stumpff's functions."""
    square = x @ x
    return (
        x[::-1] + stumpff(1, square) * jnp.cross(x, x[::-1]) + stumpff(2, square) * jnp.cross(x, jnp.cross(x, x[::-1]))
    )


def integrated(x):
    """Three steps of the classical method of Runge and Kutta."""
    flow = lambda y: jnp.stack([y[1], -jnp.sin(y[0]) * x[2]])  # noqa: E731

    def step(_, y):
        a = flow(y)
        b = flow(y + 0.05 * a)
        c = flow(y + 0.05 * b)
        return y + 0.1 / 6 * (a + 2 * b + 2 * c + flow(y + 0.1 * c))

    return jax.lax.fori_loop(0, 3, step, x[:2])


FUNCTIONS = {
    "polynomial": lambda x: x[0] ** 3 - 2 * x[1] ** 2 * x[2] + 5,
    "division": lambda x: x[0] / (2 + x[1] ** 2) - 1 / (3 + x[2]),
    "negative powers": lambda x: (2 + x[0] ** 2) ** -3 + x[1] ** -1,
    "real power": lambda x: (1.5 + x[0] ** 2) ** 1.7 + (2 + x[1] ** 2) ** x[2],
    "square root": lambda x: jnp.sqrt(1 + x @ x) + jax.lax.rsqrt(2 + x[0] ** 2),
    "cube root": lambda x: jnp.cbrt(2 + x[0] ** 2),
    "exponentials": lambda x: jnp.exp(x[0]) + jnp.expm1(x[1] * x[2]) + jnp.exp2(x[2]),
    "logarithms": lambda x: jnp.log(2 + x[0] ** 2) + jnp.log1p(x[1] ** 2),
    "trigonometry": lambda x: jnp.sin(x[0]) * jnp.cos(x[1]) + jnp.tan(x[2] / 3),
    "inverse trigonometry": lambda x: jnp.arcsin(x[0] / 9) + jnp.arccos(x[1] / 9) + jnp.arctan(x[2]),
    "two-argument arctangent": lambda x: jnp.arctan2(x[0], 3 + x[1] ** 2),
    "hyperbolic functions": lambda x: jnp.sinh(x[0]) + jnp.cosh(x[1]) * jnp.tanh(x[2]),
    "inverse hyperbolic functions": lambda x: jnp.arcsinh(x[0]) + jnp.arccosh(2 + x[1] ** 2) + jnp.arctanh(x[2] / 9),
    "logistic": lambda x: jax.nn.sigmoid(x[0]) + jax.nn.softplus(x[1]),
    "absolute value": lambda x: jnp.abs(x[0]) * x[1] + jnp.sign(x[2]) * x[2] ** 2,
    "minimum and maximum": lambda x: jnp.maximum(x[0], x[1] ** 2) + jnp.minimum(x[2], 0.1) * x[0],
    "clip": lambda x: jnp.clip(x, -0.5, 0.5) @ x,
    "where": lambda x: jnp.where(x > 0, x**2, jnp.sin(x)).sum(),
    "where with a guarded root": lambda x: jnp.where(x[0] > 0, jnp.sqrt(jnp.where(x[0] > 0, x[0], 1.0)), 0.0) * x[1],
    "logic": lambda x: jnp.where((x[0] > 0) & ~(x[1] >= 0.3) | (x[2] != x[0]), x[0] * x[1], x[2] ** 2),
    "rounding": lambda x: x[0] * jnp.floor(3 * x[1]) + jnp.ceil(x[2]) * x[1] + jnp.round(4 * x[0]) * x[2],
    "matrix product": lambda x: jnp.outer(x, x) @ jnp.array([[1.0, 2.0, 0.0], [0.0, 1.0, 3.0], [4.0, 0.0, 1.0]]) @ x,
    "einsum": lambda x: jnp.einsum("ij,kj,k->i", jnp.outer(x, x), jnp.outer(x, jnp.cos(x)), x),
    "batched product": lambda x: jax.vmap(lambda a: jnp.outer(x, x) @ a)(jnp.stack([x, 2 * x])),
    "sums and products": lambda x: jnp.prod(x) + jnp.sum(jnp.outer(x, x), axis=0) @ x + jnp.max(x) * jnp.min(x),
    "means and norms": lambda x: jnp.mean(x) * jnp.linalg.norm(x + 2),
    "running sums": lambda x: jnp.cumsum(x) * jnp.cumprod(x)[::-1],
    "running extremes": lambda x: jax.lax.cummax(x) + jax.lax.cummin(x, reverse=True) * x,
    "moving entries": lambda x: jnp.concatenate([x[::-1], jnp.roll(x, 1)]).reshape(2, 3).T @ jnp.array([1.0, 2.0]),
    "padding": lambda x: jnp.pad(x, (1, 2), constant_values=3.0) * TABLE[0],
    "diagonals": lambda x: jnp.diag(x) @ jnp.diag(jnp.outer(x, x)) + jnp.trace(jnp.outer(x, jnp.sin(x))),
    "setting entries": lambda x: jnp.zeros(4).at[1].set(x[0]).at[jnp.array([1, 3])].add(x[:2] * x[2]),
    "taking entries": lambda x: x[jnp.array([2, 0, 2, 1])] * TABLE,
    "largest entry's place": lambda x: (x**2)[jnp.argmax(x)] + jnp.sin(x)[jnp.argmin(x)],
    "a place of a few": lambda x: TABLE[jnp.clip(jnp.floor(2 + x[0]).astype(int), 0, 3)] * x[1],
    "a slice somewhere": lambda x: jax.lax.dynamic_slice(x, (jnp.argmax(x),), (2,)) @ x[:2],
    "an entry set somewhere": lambda x: x.at[jnp.argmax(x)].set(x[0] * x[1]) @ x,
    "a choice of three": lambda x: jax.lax.select_n(jnp.argmax(x), x[0] ** 2, x[1] * x[0], jnp.sin(x[2])),
    "loop": loop,
    "scan": scanned,
    "counted while": while_counted,
    "while in lanes": while_in_lanes,
    "branch known beforehand": lambda x: jax.lax.cond(True, jnp.sin, jnp.cos, x[0]) * x[1],
    "custom derivative": custom,
    "rematerialised": lambda x: jax.checkpoint(lambda y: jnp.sin(y) * y)(x).sum(),
    "written-out solve": lambda x: solved(jnp.outer(x, x) + 6 * jnp.eye(3), jnp.cos(x)),
    "integration": integrated,
    "cross product": lambda x: jnp.cross(x, jnp.sin(x)),
    "forward dynamics": double_pendulum,
    "rotation": rotated,
}
POINTS = np.random.default_rng(0).normal(size=(5, 3)) * 0.8


def with_derivatives(f, inner):
    return lambda x: (f(x), jax.jacfwd(f)(x), jax.jacfwd(inner(f))(x))


@pytest.mark.core(1)
@pytest.mark.exhaustive(
    *("diagonals", "forward dynamics", "integration", "loop", "rotation", "written"),
)
@pytest.mark.parametrize("name", FUNCTIONS)
def test_value_and_two_derivatives_are_those_of_jax(name):
    # JAX has no reverse derivative of a while loop.
    compare_with_jax(FUNCTIONS[name], jax.jacfwd if "while" in name else jax.jacrev)


def compare_with_jax(f, inner=jax.jacrev):
    function = with_derivatives(f, inner)
    with np.errstate(all="raise"):  # nothing is folded into an infinity unseen
        graph = lower(function, jnp.zeros(3))
    found = numbers(graph, POINTS)
    expected = jax.jit(jax.vmap(function))(jnp.asarray(POINTS))
    for order, (ours, theirs) in enumerate(zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True)):
        scale = 1 + np.abs(theirs).max()
        np.testing.assert_allclose(ours, theirs, rtol=1e-11, atol=1e-12 * scale, err_msg=f"derivative {order}")
        assert ours.dtype == theirs.dtype
    # The graph's own derivatives, a second route: (F, K) and (pairs, K) for JAX's (..., 3) and (..., 3, 3).
    _, first, second = numbers(expand(lower(f, jnp.zeros(3)), range(3), 2), POINTS)
    _, slopes, bends = (np.asarray(leaf) for leaf in jax.tree.leaves(expected))
    rows, columns = np.array(pairs(3)).T
    count = len(POINTS)
    slopes = np.moveaxis(slopes.reshape(count, -1, 3), 2, 1)
    bends = np.moveaxis(bends.reshape(count, -1, 3, 3)[..., rows, columns], 2, 1)
    for ours, theirs in ((first, slopes), (second, bends)):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-10 * (1 + np.abs(theirs).max()))


def test_entries_out_of_bounds_are_no_numbers_and_without_a_derivative():
    """As `jnp.take` fills them; an entry counted from the end is one that is there."""
    function = lambda x: jnp.take(x, jnp.array([1, 3, -1, 7])) * x[0]  # noqa: E731
    graph = lower(lambda x: (function(x), jax.jacfwd(function)(x)), jnp.zeros(3))
    found, expected = numbers(graph, POINTS[0]), (function(POINTS[0]), jax.jacfwd(function)(POINTS[0]))
    jax.tree.map(np.testing.assert_array_equal, found, expected)
    np.testing.assert_array_equal(np.isnan(found[0]), [False, True, False, True])


REFUSED = {
    "lu": lambda x: jnp.linalg.inv(jnp.outer(x, x) + jnp.eye(3)),
    "sort": jnp.sort,
    "erf": jax.scipy.special.erf,
    "while": lambda x: jax.lax.while_loop(lambda y: y[0] < 3, lambda y: y + 1, x),
    "cond": lambda x: jax.lax.cond(x[0] > 0, jnp.sin, jnp.cos, x),
    "div": lambda x: jnp.argmax(x) // 2,
    "dynamic_slice": lambda x: jnp.arange(100.0)[jnp.floor(x[0]).astype(int)],
    "type int64": lambda x: x,
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_has_no_graph_is_refused_by_name(name):
    argument = jnp.arange(3) if name.startswith("type") else jnp.ones(3)
    with pytest.raises(LoweringError, match=name):
        lower(REFUSED[name], argument)


def test_known_numbers_are_folded_zeros_pruned_and_equal_parts_shared():
    def function(x):
        a = jnp.sin(x[0] * x[1])
        return a + jnp.sin(x[1] * x[0]) + 0.0 * jnp.exp(x[2]) + jnp.cos(0.0) * a + TABLE.sum()

    graph = lower(function, jnp.zeros(3)).graph
    assert sorted(node.op for node in graph.nodes) == sorted(
        ["input", "input", "mul", "sin", "add", "add", "add", "constant"]
    )


def test_each_operation_has_a_number_and_folds_like_it():
    assert set(NUMBERS) == {*scalargraph.FOLD, "constant"}
    samples = {"acosh": (1.5,), "select": (True, 0.3, 0.4), "and": (True, False), "or": (True, False), "not": (True,)}
    samples |= {"either": (0.3, -0.7, 1.0, 2.0), "stumpff": (3.0, 0.7)}
    for op, fold in scalargraph.FOLD.items():
        arguments = samples.get(op, (0.3, -0.7))[: fold.nin if isinstance(fold, np.ufunc) else 4]
        graph = scalargraph.Graph()
        folded = graph.nodes[graph.apply(op, *map(graph.constant, arguments))]
        assert folded.op == "constant"
        with np.errstate(all="ignore"):
            np.testing.assert_array_equal(folded.value, NUMBERS[op](*arguments), err_msg=op)


BINARY = ["add", "sub", "mul", "div", "min", "max", "pow", "atan2"]
UNARY = ["neg", "abs", "sqrt", "exp", "log", "sin", "tanh", "floor", "sign"]


@given(st.lists(st.tuples(st.sampled_from(BINARY + UNARY), st.integers(0, 99), st.integers(0, 99)), max_size=12))
@settings(max_examples=200)
def test_simplified_graphs_have_the_values_of_plain_ones(program):
    """Random programs on numbers of all kinds: a graph with inputs agrees with one that was folded from constants."""
    values = np.array([0.7, -1.3, 0.0, 2.0])

    def build(leaf):
        graph = scalargraph.Graph()
        nodes = [leaf(graph, i) for i in range(len(values))] + [graph.constant(c) for c in (0.0, 1.0, -1.0)]
        for op, i, j in program:
            chosen = (nodes[i % len(nodes)], nodes[j % len(nodes)])[: 2 if op in BINARY else 1]
            nodes.append(graph.apply(op, *chosen))
        return scalargraph.Lowered(graph, ((len(values),),), tuple(nodes), (), None)

    symbolic = build(lambda graph, i: graph.input(i))
    folded = build(lambda graph, i: graph.constant(values[i]))
    with np.errstate(all="ignore"):
        found = np.array(scalargraph.evaluate(symbolic, NUMBERS, list(values)), float)
        expected = np.array(scalargraph.evaluate(folded, NUMBERS, list(values)), float)
    # Where plain arithmetic leaves the real numbers, the rules of real numbers say nothing.
    real = np.isfinite(expected)
    clean = np.logical_and.accumulate(real)
    np.testing.assert_allclose(found[clean], expected[clean], rtol=1e-13)


def test_a_batch_is_evaluated_without_a_program_where_the_function_has_a_graph(monkeypatch):
    """Types are those of JAX; a function without a graph goes through JAX."""

    def function(x, y):
        return {"single": (x @ y["y"]).astype(jnp.float32), "below": x[0] < 1.0, "whole": jnp.asarray(3)}

    def factorised(x, y):
        return function(x, y) | {"root": jnp.linalg.cholesky(jnp.eye(2) * jnp.exp(y["y"][0]))}

    arguments = np.arange(6.0).reshape(3, 2), {"y": np.ones((3, 2))}
    expected = jax.vmap(factorised)(*arguments)
    for each in (factorised, function):
        found = evaluate_batch(each, *arguments)
        for name, value in found.items():
            assert type(value) is np.ndarray
            assert value.dtype == expected[name].dtype
            np.testing.assert_allclose(value, expected[name], rtol=1e-6)
        monkeypatch.setattr(jax, "jit", None)  # and the function with a graph does not need it


def contents(graph):
    tables = graph._known, graph._results, graph.conditions, graph._infinite
    return list(graph.nodes), [list(table.items()) for table in tables]


@pytest.mark.parametrize("real", [False, True])
def test_a_graph_cut_back_to_a_mark_grows_as_if_nothing_had_been_added(real):
    def start():
        graph = scalargraph.Graph(real)
        return graph, graph.apply("sin", graph.input(0)), graph.input(1)

    def grow(graph, a, b):
        bound = graph.apply("select", graph.apply("lt", a, b), a, graph.constant(np.inf))
        return graph.apply("div", graph.apply("sub", graph.constant(0.0), graph.apply("mul", a, b)), bound)

    (plain, *_), (graph, a, b) = start(), start()
    mark = graph.mark()
    added = grow(graph, a, b)
    grown = contents(graph)
    graph.rollback(mark)
    assert contents(graph) == contents(plain) != grown
    assert grow(graph, a, b) == added
    assert contents(graph) == grown


def test_an_operation_is_simplified_once():
    """Whatever its result is: another node, a constant, or a new node."""
    graph = scalargraph.Graph()
    x, zero = graph.input(0), graph.constant(0.0)
    for arguments in (("mul", x, zero), ("add", zero, x), ("sin", zero), ("mul", x, x)):
        result, before = graph.apply(*arguments), contents(graph)
        assert graph.apply(*arguments) == result
        assert contents(graph) == before
        assert graph._results[arguments] == result


def test_a_batch_goes_through_at_once_and_a_wrong_number_of_inputs_does_not():
    graph = lower(lambda x, y: {"a": x * y, "b": y.sum()}, jnp.zeros(2), jnp.zeros(2))
    x, y = np.arange(12.0).reshape(2, 3, 2), np.ones((2, 3, 2))
    found = numbers(graph, x, y)
    np.testing.assert_array_equal(found["a"], x)
    assert found["b"].shape == (2, 3)
    with pytest.raises(ValueError, match="4 inputs; got 3"):
        scalargraph.evaluate(graph, NUMBERS, [1.0, 2.0, 3.0])


PADDINGS = (((1, 2, 0), (0, 0, 1)), ((-1, 1, 2), (0, -1, 0)), ((2, -2, 1), (-1, 2, 2)))


@pytest.mark.parametrize("shape", [(3, 2), (1, 4), (0, 2)])
def test_known_numbers_are_padded_and_cut_as_by_jax(shape):
    """Windows that would leave the array are moved to where they fit."""
    value = np.arange(1.0, 1.0 + math.prod(shape)).reshape(shape)
    for config in PADDINGS:
        expected = np.asarray(jax.lax.pad(value, -7.0, config))
        np.testing.assert_array_equal(padded({"padding_config": config}, value, np.array(-7.0)), expected)
    sizes = (min(shape[0], 2), 1)
    for starts in itertools.product(range(-2, 5), repeat=2):
        at = [np.asarray(start) for start in starts]
        expected = np.asarray(jax.lax.dynamic_slice_p.bind(value, *at, slice_sizes=sizes))
        np.testing.assert_array_equal(part_at({"slice_sizes": sizes}, value, *at), expected)
        expected = np.asarray(jax.lax.dynamic_update_slice_p.bind(value, -np.ones(sizes), *at))
        np.testing.assert_array_equal(updated_at({}, value, -np.ones(sizes), *at), expected)


@pytest.mark.parametrize(("rows", "looped"), [(np.eye(6), False), (np.arange(36.0).reshape(6, 6) + 2.5, True)])
def test_a_scan_over_known_rows_is_unrolled_where_that_saves_work(rows, looped):
    """Of rows with zeros and ones, as the links of a robot, each turn keeps what its own row asks for."""

    def turn(x, row):
        return jnp.sin(sum(k * jnp.roll(x, k) * row for k in range(40))), None

    def swept(x):
        return jax.lax.scan(turn, x, jnp.asarray(rows))[0]

    x = np.random.default_rng(0).normal(size=6)
    long, unrolled = (lower(swept, x, loops=loops) for loops in ("long", "unrolled"))
    assert looped == any(node.op == "loop" for node in long.graph.nodes)
    np.testing.assert_allclose(numbers(long, x), numbers(unrolled, x), rtol=1e-9)
    assert operations(long.graph.nodes) <= operations(unrolled.graph.nodes) / MOST_UNROLLED
    # Of turns that were tried and not taken, nothing is left.
    assert len(long.graph.nodes) == len(long.graph.pruned(long.outputs)[0].nodes)


ROWS, BLOCK = np.array([[1], [-1], [3], [1], [4]]), np.array([[0, 1], [2, -1], [3, 3], [1, 2]])
"""Places in an array (4, 3), some of them twice, some of them out of bounds."""
WINDOWS = {
    "rows": (ROWS, ((1,), (0,), (0,)), (1, 3)),
    "columns, which come first": (BLOCK[:, 1:], ((0,), (1,), (1,)), (4, 1)),
    "entries": (BLOCK, ((), (0, 1), (0, 1)), (1, 1)),
    "blocks": (BLOCK, ((1, 2), (), (0, 1)), (2, 2)),
    "one row": (ROWS[0], ((0,), (0,), (0,)), (1, 3)),
    "an entry of each row": (BLOCK[:, 1:], ((), (1,), (1,), (0,), (0,)), (1, 1)),
}
MODES = ("clip", "fill", "promise_in_bounds")


def window_moves(name, mode):
    """`gather`, `scatter` and `scatter-add` of windows, as functions of an array (4, 3) and of updates."""
    places, (windows, without, axes, *batching), sizes = WINDOWS[name]
    if mode == "promise_in_bounds":
        places = np.clip(places, 0, [[4, 3][axis] - sizes[axis] for axis in axes])
    take = jax.lax.GatherDimensionNumbers(windows, without, axes, *batching)
    put = jax.lax.ScatterDimensionNumbers(windows, without, axes, *batching)
    changes = (jax.lax.scatter, jax.lax.scatter_add)
    return [
        lambda x, y: jax.lax.gather(x, places, take, sizes, mode=mode),
        *(lambda x, y, change=change: change(x, places, y, put, mode=mode) for change in changes),
    ]


@pytest.mark.core(5)
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", WINDOWS)
@pytest.mark.parametrize("dtype", [float, int])
def test_windows_of_known_numbers_and_of_nodes_are_those_of_jax(name, mode, dtype):
    x = np.arange(1, 13).reshape(4, 3).astype(dtype)
    moves = window_moves(name, mode)
    y = 100 + np.arange(moves[0](x, None).size).reshape(moves[0](x, None).shape).astype(dtype)
    for move in moves:
        expected = np.asarray(move(x, y))
        closed = jax.make_jaxpr(move)(x, y)
        variables = [*closed.jaxpr.constvars, *closed.jaxpr.invars]
        known = dict(zip(variables, [*closed.consts, x, y], strict=True))
        (equation,) = equations(closed.jaxpr)
        np.testing.assert_array_equal(compute(equation, [known[atom] for atom in equation.invars])[0], expected)
        if dtype is float:
            np.testing.assert_array_equal(numbers(lower(move, x, y), x, y), expected)


def entries(graph) -> int:
    """Nodes of a graph and of the turns of its loops."""
    inner = [each for node in graph.nodes if node.op == "loop" for each in node.value.graphs]
    return len(graph.nodes) + sum(entries(each.graph) for each in inner)


def test_what_is_the_same_in_all_rows_is_given_once_with_and_without_a_graph():
    def plain(a, x):
        return a * jnp.sin(x)

    def without_graph(a, x):
        return jax.lax.while_loop(lambda s: s < x, lambda s: s + a, 0.0 * x)

    for function in (plain, without_graph):
        rows = np.array([0.5, 1.5, 2.5])
        found = on_batches(function, np.array(1.0), np.array(0.0))(np.ones(1), rows)
        np.testing.assert_allclose(found, [float(function(1.0, x)) for x in rows], rtol=1e-14)
