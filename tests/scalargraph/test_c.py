"""C of a graph computes what the graph says, and its text is the same everywhere."""

import ctypes
import math
import shutil
import subprocess
from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scalargraph import FOLD, Graph, Lowered, LoweringError, c_function, c_helpers, c_number, c_rows, lower, numbers
from scalargraph.c import simplified

FLAGS = "-std=c99 -O1 -Wall -Wextra -Wpedantic -Wconversion -Wdouble-promotion -Werror -ffp-contract=off"
TYPES = {"double": np.float64, "float": np.float32}
COMPILER = shutil.which("cc")
pytestmark = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler, `cc`")

ONE = "neg abs sign floor ceil round sqrt cbrt exp expm1 log log1p sin cos tan asin acos atan sinh cosh tanh asinh"
ONE = (ONE + " acosh atanh is_finite").split()
TWO = ["add", "sub", "mul", "div", "min", "max", "pow", "atan2", "lt", "le", "eq"]
EDGES = [0.0, -0.0, 1.0, -1.0, 0.5, -2.5, 3.5, math.pi, -math.pi, 20 * math.pi, 1e-300, 1e300]
EDGES += [math.inf, -math.inf, math.nan]


def graph_of(write, inputs: int) -> Lowered:
    """The function that `write(graph, nodes of the inputs) -> nodes of the results` makes."""
    graph = Graph()
    outputs = write(graph, [graph.input(i) for i in range(inputs)])
    result = jax.ShapeDtypeStruct((len(outputs),), float)
    return Lowered(graph, ((inputs,),), tuple(outputs), (result,), jax.tree.structure(0))


def load(text: str, folder, name: str, *flags: str) -> ctypes.CDLL:
    """A library of a file of C that is compiled on its own, with all warnings as errors."""
    (folder / f"{name}.c").write_text(text)
    options = [*FLAGS.split(), *flags, "-fPIC", "-shared"]
    subprocess.run([COMPILER, *options, f"{name}.c", "-o", f"{name}.so", "-lm"], cwd=folder, check=True)
    return ctypes.CDLL(str(folder / f"{name}.so"))


def compiled(lowered: Lowered, folder, real="double", **options):
    """The C function as one of NumPy arrays, and its text."""
    text = c_function(lowered, "f", real=real, **options)
    source = f"#include <math.h>\n{c_helpers(text.helpers, real)}\nvoid f(const {real} *x, {real} *y);\n{text.text}"
    library, dtype = load(source, folder, "f"), TYPES[real]

    def call(x):
        x, y = np.array(x, dtype), np.empty(len(lowered.outputs), dtype)
        library.f(*(a.ctypes.data_as(ctypes.c_void_p) for a in (x, y)))
        return y

    return call, source


def in_lanes(lowered: Lowered, folder, real="double", lanes=8, **options):
    """The C function in lanes, as one of rows in NumPy arrays."""
    library = load(c_rows(lowered, "rows", lanes, real, **options), folder, "lanes", "-Wno-psabi")

    def call(rows):
        x, y = np.array(rows, TYPES[real]), np.empty((len(rows), len(lowered.outputs)), TYPES[real])
        library.rows(*(a.ctypes.data_as(ctypes.c_void_p) for a in (x, y)), ctypes.c_longlong(len(x)))
        return y

    return call


GRID = np.random.default_rng(3).normal(size=(9, 12, 2))


def test_known_numbers_are_looked_up_at_any_place_and_clipped_to_where_they_are(tmp_path):
    def corner(x):
        start = (jnp.floor(x[0]).astype(int), jnp.round(x[1]).astype(int), jnp.zeros((), int))
        return jax.lax.dynamic_slice(jnp.asarray(GRID), start, (2, 3, 2)) * x[0]

    with pytest.raises(LoweringError, match="at one of 80 places"):
        lower(corner, jnp.zeros(2))
    lowered = lower(corner, jnp.zeros(2), loops="long")
    assert sum(node.op == "table" for node in lowered.graph.nodes) == 12
    points = np.random.default_rng(4).uniform(-3, 14, (200, 2))
    expected = jax.vmap(corner)(points)
    np.testing.assert_array_equal(numbers(lowered, points), expected)
    function, text = compiled(lowered, tmp_path)
    assert text.count("static const double") == 1
    np.testing.assert_array_equal([function(point) for point in points], np.reshape(expected, (200, -1)))
    np.testing.assert_array_equal(in_lanes(lowered, tmp_path)(points), np.reshape(expected, (200, -1)))
    known = lower(lambda x: corner(jnp.array([2.5, 7.0])) * x, jnp.zeros(()), loops="long")
    assert all(node.op != "table" for node in known.graph.nodes)


