"""The ideal fluid on SU(n): its bracket, its metric, its motion, and an observer that finds its velocity."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from covariant.models import fluid

POINTS = 64
X1, X2 = np.meshgrid(*2 * [2 * np.pi * np.arange(POINTS) / POINTS], indexing="ij")
SMOOTH = np.cos(X1) + 0.7 * np.cos(X2 + 0.3) + 0.3 * np.cos(X1 + X2)


values = eqx.filter_jit(fluid.vorticity)


@eqx.filter_jit
def _velocity(n, stream):
    return fluid.velocity_coordinates(n, fluid.modes(n, stream))


def velocity(n, stream):
    return _velocity(n, jnp.asarray(stream))


def cross_sine(m, k, n):
    return np.sin(2 * np.pi / n * (m[0] * k[1] - m[1] * k[0]))


def clock_and_shift(m, n):
    """T_m entry by entry."""
    matrix = np.zeros((n, n), complex)
    for k in range(n):
        matrix[k, (k + m[1]) % n] = np.exp(2j * np.pi * (m[0] * m[1] + 2 * m[0] * k) / n)
    return matrix


def relative(a, b):
    return np.abs(np.asarray(a) - np.asarray(b)).max() / np.abs(np.asarray(b)).max()


def d(f, axis):
    """The derivative along an axis, by Fourier series."""
    spectrum = np.expand_dims(1j * np.fft.fftfreq(POINTS, 1 / POINTS), 1 - axis)
    return np.fft.ifft(spectrum * np.fft.fft(f, axis=axis), axis=axis).real


def laplacian(f):
    return d(d(f, 0), 0) + d(d(f, 1), 1)


# The algebra


def test_matrices_are_those_of_the_clock_and_shift_basis():
    n, rng = 5, np.random.default_rng(0)
    coefficients = rng.normal(size=(n, n)) + 1j * rng.normal(size=(n, n))
    frequencies = range(-2, 3)
    expected = sum(coefficients[a, b] * clock_and_shift((a, b), n) for a in frequencies for b in frequencies)
    matrix = fluid._matrix(n, jnp.asarray(coefficients))
    assert relative(matrix, expected) < 1e-14
    assert relative(fluid._coefficients(n, matrix), coefficients) < 1e-14


def test_commutator_of_the_basis_is_the_sine_bracket():
    n, s = 7, fluid._unit(7)
    for m, k in (((1, 0), (0, 1)), ((2, 1), (-1, 3)), ((3, 3), (3, -2)), ((1, 2), (2, 4))):
        a, b = s * clock_and_shift(m, n), s * clock_and_shift(k, n)
        total = s * clock_and_shift((m[0] + k[0], m[1] + k[1]), n)
        assert np.abs(a @ b - b @ a + n / (2 * np.pi) * cross_sine(m, k, n) * total).max() < 1e-13


def test_fields_and_velocities_are_inverse_to_each_other():
    n = 17
    v = jnp.asarray(np.random.default_rng(n).normal(size=n**2 - 1))
    assert relative(eqx.filter_jit(lambda x: fluid.velocity_coordinates(n, fluid.stream_modes(n, x)))(v), v) < 1e-13
    stream = eqx.filter_jit(lambda n, v, points: fluid.field(fluid.stream_modes(n, v), points))
    assert relative(velocity(n, stream(n, v, POINTS)), v) < 1e-13
    assert relative(stream(n, velocity(n, SMOOTH), POINTS), SMOOTH) < 1e-13
    assert relative(values(n, velocity(n, SMOOTH), POINTS), laplacian(SMOOTH)) < 1e-12


def test_bad_arguments_are_named():
    for n in (4, 1, -3):
        with pytest.raises(ValueError, match="odd integer"):
            fluid.ideal_fluid(n)
    with pytest.raises(ValueError, match="viscosity"):
        fluid.ideal_fluid(5, -1.0)
    with pytest.raises(ValueError, match="at least 5 points"):
        fluid.vorticity(5, jnp.zeros(24), 4)


# The metric


# The motion


# The observer
