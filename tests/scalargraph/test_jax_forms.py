"""Every form of a jaxpr that is known has the value that JAX gives it; what is not known is refused by name.

The tests hold for each supported release of JAX: a primitive that a release does not have is left out there.
"""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.core import ShapedArray
from jax.extend import core
from jax.interpreters import mlir

from scalargraph import LoweringError, lower, numbers
from scalargraph.graph import While, equations
from scalargraph.graph._jax_forms import (
    REPLACED,
    Branch,
    Call,
    JaxprEquation,
    Parameters,
    Scan,
    expanded,
    needed,
)

POINTS = np.random.default_rng(4).normal(size=(4, 3)) * 0.8


@jax.custom_vjp
def cubed(x):
    return x**3


cubed.defvjp(lambda x: (x**3, x), lambda x, g: (3 * x**2 * g,))


@jax.custom_jvp
def halved(x):
    return x / 2


halved.defjvp(lambda p, t: (p[0] / 2, t[0] / 2))


def rows(x):
    """Rows of a matrix one by one, and a stack of them along each axis."""
    first, second, third = jnp.stack([x, x**2, jnp.cos(x)])
    return jnp.stack([jnp.stack([first, second], axis=1), jnp.stack([third, x], axis=1)], axis=-1)


def scanned(x):
    def turn(carry, row):
        a, b = carry
        return (a * row[0] + x[0], b + row[1]), (a, row * x[1])

    (a, b), (c, d) = jax.lax.scan(turn, (x[0], x[1]), jnp.stack([x, x**2], axis=1), reverse=True)
    return jnp.concatenate([jnp.stack([a, b]), c, d.ravel()])


FORMS = {
    "scan": scanned,
    "scan of nothing carried": lambda x: jax.lax.map(jnp.sin, x),
    "scan without rows": lambda x: jax.lax.scan(lambda c, _: (c * x[0] + x, None), x, None, 3)[0],
    "scan over no rows": lambda x: jax.lax.scan(lambda c, r: (c + r, jnp.stack([r, c])), x[0], x[:0])[1],
    "scan unrolled by JAX": lambda x: jax.lax.scan(lambda c, r: (c * r, c), x[0], x, unroll=2)[1],
    "while": lambda x: jax.lax.while_loop(lambda s: s[0] < 3, lambda s: (s[0] + 1, s[1] * x[1] + 1), (0, x[0]))[1],
    "for": lambda x: jax.lax.fori_loop(0, 4, lambda i, s: s * x[i % 3] + i, x[0]),
    "cond": lambda x: jax.lax.cond(jnp.array(3) > 2, jnp.sin, jnp.cos, x),
    "switch": lambda x: jax.lax.switch(jnp.array(7), [jnp.sin, jnp.cos, jnp.tan], x),
    "jit": lambda x: jax.jit(lambda y: jnp.sin(y) * x[0])(x),
    "unstack and stack": rows,
    "stack under vmap": lambda x: jax.vmap(lambda a, b: jnp.stack([a, b * x[0]]), in_axes=(0, None))(x, x[1]),
    "custom derivative forwards": lambda x: jax.jvp(halved, (x,), (x**2,))[1],
    "custom derivative backwards": lambda x: cubed(x) + jax.grad(lambda y: cubed(y).sum())(x),
    "rematerialised": lambda x: jax.grad(lambda y: jax.checkpoint(lambda z: jnp.sin(z * z))(y).sum())(x),
    "linearised scan": lambda x: jax.jacrev(scanned)(x),
    "linearised unstack": lambda x: jax.jacrev(rows)(x),
    "hyperbolic tangent's derivatives": jax.hessian(lambda x: jnp.tanh(x).prod()),
    "logarithm to base two": lambda x: jnp.log2(1 + x**2),
    "polynomial": lambda x: jnp.polyval(jnp.stack([x[0], x[1], x[2]]), x),
    "long polynomial": lambda x: jnp.polyval(jnp.arange(1.0, 14.0), x),
    "cardinal sine": lambda x: jnp.sinc(jnp.where(x == 0, 1.0, x)),
    "arrays put somewhere": lambda x: jax.device_put(x) * jnp.array([x[0], 2.0, x[1]]),
}


@pytest.mark.core(4)
@pytest.mark.exhaustive("hyperbolic tangent's derivatives", "linearised scan", "linearised unstack")
@pytest.mark.parametrize("name", FORMS)
def test_each_form_has_the_values_that_jax_gives_it(name):
    lowered = lower(FORMS[name], jnp.zeros(3))
    for x in POINTS:
        expected = np.asarray(FORMS[name](jnp.asarray(x)))
        assert numbers(lowered, x).shape == expected.shape
        assert np.allclose(numbers(lowered, x), expected, rtol=1e-13, atol=1e-13, equal_nan=True), name