def test_numbers_of_which_one_is_an_argument_are_no_table():
    def entry(x):
        row = jnp.asarray(GRID[0, :, 0]).at[3].set(x[0])
        return jax.lax.dynamic_slice(row, (jnp.floor(x[1]).astype(int),), (1,))

    lowered = lower(entry, jnp.zeros(2), loops="long")
    assert all(node.op != "table" for node in lowered.graph.nodes)
    points = np.stack([np.linspace(-1, 1, 14), np.arange(-1.0, 13.0)], axis=1)
    np.testing.assert_array_equal(numbers(lowered, points), jax.vmap(entry)(points))


def every_operation(graph, x):
    """Each operation of `FOLD` on the inputs."""
    a, b, c, d = x
    found = [graph.apply(op, a) for op in ONE] + [graph.apply(op, a, b) for op in TWO]
    less, same = graph.apply("lt", a, b), graph.apply("eq", c, d)
    found += [graph.apply("and", less, same), graph.apply("or", less, same), graph.apply("not", less)]
    found += [graph.apply("select", less, c, d), graph.apply("either", a, b, c, d)]
    found += [graph.apply("select", less, same, graph.apply("le", c, d))]
    return found + [graph.apply("stumpff", graph.constant(float(k)), graph.apply("abs", a)) for k in range(6)]


@pytest.mark.parametrize(("real", "lanes"), [("double", 0), ("float", 0), ("double", 8), ("float", 4)])
def test_every_operation_is_that_of_numpy_at_its_edges_too(real, lanes, tmp_path):
    """In lanes neighbours are of all kinds: what is no number in one lane stays there."""
    lowered = graph_of(every_operation, 4)
    assert {node.op for node in lowered.graph.nodes} >= set(FOLD)
    if lanes:
        call = in_lanes(lowered, tmp_path, real, lanes, most_statements=20)
    else:
        one, _ = compiled(lowered, tmp_path, real)
        call = lambda rows: [one(row) for row in rows]  # noqa: E731
    rng, dtype = np.random.default_rng(0), TYPES[real]
    points = [*rng.normal(size=(40, 4)), *([a, b, 1.0, a] for a in EDGES for b in (0.0, 1.0, math.nan, -math.pi))]
    points = rng.permutation(np.array([*points, *([9.0 * a, a, a, a] for a in range(4))]))
    with np.errstate(all="ignore"):
        x = points.astype(dtype)
        expected = np.stack(numbers(lowered, x.astype(float)).T, axis=-1).astype(dtype)
    eps = np.finfo(dtype).eps
    np.testing.assert_allclose(call(x), expected, rtol=8 * eps, atol=2 * eps)


def test_sine_and_cosine_in_lanes_are_those_of_libm_to_two_units_in_the_last_place(tmp_path):
    lowered = graph_of(lambda g, x: [g.apply("sin", x[0]), g.apply("cos", x[0])], 1)
    rng = np.random.default_rng(1)
    turns = np.arange(-6000, 6000) * (math.pi / 2)
    x = np.concatenate([rng.uniform(-1e5, 1e5, 20_000), rng.uniform(-4, 4, 12_000), turns, np.nextafter(turns, 1e6)])
    found, exact = in_lanes(lowered, tmp_path)(x[:, None]), np.stack([np.sin(x), np.cos(x)], axis=1)
    assert (np.abs(found - exact) / np.spacing(np.abs(exact))).max() <= 2.0
    far = np.array([1e5, -1.1e5, 1e9, 1e22, -1e300, math.inf, -math.inf, math.nan])
    with np.errstate(invalid="ignore"):
        exact = np.stack([np.sin(far), np.cos(far)], axis=1)
    np.testing.assert_allclose(in_lanes(lowered, tmp_path)(far[:, None]), exact, rtol=4e-16)


def test_rows_that_do_not_fill_the_lanes_are_padded_and_nothing_beyond_them_is_touched(tmp_path):
    lowered = graph_of(lambda g, x: [g.apply("sin", x[0]), g.apply("lt", x[1], x[0]), x[1]], 2)
    main = """#include <stdlib.h>
int main(void)
{
    int count, i;
    for (count = 1; count < 20; ++count) {
        double *x = calloc((size_t)count, 2 * sizeof *x), *y = malloc((size_t)count * 3 * sizeof *y);
        for (i = 0; i < 2 * count; ++i) x[i] = i;
        rows(x, y, count);
        for (i = 0; i < count; ++i)
            if (fabs(y[3 * i] - sin(2.0 * i)) > 1e-15 || y[3 * i + 1] != 0 || y[3 * i + 2] != 2 * i + 1) return 1;
        free(x);
        free(y);
    }
    return 0;
}
"""
    (tmp_path / "main.c").write_text(c_rows(lowered, "rows", 4) + main)
    flags = ["-std=c99", "-g", "-Wno-psabi", "-fsanitize=address,undefined", "-fno-sanitize-recover"]
    subprocess.run([COMPILER, *flags, "main.c", "-o", "main", "-lm"], cwd=tmp_path, check=True)
    subprocess.run([tmp_path / "main"], check=True)


