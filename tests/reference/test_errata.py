"""Every misprint names a test that fails with the printed formula; those that no other file tests are tested here."""

import importlib
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant.papers._errata import SLIPS
from covariant.papers.errata import ERRATA, of
from covariant.verbs._reproduce import PAPERS

ROOT = Path(__file__).parents[2]
RNG = np.random.default_rng(0)


@pytest.mark.parametrize("entry", ERRATA, ids=lambda entry: f"{entry.paper} {entry.where}")
def test_an_erratum_is_complete_and_shown_by_a_test_that_exists(entry):
    assert entry.paper in PAPERS
    assert entry.printed != entry.corrected
    assert all((entry.where, entry.printed, entry.corrected, entry.reason, entry.effect))
    path, _, function = entry.shown_by.partition("::")
    assert re.search(rf"^def {function}\(", (ROOT / path).read_text(encoding="utf-8"), re.MULTILINE)


def test_every_counter_example_is_of_one_erratum():
    keys = [entry.slip for entry in ERRATA if entry.slip]
    assert sorted(keys) == sorted(SLIPS)
    assert len(keys) == len(set(keys))
    assert {entry.paper for entry in ERRATA} == {*PAPERS}
    assert all(of(paper) for paper in PAPERS)
    assert importlib.import_module("covariant.papers.maithripala").PRINTED[0] in SLIPS


def test_the_lyapunov_function_falls_at_half_the_printed_rate():
    """V = ½ zᵀQz with AᵀQ + QA = −I, for the gains of figure 4: V' is −½|z|², and the best λ is 1/λ_max(Q)."""
    alpha, beta = 2**0.5, 0.5
    a, b, c = (1 + beta) / (2 * alpha), (1 + alpha**2 + beta) / (2 * alpha * beta), -0.5
    law, q = np.array([[-alpha, 1.0], [-beta, 0.0]]), np.array([[a, c], [c, b]])
    np.testing.assert_allclose(law.T @ q + q @ law, -np.eye(2), atol=1e-14)
    z = RNG.normal(size=2)
    slope = float(jax.jvp(lambda z: 0.5 * z @ q @ z, (jnp.asarray(z),), (jnp.asarray(law @ z),))[1])
    assert slope == pytest.approx(-0.5 * z @ z)
    best = 1 / np.linalg.eigvalsh(q)[-1]
    assert (best, 2 * best) == (pytest.approx(0.385, abs=5e-4), pytest.approx(0.770, abs=5e-4))


def test_radons_pair_solves_the_riccati_equation():
    """α β⁻¹ changes as (8) has it, with h_xᵀ h_x; the printed h_x h_xᵀ is a matrix of another size."""
    n, p = 4, 2
    fx, hx, alpha, beta = (RNG.normal(size=size) for size in ((n, n), (p, n), (n, n), (n, n)))
    q = np.eye(n)
    moved = (-fx.T @ alpha + hx.T @ hx @ beta, q @ alpha + fx @ beta)
    pi = alpha @ np.linalg.inv(beta)
    _, change = jax.jvp(lambda a, b: a @ jnp.linalg.inv(b), (jnp.asarray(alpha), jnp.asarray(beta)), moved)
    np.testing.assert_allclose(change, -pi @ fx - fx.T @ pi + hx.T @ hx - pi @ q @ pi, atol=1e-10)
    assert (hx @ hx.T).shape == (p, p)


def test_image_of_the_riccati_field_in_other_coordinates():
    """d/dt(φ_x⁻ᵀ π φ_x⁻¹) along a flow, by differentiation and by the corrected formula."""
    mixing = jnp.asarray(np.eye(3) + 0.2 * RNG.normal(size=(3, 3)))
    phi, f = lambda x: mixing @ x + 0.1 * jnp.sin(x), lambda x: jnp.stack([x[1], -x[2] * x[0], jnp.zeros(())])
    root, field = (jnp.asarray(RNG.normal(size=(3, 3))) for _ in range(2))
    x, pi, change = jnp.asarray(RNG.normal(size=3)), root @ root.T, field + field.T

    def image(x, pi):
        inverse = jnp.linalg.inv(jax.jacfwd(phi)(x))
        return inverse.T @ pi @ inverse

    true = jax.jvp(image, (x, pi), (f(x), change))[1]
    slope, turned = jax.jvp(jax.jacfwd(phi), (x,), (f(x),))
    inv = jnp.linalg.inv(slope)
    corrected = -inv.T @ turned.T @ inv.T @ pi @ inv - inv.T @ pi @ inv @ turned @ inv + inv.T @ change @ inv
    np.testing.assert_allclose(corrected, true, atol=1e-12)
    along = slope @ f(x)  # Σ (∂φ/∂x_i) f_i is a vector, and no matrix
    assert along.shape == (3,)
    signs_as_printed = inv @ turned @ inv @ pi @ inv - inv @ pi @ inv @ turned @ inv + inv @ change @ inv
    assert float(jnp.abs(signs_as_printed - true).max()) > 0.1
    assert float(jnp.abs(signs_as_printed - signs_as_printed.T).max()) > 1e-3


def test_dimension_of_symmetric_matrices():
    n = 4
    free = [np.outer(a, b) + np.outer(b, a) for i, a in enumerate(np.eye(n)) for b in np.eye(n)[i:]]
    assert np.linalg.matrix_rank(np.reshape(free, (-1, n * n))) == n * (n + 1) // 2 != n


def test_rate_of_half_a_squared_length():
    f, d = RNG.normal(size=(2, 3, 3))[0], RNG.normal(size=3)
    slope = float(jax.jvp(lambda d: 0.5 * d @ d, (jnp.asarray(d),), (jnp.asarray(f @ d),))[1])
    assert slope == pytest.approx(0.5 * d @ (f + f.T) @ d)


def test_no_lyapunov_matrix_has_the_printed_sign():
    """For a Hurwitz A, AᵀP + PA > 0 has P < 0 as its solution: the P of AᵀP + PA = I is minus that of −I."""
    a = RNG.normal(size=(3, 3))
    a -= (np.linalg.eigvals(a).real.max() + 0.5) * np.eye(3)
    eye = np.eye(3)
    p = np.linalg.solve(np.kron(a.T, eye) + np.kron(eye, a.T), eye.reshape(-1)).reshape(3, 3)
    np.testing.assert_allclose(a.T @ p + p @ a, eye, atol=1e-10)
    assert np.linalg.eigvalsh((p + p.T) / 2)[-1] < 0


def test_slope_of_a_quadratic_drag():
    d, v = jnp.array([1.0, 2.0]), jnp.array([0.3, -0.7])
    slope = jax.jacfwd(lambda v: -d * jnp.abs(v) * v)(v)
    np.testing.assert_allclose(slope, -2 * np.diag(d * np.abs(v)), atol=1e-15)
