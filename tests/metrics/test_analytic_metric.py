"""The oscillator of unknown frequency: its metric as printed by Sanfelice & Praly 2015, and every way to compute it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import sympy

from covariant import models
from covariant.metrics import lie_derivative
from covariant.papers.sanfelice_praly import analytic_metric, grid

MODEL = models.unknown_frequency()
RATES = np.array([1.0, 2.0, 4.0, 8.0])
GRID = grid()
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


def test_the_function_is_the_printed_metric():
    exact = np.vectorize(sympy.lambdify((LAMBDA, X1, X2, X3), printed(), "numpy"), signature="(),(),(),()->(i,j)")
    for rate in RATES:
        found = jax.vmap(analytic_metric(rate))(jnp.asarray(GRID))
        np.testing.assert_allclose(found, exact(rate, *GRID.T), rtol=1e-12, atol=1e-15)


def test_both_sides_of_equation_15_agree_on_the_printed_metric():
    def both(x, rate):
        metric = analytic_metric(rate)
        output = MODEL.jacobians(jnp.zeros(()), x, jnp.zeros(0))[1]
        return lie_derivative(MODEL, metric, x), output.T @ output - rate * metric(x)

    left, right = over_rates(both)(jnp.asarray(GRID), jnp.asarray(RATES))
    np.testing.assert_allclose(left, right, rtol=0, atol=1e-13)


def over_rates(function):
    """`function(x, rate)` over all points and all rates, compiled: (rates, points, …)."""
    return eqx.filter_jit(jax.vmap(jax.vmap(function, (0, None)), (None, 0)))
