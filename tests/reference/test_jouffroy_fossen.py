"""Theorem 2's line integrals, (55)–(57) and Remark 3 of Jouffroy & Fossen 2004, by their formulas and by simulation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.models import marine
from covariant.observers import Contracting, PassiveShip, lyapunov_gains

RNG = np.random.default_rng(0)
NODES, WEIGHTS = np.polynomial.legendre.leggauss(12)


def runge_kutta(rate, x, duration, steps):
    """All states (steps + 1, …) of x' = rate(t, x)."""
    h, path = duration / steps, [np.asarray(x, float)]
    for i in range(steps):
        t, x = i * h, path[-1]
        a = rate(t, x)
        b = rate(t + h / 2, x + h / 2 * a)
        c = rate(t + h / 2, x + h / 2 * b)
        path.append(x + h / 6 * (a + 2 * b + 2 * c + rate(t + h, x + h * c)))
    return np.array(path)


def symmetric(a):
    return (a + a.T) / 2


# A mass with a cubic spring, cubic drag and an input that multiplies its velocity; z = x1 + x1³/3.


def f(t, x, u):
    spring = (1 + 0.5 * jnp.cos(t)) * x[0] + x[0] ** 3
    return jnp.stack([x[1], -spring - x[1] - x[1] ** 3 / 2 + u[0] * x[1] + u[0]])


def h(t, x, u):
    return jnp.stack([x[0] + x[0] ** 3 / 3])


def feedback(x):
    return jnp.stack([-2.0 * x[0] - x[1]])


PLANT = models.StateSpace(f, h, coordinates=("x1", "x2"), outputs=("z",), inputs=1)
GAIN = jnp.array([[3.0], [2.0]])


@jax.jit
def jacobians(t, x, u):
    """∂f/∂x and ∂h/∂x at fixed u, and ∂f/∂x with u = β(x) as printed, at states (k, 2)."""
    every = (
        jax.vmap(jax.jacfwd(lambda y: f(t, y, u))),
        jax.vmap(jax.jacfwd(lambda y: h(t, y, u))),
        jax.vmap(jax.jacfwd(lambda y: f(t, y, feedback(y)))),
    )
    return [jacobian(x) for jacobian in every]


def test_mean_jacobians_give_the_error_equation_and_lie_below_their_supremum():
    """(20)–(27): x̃' = (F̄ − KH̄)x̃ exactly, at errors of any size, if the input is that of both; Remark 1 bounds them."""
    observer, gain = Contracting(PLANT, GAIN, jnp.zeros(2)), np.asarray(GAIN)
    flow = jax.jit(lambda t, x, z, u: observer.flow(t, observer.init(z)._replace(x=x), u, z).x)
    for _ in range(5):
        t, (x, estimate) = jnp.asarray(RNG.uniform(0, 6)), RNG.normal(size=(2, 2)) * 2
        u, error = feedback(jnp.asarray(estimate)), x - estimate
        error_rate = np.asarray(f(t, jnp.asarray(x), u) - flow(t, jnp.asarray(estimate), h(t, jnp.asarray(x), u), u))
        on_line = [np.asarray(d) for d in jacobians(t, jnp.asarray(estimate + np.outer((NODES + 1) / 2, error)), u)]
        mean_f, mean_h, printed = (np.einsum("k,kij->ij", WEIGHTS / 2, d) for d in on_line)
        mean = mean_f - gain @ mean_h
        np.testing.assert_allclose(mean @ error, error_rate, atol=1e-10)
        assert np.abs((printed - mean_f) @ error).max() > 0.1
        worst = max(np.linalg.eigvalsh(symmetric(df - gain @ dh))[-1] for df, dh, _ in zip(*on_line, strict=True))
        assert np.linalg.eigvalsh(symmetric(mean))[-1] <= worst + 1e-10


def test_a_mean_may_be_negative_definite_where_the_jacobian_is_not():
    """(19) is weaker than (33): x' = −x³ has the slope 0 at 0, and F̄ = −(x² + xx̂ + x̂²) < 0 off it."""
    for x, estimate in ((1.0, -1.0), (0.5, 0.0), (2.0, -0.3)):
        at = estimate + (NODES + 1) / 2 * (x - estimate)
        mean = np.sum(WEIGHTS / 2 * -3 * at**2)
        assert mean == pytest.approx(-(x**2 + x * estimate + estimate**2))
        assert mean < -0.2
        assert max(-3 * np.linspace(min(x, estimate), max(x, estimate), 101) ** 2) > -0.01


def turning(t):
    c, s = np.cos(3 * t), np.sin(3 * t)
    return np.array([[c, -s], [s, c]])


