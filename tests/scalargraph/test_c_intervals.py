"""Bounds by compiled C are those by NumPy, bit by bit; and C that rounds in another way is found out."""

import shutil

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import Phase, example, given, settings, strategies as st
from test_lowering import FUNCTIONS

from scalargraph import FOLD, Graph, Lowered, enclose, lower
from scalargraph.intervals._c_intervals import Library, source
from scalargraph.intervals._fuse import PAIRS, fused
from scalargraph.intervals._intervals import INTERVALS
from scalargraph.intervals._tape import KERNELS, Interval, Tape

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler, `cc`")

ENDS = st.one_of(
    st.floats(allow_nan=False),
    st.sampled_from([0.0, -0.0, 5e-324, -5e-324, 2.0**-1022, 2.0**-1000, 1e-200, 1e200, 1.7e308, np.inf, -np.inf]),
    st.floats(-4, 4),
    st.integers(-3, 3).map(float),
)
INPUTS = 3
BOXES = st.lists(st.lists(st.tuples(ENDS, ENDS), min_size=INPUTS, max_size=INPUTS), min_size=1, max_size=70)
NAMES = "neg abs sqrt sin cos tan asin acos atan exp expm1 log log1p sinh cosh tanh asinh acosh atanh cbrt sign"
ONE = [*NAMES.split(), "floor", "ceil", "round"]
TWO = ["add", "sub", "mul", "div", "min", "max", "pow", "atan2"]
# Sums and products are what derivatives are made of, so they come often.
STEPS = st.lists(st.tuples(st.sampled_from([*ONE, *TWO * 3, "choice", "kink", "logic"]), *[st.integers(0, 99)] * 4))
NUMBERS = st.lists(st.one_of(ENDS, st.sampled_from([0.5, 2.0, -1.5, 3.0])), min_size=1, max_size=3)


def graph_of(numbers, steps):
    """A graph that uses its nodes at random; its last nodes are the results."""
    graph = Graph()
    real = [*map(graph.input, range(INPUTS)), *map(graph.constant, numbers)]
    true = [graph.apply("lt", real[0], real[1])]
    for op, *which in steps:
        a, b, c, d = (real[i % len(real)] for i in which)
        p, q = (true[i % len(true)] for i in which[:2])
        if op == "choice":
            real.append(graph.apply("select", p, c, d))
        elif op == "kink":
            real.append(graph.apply("either", a, b, c, d))
        elif op == "logic":
            name = ("lt", "le", "eq", "and", "or", "not", "is_finite", "stumpff")[which[2] % 8]
            if name == "stumpff":
                real.append(graph.apply(name, graph.constant(float(which[3] % 6)), a))
            elif name in ("lt", "le", "eq"):
                true.append(graph.apply(name, a, b))
            else:
                true.append(graph.apply(name, *{"not": (p,), "is_finite": (a,)}.get(name, (p, q))))
        else:
            real.append(graph.apply(op, a) if op in ONE else graph.apply(op, a, b))
    outputs = [*real[-6:], *true[-2:]]
    small, places = graph.pruned(outputs)
    return Lowered(small, ((INPUTS,),), tuple(places), (), None)


def boxes_of(rows):
    return np.sort(np.moveaxis(np.array(rows, float), -1, 0), axis=0)


def assert_same(graph, low, high):
    """Bit by bit, but for the sign of a zero and of NaN."""
    for c, right in zip(enclose(graph, low, high, "c"), enclose(graph, low, high, "numpy"), strict=True):
        np.testing.assert_array_equal(c, right)
        assert c.dtype == right.dtype


@settings(max_examples=100, phases=[Phase.explicit, Phase.generate])
@example([2.0, np.inf], [("mul", 0, 1, 0, 0), ("mul", 0, 3, 0, 0), ("div", 4, 0, 0, 0)], [[(0.0, 0.0)] * 3])
@given(NUMBERS, STEPS, BOXES)
def test_random_graphs_have_the_same_bounds(numbers, steps, rows):
    assert_same(graph_of(numbers, steps), *boxes_of(rows))


@pytest.mark.core(32)
@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_have_the_same_bounds(name):
    graph = lower(FUNCTIONS[name], jnp.zeros(3))
    rng = np.random.default_rng(4)
    low, width = rng.normal(size=(300, 3)), 10.0 ** rng.uniform(-16, 1, (300, 3)) * rng.choice([0, 1], (300, 3))
    assert_same(graph, low, low + width)