@pytest.mark.parametrize(
    ("function", "form"),
    [
        (lambda x: jax.lax.scan(lambda c, r: (c + r, c), x[0], x)[0], Scan),
        (lambda x: jax.lax.while_loop(lambda c: c < 3, lambda c: c + x[0], x[1]), While),
        (lambda x: jax.lax.cond(x[0] > 0, jnp.sin, jnp.cos, x), Branch),
        (lambda x: jax.jit(jnp.sin)(x), Call),
    ],
)
def test_equations_that_hold_functions_have_their_form(function, form):
    found = [eqn.form for eqn in equations(jax.make_jaxpr(function)(jnp.ones(3)).jaxpr) if eqn.form is not None]
    assert form in map(type, found)


def test_a_scan_tells_its_constants_its_carry_and_its_direction():
    def turn(carry, row):
        return (carry[0] + row, carry[1] * two), row * row

    two = jnp.arange(2.0)

    def function(x, y):
        return jax.lax.scan(lambda c, r: turn((c[0] * y, c[1]), r), (x[0], two), x, reverse=True)

    closed = jax.make_jaxpr(function)(jnp.ones(5), jnp.array(2.0))
    (scan,) = [eqn.form for eqn in equations(closed.jaxpr) if isinstance(eqn.form, Scan)]
    assert (scan.carried, scan.length, scan.reverse) == (2, 5, True)
    assert scan.fixed + 2 + 1 == len(scan.body.jaxpr.invars)
    assert len(scan.body.results) == 3


# Equations as another release of JAX may write them.


def equation(primitive: core.Primitive, avals: int, results: int = 1, **parameters) -> SimpleNamespace:
    """A jaxpr of one equation."""
    atom = SimpleNamespace(aval=ShapedArray((3,), jnp.zeros(1).dtype))
    variables = {"invars": [atom] * avals, "outvars": [atom] * results}
    return SimpleNamespace(
        eqns=[SimpleNamespace(primitive=primitive, params=parameters, source_info=None, **variables)]
    )


def leaves(*sizes):
    """A tree as a later release has it in a scan."""
    return SimpleNamespace(unpack=lambda: [[None] * size for size in sizes])


BODY = jax.make_jaxpr(lambda a, b, c: (a + b, c))(*[jnp.ones(3)] * 3)
SCAN = core.Primitive("scan")
LOOP = {"jaxpr": BODY, "length": 4, "reverse": False, "unroll": 1}


@pytest.mark.parametrize(
    "parameters",
    [
        {"num_consts": 1, "num_carry": 1, "linear": (False,) * 3, "_split_transpose": False},
        {"ft_in": leaves(1, 1, 1), "ft_out": leaves(1, 1)},
    ],
)
def test_a_scan_is_read_in_the_forms_of_all_releases(parameters):
    (found,) = equations(equation(SCAN, 3, 2, **LOOP, **parameters))
    assert found.form == Scan(found.form.body, 1, 1, 4, False)
    assert found.form.body.jaxpr is BODY.jaxpr


@pytest.mark.parametrize(
    ("parameters", "named"),
    [
        ({}, "num_consts"),
        ({"num_consts": 1}, "num_carry"),
        ({"num_consts": 1, "num_carry": 1, "skip": 2}, "skip"),
        ({"num_consts": 1, "num_carry": 4}, "jaxpr"),
        ({"ft_in": 3, "ft_out": 2}, "ft_in"),
        ({"ft_in": leaves(1, 1), "ft_out": leaves(1, 1)}, "ft_in"),
        ({"ft_in": leaves(1, 1, 1), "ft_out": leaves(2, 0)}, "ft_out"),
        ({"ft_in": leaves(1, 1, 3), "ft_out": leaves(1, 1)}, "jaxpr"),
    ],
)
def test_a_scan_in_no_known_form_is_refused_by_its_parameter(parameters, named):
    with pytest.raises(LoweringError, match=f"'scan' of JAX .* parameter '{named}'"):
        list(equations(equation(SCAN, 3, 2, **LOOP, **parameters)))


@pytest.mark.parametrize(
    ("name", "parameters", "named"),
    [
        ("while", {"cond_jaxpr": BODY, "cond_consts": 0, "body_jaxpr": BODY, "body_nconsts": 0}, "cond_consts"),
        ("while", {"cond_jaxpr": BODY, "cond_nconsts": 0, "body_jaxpr": BODY}, "body_nconsts"),
        ("cond", {"functions": (BODY,)}, "functions"),
        ("jit", {"call_jaxpr": BODY}, "jaxpr"),
        ("custom_jvp_call", {"jaxpr": BODY}, "call_jaxpr"),
        ("jit", {"jaxpr": jax.make_jaxpr(jnp.sin)(1.0)}, "jaxpr"),
        ("stack", {"dimension": 1}, "dimension"),
    ],
)
def test_other_forms_that_are_not_known_are_refused_by_name_and_parameter(name, parameters, named):
    with pytest.raises(LoweringError, match=rf"(?s)'{name}'.*{named}"):
        list(equations(equation(core.Primitive(name), 3, 2, **parameters)))


