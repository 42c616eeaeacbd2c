"""The oscillator of unknown frequency: its metric as printed by Sanfelice & Praly 2015, and every way to compute it."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy
from scipy import integrate

from covariant import models
from covariant._integrate import rk8
from covariant.metrics import (
    Equation,
    RiccatiMetric,
    lie_derivative,
    metric_at,
    metric_through,
    right_side,
    spd_distance,
)
from covariant.papers.sanfelice_praly import analytic_metric, grid, quadrature
from covariant.signals import StepCode

MODEL = models.unknown_frequency()
RATES = np.array([1.0, 2.0, 4.0, 8.0])
GRID = grid()
SOME = GRID[::9]
PROCESS = np.diag([0.1, 0.1, 0.1])

LAMBDA, X1, X2, X3 = sympy.symbols("lambda x1 x2 x3", positive=True)


def printed():
    """P below equation (16), entry by entry as on the page."""
    d = LAMBDA**2 + 4 * X3
    a = (6 * LAMBDA**4 + 12 * LAMBDA**2 * X3 + 16 * X3**2) / (LAMBDA**3 * d**3) * X1**2
    a += -4 * (5 * LAMBDA**2 + 4 * X3) / (LAMBDA**2 * d**3) * X1 * X2
    a += 4 * (5 * LAMBDA**2 + 4 * X3) / (LAMBDA**3 * d**3) * X2**2
    p11, p21, p22 = (LAMBDA**2 + 2 * X3) / (LAMBDA * d), -1 / d, 2 / (LAMBDA * d)
    p31 = (-(LAMBDA**3) * X1 + (LAMBDA**2 - 4 * X3) * X2) / (LAMBDA**2 * d**2)
    p32 = ((3 * LAMBDA**2 + 4 * X3) * X1 - 4 * LAMBDA * X2) / (LAMBDA**2 * d**2)
    return sympy.Matrix([[p11, p21, p31], [p21, p22, p32], [p31, p32, a]])


def residual(p):
    """Left less right side of (15), symbolically."""
    x = sympy.Matrix([X1, X2, X3])
    f, h = sympy.Matrix([X2, -X3 * X1, 0]), sympy.Matrix([X1])
    along = p.applyfunc(lambda entry: (sympy.Matrix([entry]).jacobian(x) @ f)[0])
    a, dh = f.jacobian(x), h.jacobian(x)
    return (along + p * a + a.T * p - dh.T * dh + LAMBDA * p).applyfunc(sympy.simplify)


def test_printed_metric_solves_equation_15_in_every_entry():
    assert residual(printed()) == sympy.zeros(3)


@pytest.mark.parametrize("entry", [(0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2)])
def test_another_sign_in_one_entry_would_be_noticed(entry):
    p = printed()
    p[entry] = p[entry[::-1]] = -p[entry]
    assert residual(p) != sympy.zeros(3)


def test_determinant_of_the_printed_metric_vanishes_only_at_rest():
    """The numerator is a quadratic form in (x1, x2); λ and x3 being positive, it is positive definite."""
    numerator = LAMBDA**4 * X1**2 - 6 * LAMBDA**3 * X1 * X2 - 2 * LAMBDA**2 * X1**2 * X3 + 10 * LAMBDA**2 * X2**2
    numerator += 8 * LAMBDA * X1 * X2 * X3 + 8 * X1**2 * X3**2 + 8 * X2**2 * X3
    expected = numerator / (LAMBDA**5 * (LAMBDA**2 + 4 * X3) ** 4)
    assert sympy.simplify(printed().det() - expected) == 0
    form = sympy.hessian(numerator, (X1, X2)) / 2
    assert sympy.expand(form.det() - (LAMBDA**2 + 4 * X3) ** 3) == 0
    assert sympy.expand(form[0, 0] - (LAMBDA**2 - X3) ** 2 - 7 * X3**2) == 0


def test_the_function_is_the_printed_metric():
    exact = np.vectorize(sympy.lambdify((LAMBDA, X1, X2, X3), printed(), "numpy"), signature="(),(),(),()->(i,j)")
    for rate in RATES:
        found = jax.vmap(analytic_metric(rate))(jnp.asarray(GRID))
        np.testing.assert_allclose(found, exact(rate, *GRID.T), rtol=1e-12, atol=1e-15)


def test_both_sides_of_equation_15_agree_on_the_printed_metric():
    def both(x, rate):
        metric = analytic_metric(rate)
        return lie_derivative(MODEL, metric, x), right_side(MODEL, Equation(rate), metric(x), x)

    left, right = over_rates(both)(jnp.asarray(GRID), jnp.asarray(RATES))
    np.testing.assert_allclose(left, right, rtol=0, atol=1e-13)


def over_rates(function):
    """`function(x, rate)` over all points and all rates, compiled: (rates, points, …)."""
    return eqx.filter_jit(jax.vmap(jax.vmap(function, (0, None)), (None, 0)))


@over_rates
def one_pass(x, rate):
    found = metric_at(MODEL, Equation(rate), x, tolerance=1e-12)
    return spd_distance(analytic_metric(rate)(x), found.metric), found.result


@over_rates
def gramian_distance(x, rate):
    return spd_distance(analytic_metric(rate)(x), quadrature(x, rate, 40 / rate))


@over_rates
def two_passes(x, rate):
    exact, ends = analytic_metric(rate)(x), []
    for route in ("riccati", "radon"):
        passage = metric_through(MODEL, Equation(rate), x, 40 / rate, 600, start=5.0, route=route)
        ends.append(spd_distance(exact, passage.metric[-1]))
    return jnp.stack(ends)


@pytest.mark.exhaustive
def test_one_pass_backward_gives_the_printed_metric_on_the_whole_grid():
    distances, result = one_pass(jnp.asarray(GRID), jnp.asarray(RATES))
    assert (result == StepCode.OK).all()
    assert distances.max() < 1e-8


@pytest.mark.exhaustive
def test_the_weighted_gramian_is_the_printed_metric_on_the_whole_grid():
    assert gramian_distance(jnp.asarray(GRID), jnp.asarray(RATES)).max() < 1e-8


def test_a_gramian_by_adaptive_quadrature_is_the_printed_metric():
    """Nothing of the library but the distance: the derivative of the closed solution, and an integral by scipy."""
    x1, x2, x3 = X = np.array([0.25, 1.125, 1.25])
    w = np.sqrt(x3)

    def seen(s):
        c, b = np.cos(w * s), np.sin(w * s)
        return np.array([c, -b / w, (-x1 * s * b - x2 * (s * c / w - b / x3)) / (2 * w)])

    for rate in RATES:
        p, _ = integrate.quad_vec(
            lambda s, rate=rate: np.exp(-rate * s) * np.outer(seen(s), seen(s)), 0.0, 45 / rate, epsabs=1e-14
        )
        assert spd_distance(analytic_metric(rate)(jnp.asarray(X)), jnp.asarray(p)) < 1e-9


@pytest.mark.exhaustive
def test_two_passes_with_the_riccati_equation_and_with_radons_pair_give_the_printed_metric():
    assert two_passes(jnp.asarray(SOME), jnp.asarray(RATES)).max() < 1e-8


class Terms(NamedTuple):
    """A sign for each term of both equations of the second pass, and whether h_xᵀ h_x is printed as h_x h_xᵀ."""

    right: float = -1.0
    left: float = -1.0
    output: float = 1.0
    forgetting: float = -1.0
    alpha: float = -1.0
    alpha_output: float = 1.0
    beta: float = 1.0
    noise: float = 1.0
    as_printed: float = 0.0


def mutations():
    """The equations as they are, and with each term's sign turned; Radon's first line as printed comes last."""
    right = Terms()
    flipped = [right._replace(**{name: -value}) for name, value in right._asdict().items() if name != "as_printed"]
    return [right, *flipped, right._replace(as_printed=1.0)]


@eqx.filter_jit
def by_hand(x, signs, q):
    """Metric at x by (20) with λ and by (10) with Q, written once more, each term with its sign."""
    a, c = jnp.array([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]), jnp.array([[1.0, 0.0, 0.0]])
    eye, rate, length, steps, zero = jnp.eye(3), 2.0, 32.0, 800, jnp.zeros(())

    def f(y):
        return jnp.stack([y[1], -y[2] * y[0], zero])

    def jacobian(y):
        return a.at[1, 0].set(-y[2]).at[1, 2].set(-y[0])

    def flow(s, joint):
        y, p, alpha, beta = joint
        a = jacobian(y)
        p_dot = signs.right * p @ a + signs.left * a.T @ p + signs.output * c.T @ c + signs.forgetting * rate * p
        product = (1 - signs.as_printed) * c.T @ c + signs.as_printed * (c @ c.T)[0, 0] * eye
        alpha_dot = signs.alpha * a.T @ alpha + signs.alpha_output * product @ beta
        return f(y), p_dot, alpha_dot, signs.noise * q @ alpha + signs.beta * a @ beta

    def step(joint, _):
        y, p, alpha, beta = rk8(flow, zero, joint, length / steps)
        return (y, p, alpha @ jnp.linalg.inv(beta), eye), None

    first = rk8(lambda s, y: -f(y), zero, x, length, steps)
    (_, p, alpha, _), _ = jax.lax.scan(step, (first, eye, eye, eye), length=steps)
    return p, alpha


@pytest.mark.exhaustive
def test_every_sign_of_the_equations_matters():
    x, q = jnp.array([0.25, 1.125, 1.25]), jnp.eye(3)
    right, *wrong = [by_hand(x, signs, q) for signs in mutations()]
    names = [*[name for name in Terms._fields if name != "as_printed"], "as_printed"]
    linear = analytic_metric(2.0)(x)
    quadratic = jax.jit(lambda x: metric_at(MODEL, Equation(process_cov=q), x, tolerance=1e-9).metric)(x)
    assert spd_distance(linear, right[0]) < 1e-8
    assert spd_distance(quadratic, right[1]) < 1e-7
    for name, found in zip(names, wrong, strict=True):
        first = name in ("right", "left", "output", "forgetting")
        exact, p = (linear, found[0]) if first else (quadratic, found[1])
        assert not spd_distance(exact, (p + p.T) / 2) < 1e-2, name  # NaN where it is no metric any more


QUADRATIC = Equation(process_cov=jnp.asarray(PROCESS))


@jax.jit
@jax.vmap
def found(x):
    return metric_at(MODEL, QUADRATIC, x, tolerance=1e-10).metric


@eqx.filter_jit
@jax.vmap
def left_side(x):
    return lie_derivative(MODEL, RiccatiMetric(MODEL, QUADRATIC, 60.0, 4500), x)


@jax.vmap
def right(x, p):
    return right_side(MODEL, QUADRATIC, p, x)


@pytest.mark.exhaustive
def test_equation_8_holds_along_the_motion():
    """Its left side by finite differences of `metric_at`, and by differentiating a window of fixed length."""
    x = jnp.asarray(SOME)
    p = found(x)
    expected = right(x, p)
    np.testing.assert_allclose(left_side(x), expected, rtol=0, atol=1e-7)

    def f(x):
        return jax.vmap(lambda y: MODEL.f(jnp.zeros(()), y, jnp.zeros(0)))(x)

    def along(step):
        moved = x + step * f(x)
        return found(moved)

    h = 1e-2
    slope = (8 * (along(h) - along(-h)) - (along(2 * h) - along(-2 * h))) / (12 * h)
    a = jax.vmap(lambda y: MODEL.jacobians(jnp.zeros(()), y, jnp.zeros(0))[0])(x)
    bent = p @ a
    np.testing.assert_allclose(slope + bent + jnp.swapaxes(bent, 1, 2), expected, rtol=0, atol=1e-6)
    assert np.abs(slope).max() > 1e-2  # the metric does change along the motion


@pytest.mark.exhaustive
def test_the_metric_of_equation_15_does_not_depend_on_how_it_was_started():
    x = jnp.asarray(GRID[::31])

    @jax.jit
    def at(x, start):
        return jax.vmap(lambda x: metric_at(MODEL, Equation(2.0), x, start=start, tolerance=1e-9).metric)(x)

    low, high = at(x, jnp.asarray(1e-3)), at(x, jnp.asarray(1e3))
    assert jax.vmap(spd_distance)(low, high).max() < 2e-9
