"""Ball and beam against symbolic derivation and the printed values of Aghannan & Rouchon 2003, appendix I."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy as sp

from covariant.geometry import christoffel, curvature, gradient
from covariant.models import acceleration, ball_and_beam

R, THETA, VR, VTHETA, U = sp.symbols("r theta v_r v_theta u", real=True)
M, J, G = sp.symbols("m J g", positive=True)
PAPER = {M: 1, J: 1, G: 1}
PARAMETERS = {"normalised": (1.0, 1.0, 1.0), "heavy": (9.81, 2.0, 0.3)}
POINT = jnp.array([0.7, 0.4])
X, Y, Z = jnp.array([[0.3, -0.5], [1.1, 0.2], [-0.4, 0.9]])
UNIT = jnp.eye(2)


def symbols_of(g):
    q, inverse = (R, THETA), g.inv()
    return [
        [
            [
                sum(inverse[i, m] * (g[m, j].diff(q[k]) + g[m, k].diff(q[j]) - g[j, k].diff(q[m])) for m in (0, 1)) / 2
                for k in (0, 1)
            ]
            for j in (0, 1)
        ]
        for i in (0, 1)
    ]


def riemann_of(gamma):
    """`entries[i, j, k, l]` are the components of `R(e_k, e_l)e_j` in the library's sign."""
    q, two = (R, THETA), (0, 1)

    def half(i, j, k, m):
        return gamma[i][m][j].diff(q[k]) + sum(gamma[i][k][s] * gamma[s][m][j] for s in two)

    return {
        (i, j, k, m): sp.simplify(half(i, j, k, m) - half(i, j, m, k))
        for i in two
        for j in two
        for k in two
        for m in two
    }


METRIC = sp.diag(M, J + M * R**2)
GAMMA = symbols_of(METRIC)


@functools.cache
def riemann():
    return riemann_of(GAMMA)


def test_symbolic_christoffel_symbols_are_those_printed():
    printed = {(0, 1, 1): -R, (1, 0, 1): R / (1 + R**2), (1, 1, 0): R / (1 + R**2)}
    for i in (0, 1):
        for j in (0, 1):
            for k in (0, 1):
                assert sp.simplify(GAMMA[i][j][k].subs(PAPER) - printed.get((i, j, k), 0)) == 0


def test_symbolic_curvature_is_that_printed():
    """The paper's `R^i_jkl` acts as `{R(u, w)z}^i = R^i_jkl u^k w^j z^l`, with the opposite sign of the library's."""
    printed = {(0, 0, 1, 1): -1 / (1 + R**2), (0, 1, 0, 1): 1 / (1 + R**2)}
    printed |= {(1, 0, 1, 0): 1 / (1 + R**2) ** 2, (1, 1, 0, 0): -1 / (1 + R**2) ** 2}
    for (i, z, u, w), entry in riemann().items():
        assert sp.simplify(-entry.subs(PAPER) - printed.get((i, w, u, z), 0)) == 0


def test_symbolic_scalar_curvature_is_that_printed():
    inverse = METRIC.inv()
    scalar = sum(inverse[j, m] * riemann()[k, j, k, m] for j in (0, 1) for m in (0, 1) for k in (0, 1))
    assert sp.simplify(scalar.subs(PAPER) + 2 / (1 + R**2) ** 2) == 0
    assert sp.simplify(scalar + 2 * M * J / (M * (J + M * R**2) ** 2)) == 0


def numbers(expressions, parameters):
    gravity, mass, inertia = parameters
    values = {R: float(POINT[0]), THETA: float(POINT[1]), M: mass, J: inertia, G: gravity}
    return np.array(sp.Array(expressions).subs(values).tolist(), dtype=float)


@pytest.mark.parametrize("parameters", PARAMETERS.values(), ids=PARAMETERS)
def test_christoffel_is_the_symbolic_one(parameters):
    expected = np.einsum("ijk,j,k", numbers(GAMMA, parameters), X, Y)
    np.testing.assert_allclose(christoffel(ball_and_beam(*parameters).metric, POINT, X, Y), expected, atol=1e-14)


@pytest.mark.parametrize("parameters", PARAMETERS.values(), ids=PARAMETERS)
def test_curvature_is_the_symbolic_one(parameters):
    tensor = numbers([entry for _, entry in sorted(riemann().items())], parameters).reshape(2, 2, 2, 2)
    expected = np.einsum("ijkl,j,k,l", tensor, Z, X, Y)
    np.testing.assert_allclose(curvature(ball_and_beam(*parameters).metric, POINT, X, Y, Z), expected, atol=1e-13)


@pytest.mark.parametrize("parameters", PARAMETERS.values(), ids=PARAMETERS)
def test_gaussian_curvature(parameters):
    _, mass, inertia = parameters
    metric = ball_and_beam(*parameters).metric

    def gaussian(q):
        area = jnp.prod(jnp.diag(metric(q)))
        return UNIT[0] @ metric(q) @ curvature(metric, q, UNIT[0], UNIT[1], UNIT[1]) / area

    for r in (-3.0, -0.1, 0.0, 1e-8, 0.5, 10.0):
        k = jax.jit(gaussian)(jnp.array([r, 0.4]))
        assert k == pytest.approx(-inertia / (inertia + mass * r**2) ** 2, rel=1e-12)


def test_acceleration_is_equation_13_of_the_paper():
    r, theta, v_r, v_theta, u = 0.7, 0.4, 0.3, -0.5, 1.7
    printed = [
        r * v_theta**2 - np.sin(theta),
        -2 * r / (1 + r**2) * v_r * v_theta + (u - r * np.cos(theta)) / (1 + r**2),
    ]
    mine = acceleration(
        ball_and_beam(), jnp.zeros(()), jnp.array([r, theta]), jnp.array([v_r, v_theta]), jnp.array([u])
    )
    np.testing.assert_allclose(mine, printed, rtol=1e-14)


def test_acceleration_is_that_of_the_symbolic_lagrangian():
    t = sp.Symbol("t")
    q = [sp.Function("r")(t), sp.Function("theta")(t)]
    lagrangian = M * q[0].diff(t) ** 2 / 2 + (J + M * q[0] ** 2) * q[1].diff(t) ** 2 / 2 - M * G * q[0] * sp.sin(q[1])
    a = sp.symbols("a_r a_theta")
    equations = [
        (lagrangian.diff(x.diff(t)).diff(t) - lagrangian.diff(x) - tau).subs(
            {y.diff(t, 2): b for y, b in zip(q, a, strict=True)}
        )
        for x, tau in zip(q, (0, U), strict=True)
    ]
    numbers = {M: 2.0, J: 0.3, G: 9.81, U: 1.7, q[0].diff(t): 0.3, q[1].diff(t): -0.5, q[0]: 0.7, q[1]: 0.4}
    solution = sp.solve([e.subs(numbers) for e in equations], a)
    model = ball_and_beam(9.81, 2.0, 0.3)
    mine = acceleration(model, jnp.zeros(()), POINT, jnp.array([0.3, -0.5]), jnp.array([1.7]))
    np.testing.assert_allclose(mine, [float(solution[b]) for b in a], rtol=1e-13)


def test_torque_does_not_push_the_ball():
    model = ball_and_beam()
    pushed = gradient(model.metric, POINT, model.force(jnp.zeros(()), POINT, jnp.array([3.0])))
    np.testing.assert_allclose(pushed, [0.0, 3.0 / (1 + 0.7**2)], rtol=1e-15)