@pytest.mark.parametrize(("spread", "converges"), [(1.5, True), (4.0, False)])
def test_theorem_2_of_a_linear_system_that_turns(spread, converges):
    """Example 1, two states: x' = A(t)x + B(t)u, z = C(t)x, u = G(t)x̂. F̄ − KH̄ is A − KC, whatever B and G are.

    Its eigenvalues are −1 at each instant, but the symmetric part, with eigenvalues −1 ± spread/2, decides: |x̃| falls
    at half of λ_q = 2 − spread or faster, which is the rate of V_obs in (29).
    """

    def error_matrix(t):
        turn = turning(t)
        return turn @ np.array([[-1.0, spread], [0.0, -1.0]]) @ turn.T

    def a_matrix(t):  # so that A − KC is the above, with K = (1, ½) and C that turns
        return error_matrix(t) + np.outer([1.0, 0.5], turning(t)[0])

    def rate(t, x):
        plant, estimate = x[:2], x[2:]
        u = np.array([-4.0, 3.0]) @ estimate
        moved = [a_matrix(t) @ each + np.array([np.sin(t), 1.0]) * u for each in (plant, estimate)]
        moved[1] += np.array([1.0, 0.5]) * (turning(t)[0] @ (plant - estimate))
        return np.concatenate(moved)

    states = runge_kutta(rate, [0.3, -0.2, -0.5, 1.0], 2.0, 1000)
    errors = states[:, :2] - states[:, 2:]
    sizes, lam = np.linalg.norm(errors, axis=1), 2 - spread
    assert np.linalg.eigvalsh(2 * symmetric(error_matrix(0.7)))[-1] == pytest.approx(-lam)
    slopes = np.gradient(np.log(sizes), 2.0 / 1000)[1:-1]
    assert slopes.max() <= -lam / 2 + 1e-3
    alone = runge_kutta(lambda t, e: error_matrix(t) @ e, errors[0], 2.0, 1000)
    np.testing.assert_allclose(errors, alone, atol=1e-7)
    assert (lam > 0) == converges
    if converges:
        assert slopes.max() > -lam / 2 - 0.05  # the rate is reached
    else:
        assert np.linalg.eigvals(error_matrix(0.7)).real.max() < -0.99  # and yet errors grow for some time
        assert slopes.max() > 0.5


def test_what_the_print_calls_contracting_at_two_and_a_half_grows_at_one_half():
    """Effect of the misprint of Theorem 2: A = B = C = 1, G = −3, K = ½, and A + BG − KC = −2.5."""
    path = runge_kutta(lambda t, x: np.array([x[0], x[1] + (x[0] - x[1]) / 2]) - 3 * x[1], [1.0, 0.5], 2.0, 200)
    assert (path[-1, 0] - path[-1, 1]) / 0.5 == pytest.approx(np.exp(0.5 * 2.0), rel=1e-6)
    assert 1 + 1 * -3 - 0.5 * 1 == -2.5


def test_conditions_with_theta_are_those_with_p_and_hold_for_the_gains_of_the_ship():
    """(55)–(57): the generalised Jacobian of the observer of a moored ship in Θ_i = P_i^½, at several headings."""
    station = marine.Station(marine.supply_vessel(mooring=np.diag([5e4, 5e4, 5e7])))
    mass = np.asarray(station.ship.mass)
    gains = lyapunov_gains(station, mass * 1e-2, mass * 1e-3)
    observer = PassiveShip(station, gains).contracting()
    slope = jax.jit(jax.jacfwd(observer.virtual, 1))
    thetas = []
    for p in (gains.stiffness, gains.inertia):
        values, vectors = np.linalg.eigh(np.asarray(p))
        thetas.append(vectors @ np.diag(np.sqrt(values)) @ vectors.T)
        np.testing.assert_allclose(thetas[-1].T @ thetas[-1], p, rtol=1e-9, atol=1e-3)
    theta = np.block([[thetas[0], np.zeros((3, 3))], [np.zeros((3, 3)), thetas[1]]])
    for heading in (0.0, 1.0, -2.5):
        z = jnp.array([1.0, 2.0, heading])
        jacobian = np.asarray(slope(jnp.zeros(()), jnp.zeros(6), jnp.zeros(3), z))
        general = theta @ jacobian @ np.linalg.inv(theta)
        assert np.linalg.eigvalsh(symmetric(general[:3, :3]))[-1] < 0  # (55), −Θ1K1Θ1⁻¹
        assert np.linalg.eigvalsh(symmetric(general[3:, 3:]))[-1] < 0  # (56), Θ2A2Θ2⁻¹
        c, s = np.cos(heading), np.sin(heading)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        right = thetas[0] @ turn @ np.linalg.inv(thetas[1])
        np.testing.assert_allclose(general[:3, 3:], right, atol=1e-9)
        np.testing.assert_allclose(-general[3:, :3].T, right, atol=1e-9)  # (57)
        # Without cross terms the blocks alone decide; (58) and (59) with its sign corrected are theirs.
        p1, p2 = (np.asarray(p) for p in (gains.stiffness, gains.inertia))
        k1, a2 = -jacobian[:3, :3], jacobian[3:, 3:]
        assert np.linalg.eigvalsh(k1.T @ p1 + p1 @ k1)[0] > 0
        assert np.linalg.eigvalsh(a2.T @ p2 + p2 @ a2)[-1] < 0
        # The printed sign of (54), with P for I, breaks (57).
        wrong = general[3:, :3] + 2 * right.T
        assert np.abs(-wrong.T - right).max() > 0.1


