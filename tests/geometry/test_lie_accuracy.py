"""Exponentials, Jacobians and their coefficients against power series in 60 digits, in both precisions.

The sampler aims at the seams: no rotation, hair's breadths, both sides of every threshold, half a turn and beyond, with
the other coordinates of order one. Errors are Frobenius norms, relative to that of the result.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from mpmath import mp, mpf

from covariant.geometry import lie
from covariant.geometry.lie._coefficients import angle_over_half_sine, inverse_jacobian_coefficient

TINY = 1e-6
EDGES = np.concatenate([[edge - TINY, edge + TINY] for edge in np.sqrt([1, 6, 12])])
ANGLES = np.concatenate([[0, 1e-12, 1e-8, 1e-4, 1e-2, 0.5], EDGES, [np.pi - TINY, np.pi, 4, 5, 6]])
PRECISIONS = [np.float64, np.float32]
OPERATIONS = ["exp", "derivative", "right_jacobian", "left_jacobian", "right_jacobian_inverse"]


@pytest.fixture(autouse=True, scope="module")
def _digits():
    with mp.workdps(60):
        yield


# The algebras, written down again, and their exponentials as power series


ONE = 1 << 240
"""Real numbers are written as integers, in units of 2⁻²⁴⁰: products of such matrices take a tenth of mpmath's time."""


def fixed(value):
    return int(mpmath.nint(mp.mpmathify(value) * ONE))


def in_reals(real, imaginary):
    """A complex matrix as a real one of twice the size, whose products are those of the complex ones."""
    return np.block([[real, -imaginary], [imaginary, real]])


def matrix(n, **entries):
    """A matrix (n, n) of exact numbers from `r01=value` for row 0, column 1."""
    a = np.zeros((n, n), object)
    for place, value in entries.items():
        a[int(place[1]), int(place[2])] = fixed(value)
    return a


def turns(n):
    return [matrix(n, r12=-1, r21=1), matrix(n, r02=1, r20=-1), matrix(n, r01=-1, r10=1)]


def imaginary(n, **entries):
    return in_reals(matrix(n), matrix(n, **entries))


def real(n, **entries):
    return in_reals(matrix(n, **entries), matrix(n))


def gell_mann():
    """−i/2 times Gell-Mann's λ₁, λ₄, λ₆ (symmetric), λ₂, λ₅, λ₇ (antisymmetric), λ₃, λ₈ (diagonal)."""
    h = mpf(1) / 2
    d = h / mpmath.sqrt(3)
    symmetric = [imaginary(3, r01=-h, r10=-h), imaginary(3, r02=-h, r20=-h), imaginary(3, r12=-h, r21=-h)]
    antisymmetric = [real(3, r01=-h, r10=h), real(3, r02=-h, r20=h), real(3, r12=-h, r21=h)]
    return [*symmetric, *antisymmetric, imaginary(3, r00=-h, r11=h), imaginary(3, r00=-d, r11=-d, r22=2 * d)]


def pauli():
    h = mpf(1) / 2
    return [imaginary(2, r01=-h, r10=-h), real(2, r01=-h, r10=h), imaginary(2, r00=-h, r11=h)]


SL2 = [[[1.0, 0.0], [0.0, -1.0]], [[0.0, 1.0], [0.0, 0.0]], [[0.0, 0.0], [1.0, 0.0]]]

# (group, basis, first coordinate of the rotation, number of them)
GROUPS = {
    "SO2": (lie.SO2, lambda: [matrix(2, r01=-1, r10=1)], 0, 1),
    "SO3": (lie.SO3, lambda: turns(3), 0, 3),
    "SE2": (lie.SE2, lambda: [matrix(3, r02=1), matrix(3, r12=1), matrix(3, r01=-1, r10=1)], 2, 1),
    "SE3": (lie.SE3, lambda: [matrix(4, r03=1), matrix(4, r13=1), matrix(4, r23=1), *turns(4)], 3, 3),
    "SU2": (lie.SU(2), pauli, 0, 3),
    "SU3": (lie.SU(3), gell_mann, 0, 8),
    "SO3 x SO2": (lie.Product((lie.SO3, lie.SO2)), lambda: [*turns(5), matrix(5, r34=-1, r43=1)], 0, 3),
    "SL2": (lie.MatrixGroup(SL2), lambda: [matrix(2, r00=1, r11=-1), matrix(2, r01=1), matrix(2, r10=1)], 0, 3),
}


def product(a, b):
    return (a @ b) >> 240