def test_each_operation_has_a_kernel_that_the_comparison_tries():
    """Where a library is loaded all kernels are compared; random graphs reach all of them."""
    tape = Tape()

    def place():
        return Interval(tape.place(), tape.place())

    p = INTERVALS["lt"](place(), place())
    for op in FOLD:
        counts = {"select": 3, "either": 4, "stumpff": 2, **dict.fromkeys([*TWO, "lt", "le", "eq"], 2)}
        if op in ("and", "or", "not"):
            INTERVALS[op](*[p] * (1 if op == "not" else 2))
        elif op != "stumpff":
            INTERVALS[op](*([p, place(), place()] if op == "select" else [place() for _ in range(counts.get(op, 1))]))
    INTERVALS["stumpff"](INTERVALS["constant"](2.0), place())
    used = {step.kernel for step in tape.steps}
    joined = {name for name in KERNELS if "_of_" in name and name != "number_of"}
    special = {"square", "times_number", "over_number", "number_over", "one", "number_of", "equal_to_itself"}
    no_jump = {"decided", "unequal", "not_zero", "off_the_cut", "one_value"}
    assert used | joined | special | no_jump == set(KERNELS)
    assert len(joined) == len(PAIRS)


def test_no_boxes_and_wrong_ones_are_as_for_numpy():
    graph = lower(lambda x: x[0] * x[1], jnp.zeros(2))
    assert enclose(graph, np.zeros((0, 2)), np.zeros((0, 2)), "c").low.shape == (0, 1)
    with pytest.raises(ValueError, match=r"box 0 has low 1.0 and high 0.0 in input 1"):
        enclose(graph, np.array([[0.0, 1.0]]), np.zeros((1, 2)), "c")


def test_steps_are_joined_where_one_alone_reads_the_other():
    tape = Tape()
    a, b, c = (Interval(tape.place(), tape.place()) for _ in range(3))
    first, second = INTERVALS["mul"](a, b), INTERVALS["mul"](b, c)
    alone = INTERVALS["add"](first, second)
    twice = INTERVALS["mul"](a, c)
    results = [alone, INTERVALS["add"](twice, twice), INTERVALS["add"](twice, b)]
    found = fused(tape, [end.number for result in results for end in result])
    assert [step.kernel for step in found] == ["add_of_products_and_products", "products", "add", "add"]
    assert found[0].arguments == tuple(end.number for x in (a, b, b, c) for end in x)


# The C is what the compiler made of the text; any operation of it that rounds otherwise is noticed when it is loaded.


def changed(kernel, old, new):
    """The C with one place of a kernel changed."""
    text = source()
    start = text.index(f"static void k_{kernel}(")
    stop = text.index("\n}\n", start)
    body = text[start:stop]
    assert old in body, body
    return text[:start] + body.replace(old, new, 1) + text[stop:]


@pytest.mark.core(1)
@pytest.mark.parametrize(
    ("kernel", "old", "new"),
    [
        ("add", "0x1.8000000000000p-53", "0x1.0000000000000p-60"),  # a bound that is not moved outward
        ("add", " - ", " + "),  # moved to the wrong side
        ("products", "(double)NAN", "0.0"),  # what is not known counts as 0
        ("add_of_products_and_products", "x2[i]", "x4[i]"),  # the rule of products with a wrong factor
        ("sin", "floor(", "ceil("),
    ],
)
def test_a_library_that_rounds_in_another_way_is_refused(monkeypatch, kernel, old, new):
    monkeypatch.setenv("COVARIANT_CACHE", "off")
    monkeypatch.setattr("scalargraph.intervals._c_intervals.EXACT", ("-std=c99", "-O0", "-fPIC", "-shared"))
    with pytest.raises(OSError, match=f"rounds {kernel} in another way than NumPy"):
        Library(changed(kernel, old, new))


def test_without_a_compiler_numpy_does_the_work(monkeypatch):
    monkeypatch.setattr("scalargraph.intervals._c_intervals.compiler", lambda: None)
    with pytest.raises(OSError, match="there is no C compiler `cc`, so NumPy does the work"):
        Library()