# Remark 3: V' ≤ 0 only. Panteley & Loria's conditions: the estimate converges exponentially, the nominal system is
# uniformly globally asymptotically stable with |∂V/∂e||e| ≤ cV, and the coupling grows at most linearly in e.


def test_a_semidefinite_controller_under_an_exponential_observer_is_asymptotically_stable():
    """A mass, spring and damper whose damping force uses the estimated velocity: V_con is its energy, V_con' = −d e2².

    V = V_con + κx̃² never grows from κ = d/(4λ_q) on, and only rest stays where V' = 0, at e2 = x̃ = 0.
    """
    d, rate = 0.8, 0.5  # x̃' = −rate x̃, so that λ_q of (29) is 2 rate

    def motion(t, z):
        e1, e2, off = z[..., 0], z[..., 1], z[..., 2]
        return np.stack([e2, -e1 - d * (e2 - off), -rate * off], axis=-1)

    def fall(z, kappa):
        """V' for V = ½(e1² + e2²) + κx̃²: the derivative along the motion by hand."""
        return np.einsum("ki,ki->k", z * np.array([1.0, 1.0, 2 * kappa]), motion(0.0, z))

    starts = RNG.normal(size=(200, 3))
    least = d / (8 * rate)  # (c4γ1)²/(4λ_q c3) with c4 = 1, γ1 = d, λ_q = 2 rate and c3 = d, that of e2 alone
    assert fall(starts, 1.0001 * least).max() <= 0
    assert fall(np.array([[0.0, 1.0, 2.0]]), 0.9 * least)[0] > 0
    assert fall(np.array([[1.0, 0.0, 0.0]]), least)[0] == 0  # semidefinite: Theorem 3 does not apply
    path = runge_kutta(motion, 10 * starts, 40.0, 2000)
    values = path[..., 0] ** 2 / 2 + path[..., 1] ** 2 / 2 + 1.01 * least * path[..., 2] ** 2
    assert (np.diff(values, axis=0) <= 1e-12).all()
    assert values[-1].max() < 1e-5 * values[0].max()


def test_semidefinite_gives_no_exponential_rate():
    """e' = −e³ + x̃ is stable, and |e| falls like 1/√(2t): asymptotically, as Remark 3 says, and no more."""
    path = runge_kutta(lambda t, z: np.array([-(z[0] ** 3) + z[1], -z[1]]), [2.0, 3.0], 400.0, 20_000)
    t = np.linspace(0.0, 400.0, 20_001)
    assert abs(path[-1, 0]) == pytest.approx(1 / np.sqrt(2 * t[-1]), rel=0.02)


@pytest.mark.parametrize(("product", "bounded"), [(1.9, True), (2.1, False)])
def test_a_coupling_that_grows_faster_than_linearly_loses_stability(product, bounded):
    """e' = −e + e²x̃, x̃' = −x̃: 1/e is (1/e₀ − x̃₀/2)eᵗ + (x̃₀/2)e⁻ᵗ, which meets 0 if e₀x̃₀ > 2."""

    def inverse(t):
        return (1 - product / 2) * np.exp(t) + product / 2 * np.exp(-t)  # of e₀ = 1

    assert (inverse(np.linspace(0.0, 3.0, 3001)) > 0).all() == bounded
    path = runge_kutta(lambda t, z: np.array([-z[0] + z[0] ** 2 * z[1], -z[1]]), [1.0, product], 1.0, 2000)
    np.testing.assert_allclose(path[:, 0], 1 / inverse(np.linspace(0.0, 1.0, 2001)), rtol=1e-6)