def plus(name="of_a_later_release", **options) -> core.Primitive:
    """A primitive that adds one, which no release has."""
    primitive = core.Primitive(name)
    primitive.def_abstract_eval(lambda x, **_: ShapedArray(x.shape, x.dtype))
    primitive.def_impl(lambda x, **_: x + 1)
    mlir.register_lowering(primitive, mlir.lower_fun(lambda x, **_: x + 1, multiple_results=False))
    return primitive


def test_a_primitive_without_a_rule_is_expanded_where_jax_can():
    later = plus()
    lowered = lower(lambda x: later.bind(x * 2, way="up"), jnp.zeros(3))
    assert np.array_equal(numbers(lowered, POINTS[0]), POINTS[0] * 2 + 1)


def test_a_primitive_that_jax_cannot_expand_is_refused_by_name():
    """One whose implementation is itself, and one without any; a callback is not called to find out."""
    itself, bare, called = plus("itself"), plus("bare"), []
    itself.def_impl(jax.jit(lambda x: itself.bind(x)))
    bare.impl = core.Primitive("other").impl

    def callback(x):
        called.append(x)
        return x

    for name, function in {
        "itself": itself.bind,
        "bare": bare.bind,
        "pure_callback": lambda x: jax.pure_callback(callback, x, x),
        "cholesky": lambda x: jnp.linalg.cholesky(jnp.outer(x, x)),
        "sort": jnp.sort,
    }.items():
        with pytest.raises(LoweringError, match=f"the primitive '{name}' has no graph of scalars"):
            lower(function, jnp.zeros(3))
    assert not called


def test_an_expansion_with_other_results_is_refused():
    later = plus("shorter")
    later.def_impl(lambda x: x[:1] + 1)
    with pytest.raises(LoweringError, match="'shorter'"):
        lower(later.bind, jnp.zeros(3))


def test_a_parameter_that_no_rule_reads_is_refused_unless_it_is_not_set():
    """A later `cumsum` that leaves out the last term, say, is not computed as today's."""
    sums = plus("cumsum")
    for parameters in ({}, {"exclusive": None}, {"accuracy": 3}):
        lower(lambda x, p=parameters: sums.bind(x, axis=0, reverse=False, **p), jnp.zeros(3))
    with pytest.raises(LoweringError, match="'cumsum' with the parameter 'exclusive'"):
        lower(lambda x: sums.bind(x, axis=0, reverse=False, exclusive=True), jnp.zeros(3))
    with pytest.raises(LoweringError, match=r"'cumsum' of JAX .* no parameter 'axis'"):
        lower(lambda x: sums.bind(x, reverse=False), jnp.zeros(3))


def test_known_numbers_with_a_parameter_that_no_rule_reads_are_computed_by_jax():
    negative = plus("neg")
    assert (
        numbers(lower(lambda x: x + negative.bind(jnp.ones(3), way="up"), jnp.zeros(3)), np.zeros(3)).tolist()
        == [2.0] * 3
    )


def test_replacements_give_what_jax_gives_for_primitives_of_newer_releases():
    """Each is tried where the installed release has the primitive."""
    x = jnp.asarray(POINTS[0])
    calls = {
        "stack": (lambda: [x, x**2], {"axis": 1}),
        "unstack": (lambda: [jnp.outer(x, x)], {"axis": 1}),
        "one_minus_square": (lambda: [x], {}),
        "log2": (lambda: [x**2], {"accuracy": None}),
        "polynomial": (lambda: [x, x**2, x**3, jnp.ones(3)], {}),
    }
    for name, (arguments, parameters) in calls.items():
        primitive = getattr(jax.lax, f"{name}_p", None) or getattr(core.primitives, f"{name}_p", None)
        found = REPLACED[name](*arguments(), **parameters)
        if primitive is not None:
            expected = primitive.bind(*arguments(), **parameters)
            for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
                assert np.allclose(a, b, rtol=4e-16)
    assert np.allclose(REPLACED["polynomial"](x, 2.0, 3.0, 4.0), 2 + 3 * x + 4 * x**2)
    assert np.allclose(REPLACED["one_minus_square"](x), 1 - x**2)


def test_what_results_do_not_need_is_left_out_with_constants_in_place():
    table = jnp.arange(3.0)
    closed = jax.make_jaxpr(lambda x: (jnp.sort(x), x * table)[1])(jnp.ones(3))
    body = needed(closed)
    assert "sort" not in [eqn.name for eqn in equations(body.jaxpr)]
    assert len(body.consts) == len(body.jaxpr.constvars)


def test_a_primitive_expands_to_a_call_in_its_place():
    later = plus("another")
    (eqn,) = equations(jax.make_jaxpr(later.bind)(jnp.ones(3)).jaxpr)
    assert isinstance(eqn, JaxprEquation)
    assert isinstance(eqn.params, Parameters)
    call = expanded(eqn)
    assert call.replaces
    assert [inner.name for inner in equations(call.body.jaxpr)] == ["add"]