def coordinates(basis, a):
    """In a basis whose matrices are orthogonal to one another."""
    return [np.sum(e * a) * ONE // np.sum(e * e) for e in basis]


def structure(basis):
    return np.array([[coordinates(basis, product(a, b) - product(b, a)) for b in basis] for a in basis], dtype=object)


def combined(x, parts):
    return np.tensordot(x, parts, 1) >> 240


def powers(a, divisor):
    """The terms of `Σ aᵏ / (divisor(1) ⋯ divisor(k))`."""
    term, k = np.eye(len(a), dtype=object) * ONE, 0
    while k < 4 or max(abs(entry) for entry in term.flat) > ONE >> 190:
        yield term
        k += 1
        term = product(a, term) // divisor(k)


def inverse(a):
    scaled = mp.matrix([[mpf(entry) / ONE for entry in row] for row in a])
    return np.array([[fixed(entry) for entry in row] for row in mp.inverse(scaled).tolist()], dtype=object)


def exact(basis, constants, x):
    """What each of OPERATIONS should return, matrices of columns for the Jacobians."""
    exp = sum(powers(combined(x, basis), lambda k: k))
    terms = list(powers(combined(x, constants).T, lambda k: k + 1))
    even, odd = sum(terms[::2]), sum(terms[1::2])
    right = even - odd
    moved = np.array([product(exp, combined(column, basis)) for column in right.T], dtype=object)
    return exp, moved, right, even + odd, inverse(right)


class Trial(NamedTuple):
    """What a group computed at each sample, what is exact, and the condition of its Jacobian there."""

    found: dict
    exact: dict
    condition: np.ndarray
    dtype: type


def size(a):
    return mpmath.sqrt(sum(int(entry) ** 2 for entry in a.flat)) / ONE


def errors(trial, operation):
    """In units of rounding."""
    pairs = zip(trial.found[operation], trial.exact[operation], strict=True)
    relative = [float(size(exactly(a) - b) / size(b)) for a, b in pairs]
    return np.array(relative) / np.finfo(trial.dtype).eps


def exactly(a):
    """A matrix of floating-point numbers as real integers in units of 2⁻²⁴⁰."""
    a = in_reals(a.real, a.imag) if np.iscomplexobj(a) else a
    return np.array([fixed(float(entry)) for entry in a.flat], dtype=object).reshape(a.shape)


@pytest.fixture(scope="module", params=[(name, dtype) for name in GROUPS for dtype in PRECISIONS], ids=str)
def trial(request) -> Trial:
    name, dtype = request.param
    group, make_basis, first, count = GROUPS[name]
    basis = np.array(make_basis())
    x = np.random.default_rng(0).normal(size=(2 * len(ANGLES), len(basis)))
    x[1::2, first] *= 1e-7
    axes = x[:, first : first + count]
    axes *= (np.repeat(ANGLES, 2) / np.linalg.norm(axes, axis=1))[:, None]
    x = x.astype(dtype)
    one = jnp.eye(len(basis), dtype=dtype)

    def everything(x):
        columns = (jax.vmap(lambda e, f=f: f(x, e), out_axes=1)(one) for f in jacobians)
        return group.exp(x), jax.vmap(lambda e: jax.jvp(group.exp, (x,), (e,))[1])(one), *columns

    jacobians = (group.right_jacobian, group.left_jacobian, group.right_jacobian_inverse)
    found = [np.asarray(a) for a in jax.jit(jax.vmap(everything))(x)]
    assert all(a.real.dtype == dtype for a in found)
    constants = structure(basis)
    expected = zip(*(exact(basis, constants, [fixed(float(a)) for a in row]) for row in x), strict=True)
    condition = np.linalg.cond(found[2])
    return Trial(
        dict(zip(OPERATIONS, found, strict=True)), dict(zip(OPERATIONS, expected, strict=True)), condition, dtype
    )


@pytest.mark.core(1)
def test_inverse_jacobian_is_exact_to_its_condition(trial):
    """It has a pole at 2π, where the rounding of the angle alone is magnified."""
    assert (errors(trial, "right_jacobian_inverse") / trial.condition).max() < 4


@pytest.mark.exhaustive("SU3")
@pytest.mark.parametrize(("group", "n"), [(lie.SU(3), 8), (lie.MatrixGroup(SL2), 3)], ids=["SU3", "SL2"])
def test_exponential_of_large_vectors_keeps_its_digits(group, n):
    """Rounding grows with the norm, and with nothing else, on both sides of every doubling."""
    x = np.random.default_rng(1).normal(size=(60, n))
    x *= (np.geomspace(6, 40, 60) / np.linalg.norm(x, axis=1))[:, None]
    whole, half = (jax.jit(jax.vmap(group.exp))(a) for a in (x, x / 2))
    relative = np.linalg.norm(whole - half @ half, axis=(1, 2)) / np.linalg.norm(half, axis=(1, 2)) ** 2
    assert (relative / np.linalg.norm(x, axis=1)).max() < 4 * np.finfo(float).eps


# Coefficients


@pytest.mark.parametrize("dtype", PRECISIONS)
def test_inverse_jacobian_coefficient(dtype):
    x = (ANGLES[ANGLES < 4] ** 2).astype(dtype)
    found = np.asarray(jax.jit(jax.vmap(inverse_jacobian_coefficient))(x)).astype(float)
    for a, b in zip(found, x.astype(float), strict=True):
        half = mpmath.sqrt(mpf(b)) / 2
        expected = (1 - half * mpmath.cot(half)) / mpf(b) if b > 0 else mpf(1) / 12
        assert abs(a / expected - 1) < 8 * np.finfo(dtype).eps, b


@pytest.mark.parametrize("dtype", PRECISIONS)
def test_angle_over_half_sine(dtype):
    halves = np.concatenate([ANGLES[np.pi >= ANGLES] / 2, np.arctan(0.1) + np.array([-TINY, 0, TINY])])
    square, cosine = (np.sin(halves) ** 2).astype(dtype), np.cos(halves).astype(dtype)
    cosine[np.argmax(halves)] = 0
    found = np.asarray(jax.jit(jax.vmap(angle_over_half_sine))(square, cosine)).astype(float)
    for a, b, c in zip(found, square.astype(float), cosine.astype(float), strict=True):
        sine = mpmath.sqrt(mpf(b))
        expected = 2 * mpmath.atan2(sine, mpf(c)) / sine if b > 0 else 2 / mpf(c)
        assert abs(a / expected - 1) < 4 * np.finfo(dtype).eps, (b, c)
