"""What takes long of `test_lie_accuracy.py`."""

from functools import cache

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from mpmath import mpf
from test_lie_accuracy import ANGLES, OPERATIONS, PRECISIONS, SL2, TINY, _digits, errors, trial

from covariant.geometry.lie._coefficients import stumpff

SLOW = ("SE2", "SE3", "SL2", "SU2", "SU3")
"""Groups whose exponentials and derivatives take long to check."""


@pytest.mark.exhaustive(
    *(f"{(group, dtype)}-{each}" for group in SLOW for dtype in PRECISIONS for each in OPERATIONS[:2])
)
@pytest.mark.parametrize("operation", OPERATIONS[:-1])
def test_exponential_and_jacobians_are_exact_to_rounding(trial, operation):
    assert errors(trial, operation).max() < 8


SQUARES = np.concatenate([ANGLES**2, [k * (k - 1) + side for k in range(3, 9) for side in (-TINY, TINY)], [30, 39]])


@cache
def exact_stumpff(k, x, order=0):
    """As a hypergeometric function, which has its derivatives in closed form."""
    a, b = mpf(k + 1) / 2, mpf(k + 2) / 2
    factor = mpf(-0.25) ** order * mpmath.factorial(order) / mpmath.rf(a, order) / mpmath.rf(b, order)
    return factor / mpmath.factorial(k) * mpmath.hyp1f2(1 + order, a + order, b + order, -x / 4)


def size_of_terms(k, x, order):
    """Of the terms from which the recurrence makes a derivative: c₀, c₁ and c₂ have zeros, beside which they are 1."""
    if order:
        return (k * size_of_terms(k + 2, x, order - 1) + size_of_terms(k + 1, x, order - 1)) / 2
    return exact_stumpff(k, x) if k >= 3 else mpf(1)


@pytest.mark.exhaustive("2")
@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("order", [0, 1, 2])
def test_stumpff_and_two_derivatives(order, dtype):
    x = np.maximum(SQUARES, 0).astype(dtype)

    def derivatives(x):
        functions = [lambda x, k=k: stumpff(k, x) for k in range(9)]
        for _ in range(order):
            functions = [jax.grad(f) for f in functions]
        return jnp.stack([f(x) for f in functions])

    found = np.asarray(jax.jit(jax.vmap(derivatives))(x))
    assert found.dtype == dtype
    for k in range(9):
        for a, b in zip(found[:, k].astype(float), x.astype(float), strict=True):
            error = abs(a - exact_stumpff(k, mpf(b), order)) / size_of_terms(k, mpf(b), order)
            assert error < 3 * np.finfo(dtype).eps, (k, b)