def test_in_parts_it_is_the_same_to_the_bit(tmp_path):
    """Values that one part leaves to another keep their places until they are read."""

    def long(graph, x):
        values = list(x)
        random = np.random.default_rng(1)
        for _ in range(300):
            a, b = (values[int(i)] for i in random.integers(0, len(values), 2))
            op = ("add", "mul", "sub", "lt")[int(random.integers(0, 4))]
            made = graph.apply(op, a, b)
            values.append(graph.apply("select", made, graph.apply("sin", a), b) if op == "lt" else made)
            values[-1] = graph.apply("tanh", values[-1])
        return values[-40:]

    lowered = graph_of(long, 3)
    (tmp_path / "parts").mkdir()
    whole, one = compiled(lowered, tmp_path)
    parts, many = compiled(lowered, tmp_path / "parts", most_statements=7)
    assert "f_2(" in many
    assert "f_2(" not in one
    for x in np.random.default_rng(2).normal(size=(5, 3)):
        np.testing.assert_array_equal(whole(x), parts(x))
        np.testing.assert_allclose(whole(x), numbers(lowered, x), rtol=1e-9, atol=1e-12)


RULES = {
    "sine is odd": (lambda a, b, c: [jnp.sin(-a)], "sin neg"),
    "cosine is even": (lambda a, b, c: [jnp.cos(-a)], "cos"),
    "one sine for both differences": (lambda a, b, c: [jnp.sin(a - b) * jnp.sin(b - a)], "sub sin mul neg"),
    "one cosine for both differences": (lambda a, b, c: [jnp.cos(a - b), jnp.cos(b - a)], "sub cos"),
    "a product of negatives": (lambda a, b, c: [-a * -b], "mul"),
    "a negative in a sum of products": (lambda a, b, c: [c + -a * b], "mul sub"),
    "a negative in a quotient": (lambda a, b, c: [c - a / -b], "div add"),
    "a sum of negatives": (lambda a, b, c: [-(-a + -b)], "add"),
    "a difference of negatives": (lambda a, b, c: [-a - -b], "sub"),
    "a negative less something": (lambda a, b, c: [-(-a - b)], "add"),
    "a negative difference": (lambda a, b, c: [-(a - b)], "sub"),
    "the larger of negatives": (lambda a, b, c: [-jnp.maximum(-a, -b)], "min"),
    "negatives compared": (lambda a, b, c: [-a < -b], "lt"),
    "a choice of negatives": (lambda a, b, c: [-jnp.where(a < b, -a, -c)], "lt select"),
    "the angle of a mirrored point": (lambda a, b, c: [jnp.arctan2(-a, b)], "atan2 neg"),
    "one reciprocal for two quotients": (lambda a, b, c: [a / c, b / c], "div mul mul"),
    "one quotient stays": (lambda a, b, c: [a / c], "div"),
}


@pytest.mark.parametrize("name", RULES)
def test_a_rule_saves_operations_and_keeps_the_meaning(name):
    function, expected = RULES[name]
    before = lower(lambda x: function(*x), jnp.zeros(3))
    after = simplified(before)
    found = Counter(node.op for node in after.graph.nodes if node.op not in ("input", "constant"))
    assert found == Counter(expected.split())
    points = np.array([*np.random.default_rng(0).normal(size=(50, 3)), [0.0, 0.0, 1.0], [math.pi, -math.pi, 2.0]])
    units = 1.5 * 2.0**-52 if "reciprocal" in name else 0.0  # the product with a reciprocal rounds twice
    for found, exact in zip(numbers(after, points), numbers(before, points), strict=True):
        np.testing.assert_allclose(found, exact, rtol=units, atol=0)


@pytest.mark.parametrize("value", [0.1, 1 / 3, 5e-324, 1.7976931348623157e308, -2.0, 1e22, 0.1 + 0.2])
def test_numbers_are_read_back_as_they_were(value):
    assert float(c_number(value)) == value
    if abs(value) < 1e38:
        assert c_number(value, "float").endswith("f")
        assert np.float32(c_number(value, "float")[:-1]) == np.float32(value)


def test_a_signature_of_another_size_is_refused():
    from scalargraph import Signature

    lowered = graph_of(lambda g, x: [g.apply("add", x[0], x[1])], 2)
    with pytest.raises(ValueError, match="has 2 inputs; the signature names 1"):
        c_function(lowered, "f", Signature("double *y", ("y",), ("x",), ("y[0]",)))


def test_a_statement_that_is_known_in_a_loop_is_a_statement_there_in_lanes_too(tmp_path):
    def halved(x):
        def turn(carry):
            total, known, k = carry
            return jnp.where(known, jnp.sin(total), total), known, k + 1.0

        return jax.lax.while_loop(lambda carry: carry[2] < x[1], turn, (x[0], jnp.array(True), 0.0))[0]

    lowered = lower(halved, jnp.zeros(2), loops="any")
    points = np.random.default_rng(5).uniform(0, 6, (40, 2))
    expected = np.asarray(jax.vmap(halved)(points))[:, None]
    np.testing.assert_allclose(in_lanes(lowered, tmp_path)(points), expected, atol=1e-12)
