"""Constants and hypotheses of Sanfelice & Praly 2015, computed for their oscillator and compared with what happens.

Lemma 4.1 says that bounds exist. These are some: with a, c and q̲, q̄ as in the paper,

    p̄ = (a + √(a² + c²q̲))/q̲,   1/p̲ = 1/ε + κ²q̄(e^{2aτ} − 1)/(2a),   κ = c²(e^{2aτ} − 1)/(2aε).

For p̄, the largest eigenvalue μ of Π obeys μ' ≤ 2aμ + c² − q̲μ². For p̲, Π⁻¹ is the error covariance of the best linear
estimate, and so at most that of the deadbeat estimate from the outputs of the last τ.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_jouffroy_fossen import runge_kutta

from covariant import models
from covariant.metrics import Equation, metric_through, spd_distance
from covariant.papers import sanfelice_praly as paper

OSCILLATOR = models.unknown_frequency()


class Constants(NamedTuple):
    """The suprema of Proposition 2.2, and ε and τ of (6)."""

    a: float
    c: float
    q_low: float
    q_high: float
    epsilon: float
    tau: float

    @property
    def growth(self):
        """∫₀^τ e^{2at} dt."""
        return np.expm1(2 * self.a * self.tau) / (2 * self.a)

    @property
    def p_high(self):
        return (self.a + np.sqrt(self.a**2 + self.c**2 * self.q_low)) / self.q_low

    @property
    def p_low(self):
        kappa = self.c**2 * self.growth / self.epsilon
        return 1 / (1 / self.epsilon + kappa**2 * self.q_high * self.growth)

    @property
    def decrease(self):
        """The factor of (23)."""
        return np.exp(-(self.p_high * self.q_high + 2 * self.a) * self.tau)

    @property
    def p_uniform(self):
        """(27)."""
        return self.p_low * self.decrease


# The set Ω: orbits with 0.5 ≤ x3 ≤ 1 and 0.5 ≤ x3 x1² + x2² ≤ 1.


def states():
    squares, energies, phases = np.meshgrid([0.5, 0.75, 1.0], [0.5, 1.0], np.arange(8) * np.pi / 4, indexing="ij")
    w = np.sqrt(squares)
    x = np.stack([np.sqrt(energies) * np.cos(phases) / w, np.sqrt(energies) * np.sin(phases), squares], axis=-1)
    return x.reshape(-1, 3)


def solution(x, t):
    """X(x, t) in closed form."""
    w = np.sqrt(x[:, 2])
    c, s = np.cos(w * t), np.sin(w * t)
    return np.stack([c * x[:, 0] + s / w * x[:, 1], c * x[:, 1] - s * w * x[:, 0], x[:, 2]], axis=1)


def slope(x):
    """∂f/∂x at states (k, 3)."""
    zero, one = np.zeros(len(x)), np.ones(len(x))
    rows = [[zero, one, zero], [-x[:, 2], zero, -x[:, 0]], [zero, zero, zero]]
    return np.moveaxis(np.array(rows), 2, 0)


def noise(x):
    """A field Q with bounds ½ and 1.2 on Ω: 0.2 + x3, ½ + x2²/2 and 1."""
    return np.stack([np.diag([0.2 + each[2], 0.5 + each[1] ** 2 / 2, 1.0]) for each in x])


def swapped(a):
    return np.swapaxes(a, 1, 2)


def riccati(x, start, duration, steps):
    """Π along the solutions from x by Runge–Kutta steps, all instants (steps + 1, k, 3, 3)."""
    square = np.diag([1.0, 0.0, 0.0])

    def rate(t, p):
        at = solution(x, t)
        turned = p @ slope(at)
        return -turned - swapped(turned) + square - p @ noise(at) @ p

    return runge_kutta(rate, np.broadcast_to(start, (len(x), 3, 3)), duration, steps)


def transition(x, t, h=1e-5):
    """Φ_x(t, 0) by differences of the solution."""
    return np.stack([(solution(x + h * e, t) - solution(x - h * e, t)) / (2 * h) for e in np.eye(3)], axis=2)


def reconstructibility(x, tau, steps=400):
    """ε of (6): the least eigenvalue of the Gramian over the past τ."""
    t = (np.arange(steps) + 0.5) * tau / steps
    rows = np.array([transition(x, -s)[:, 0] for s in t])
    return np.linalg.eigvalsh(np.einsum("tki,tkj->kij", rows, rows) * tau / steps)[:, 0].min()


@pytest.fixture(scope="module")
def constants():
    x, tau = states(), 2.0
    q = np.linalg.eigvalsh(noise(x))
    a = np.linalg.norm(slope(x), ord=2, axis=(1, 2)).max()
    return Constants(a, 1.0, q[:, 0].min(), q[:, -1].max(), reconstructibility(x, tau), tau)


def test_bounds_of_q_are_those_of_its_formula_and_of_the_library(constants):
    """(7) for a field Q over Ω."""
    assert (constants.q_low, constants.q_high) == (0.5, 1.2)
    x = states()
    field = Equation(process_cov=lambda x: jnp.diag(jnp.stack([0.2 + x[2], 0.5 + x[1] ** 2 / 2, jnp.ones(())])))
    np.testing.assert_allclose(jax.vmap(field.noise)(jnp.asarray(x)), noise(x), rtol=1e-12)


def test_the_set_is_backward_invariant_and_the_grid_of_figure_1_is_not(constants):
    """Proposition 2.2 i): x3 and x3 x1² + x2² do not change along f; the grid's box is left at once."""
    x = states()
    for conserved in (lambda z: z[2], lambda z: z[2] * z[0] ** 2 + z[1] ** 2):
        for each in x:
            f = OSCILLATOR.f(jnp.zeros(()), jnp.asarray(each), jnp.zeros(0))
            assert abs(float(jax.jvp(conserved, (jnp.asarray(each),), (f,))[1])) < 1e-12
    low, high = np.array(OSCILLATOR.box).T
    before = solution(paper.grid(), -0.1)
    assert ((before < low - 1e-9) | (before > high + 1e-9)).any(axis=1).mean() > 0.3
    assert constants.epsilon > 5e-4  # uniformly reconstructible


def test_bounds_of_lemma_4_1_and_the_uniform_rate_of_4_2_hold_for_the_oscillator(constants):
    """(23), (24), (26) and (27), from starts at both ends of the interval; in truth the decay is far faster."""
    x, k = states(), constants
    t = np.linspace(0.0, 3 * k.tau, 601)
    low, high = (riccati(x, start * np.eye(3), 3 * k.tau, 600) for start in (0.1, k.p_high))
    late = t >= k.tau
    for start, p in ((0.1, low), (k.p_high, high)):
        values = np.linalg.eigvalsh(p)
        assert (values[..., 0] >= start * k.decrease).all()
        assert (values[..., -1] <= k.p_high * (1 + 1e-9)).all()
        assert (values[late, :, 0] >= k.p_low).all()
    apart = np.asarray(jax.jit(jax.vmap(jax.vmap(spd_distance)))(jnp.asarray(low[::60]), jnp.asarray(high[::60])))
    least = np.minimum(*(np.linalg.eigvalsh(p)[..., 0] for p in (low, high)))
    passed = np.concatenate([np.zeros((1, len(x))), np.cumsum((least[1:] + least[:-1]) / 2 * t[1], axis=0)])[::60]
    assert (np.log(apart / apart[0]) <= -k.q_low * passed + 1e-6).all()
    assert (least >= k.p_uniform).all()
    slowest = -np.log(apart[-1] / apart[0]).max() / t[-1]
    # The table of `docs/sanfelice-praly.md`.
    shown = (k.a, k.epsilon, k.p_high, k.p_low, k.q_low * k.p_uniform)
    np.testing.assert_allclose(shown, (1.5, 7.8e-4, 6.3, 2.1e-13, 6.9e-23), rtol=0.02)
    seen = (np.linalg.eigvalsh(high[late])[..., -1].max(), np.linalg.eigvalsh(low[late])[..., 0].min(), slowest)
    np.testing.assert_allclose(seen, (1.9, 0.05, 0.64), rtol=0.02)


def test_the_flow_is_that_of_the_library_and_its_limit_has_the_bounds_of_9(constants):
    x = states()[::7]
    past = solution(x, -12.0)
    ends = riccati(past, 0.5 * np.eye(3), 12.0, 600)[-1]
    field = Equation(process_cov=lambda x: jnp.diag(jnp.stack([0.2 + x[2], 0.5 + x[1] ** 2 / 2, jnp.ones(())])))
    through = jax.jit(jax.vmap(lambda x: metric_through(OSCILLATOR, field, x, 12.0, 600, start=0.5).metric[-1]))
    np.testing.assert_allclose(through(jnp.asarray(x)), ends, atol=1e-6)
    values = np.linalg.eigvalsh(ends)
    assert constants.p_low <= values.min() <= values.max() <= constants.p_high


def scalar_riccati(f, c, q, start, duration, steps=2000):
    """π of x' = fx, y = cx at `duration`."""
    h, p = duration / steps, np.asarray(start, float)

    def rate(p):
        return -2 * f * p + c**2 - q * p**2

    for _ in range(steps):
        k1 = rate(p)
        k2 = rate(p + h / 2 * k1)
        k3 = rate(p + h / 2 * k2)
        p = p + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(p + h * k3))
    return p


def test_constants_of_lemma_4_1_and_4_2_are_sharp_for_one_state():
    """x' = ∓ax: p̄ is an equilibrium; (23) and (26) are equalities to first order in time where c is small."""
    a, c, q = 0.7, 1.3, 0.9
    k = Constants(a, c, q, q, 1.0, 1.0)
    assert scalar_riccati(-a, c, q, k.p_high, 20.0) == pytest.approx(k.p_high, rel=1e-9)
    assert scalar_riccati(-a, c, q, 0.01, 20.0) == pytest.approx(k.p_high, rel=1e-9)
    k = Constants(a, 1e-4, q, q, 1.0, 1e-3)
    assert np.log(scalar_riccati(a, k.c, q, k.p_high, k.tau) / k.p_high) == pytest.approx(np.log(k.decrease), rel=2e-3)
    pair = np.array([1.0, 1.001])
    ratio = np.log(scalar_riccati(a, k.c, q, pair, k.tau))
    assert np.log((ratio[1] - ratio[0]) / np.log(1.001)) == pytest.approx(-q * pair[0] * k.tau, rel=3e-3)
    # No start is forgotten sooner than the outputs allow: (24) needs the noise term of p̲.
    tau, f = 0.5, 1e-3
    k = Constants(f, c, 4.0, 4.0, c**2 * (1 - np.exp(-2 * f * tau)) / (2 * f), tau)
    least = scalar_riccati(f, c, 4.0, 1e-9, tau)
    assert k.p_low <= least < k.epsilon


@pytest.mark.parametrize(("rate", "seen"), [(4.0, (2.3e-5, 0.25)), (6.0, (6.3e-6, 0.17))])
def test_bounds_of_the_weighted_gramian(constants, rate, seen):
    """(31), (32) and the bounds below (32), for λ > 2a; the printed P lies between them."""
    k, x = constants, states()
    assert rate > 2 * k.a
    for t in (0.5, 2.0, 5.0):
        assert (np.linalg.norm(transition(x, -t), ord=2, axis=(1, 2)) <= np.exp(k.a * t)).all()
    values = np.linalg.eigvalsh(np.asarray(jax.vmap(paper.analytic_metric(rate))(jnp.asarray(x))))
    low, high = k.epsilon * np.exp(-rate * k.tau), k.c**2 / (rate - 2 * k.a)
    assert low <= values.min() <= values.max() <= high
    np.testing.assert_allclose((values.min(), values.max()), seen, rtol=0.02)
    assert values.min() < k.epsilon  # without the factor e^(−λτ) the bound is wrong
    # For x' = −ax, y = cx the upper bound is P itself, since Φ(t, 0) = e^(−at).
    t = (np.arange(200_000) + 0.5) * 1e-4
    exact = np.sum(k.c**2 * np.exp(-(rate - 2 * k.a) * t)) * 1e-4
    assert exact == pytest.approx(high, rel=1e-4)


def test_completeness_follows_from_a_lower_bound_and_the_printed_metric_has_none():
    """G-7. g ≥ 1 of the ball and beam: geodesics stay within their length. P: a finite way to where it is no metric."""
    rng, steps = np.random.default_rng(0), 400
    q0, v = rng.normal(size=(50, 2)), rng.normal(size=(50, 2))
    metric = jax.vmap(models.ball_and_beam().metric)
    assert np.linalg.eigvalsh(np.asarray(metric(jnp.asarray(q0 * 10)))).min() >= 1.0
    v *= (5.0 / np.sqrt(v[:, 0] ** 2 + (1 + q0[:, 0] ** 2) * v[:, 1] ** 2))[:, None]

    def change(z):
        r, dr, dt = z[:, 0], z[:, 2], z[:, 3]
        return np.stack([dr, dt, r * dt**2, -2 * r / (1 + r**2) * dr * dt], axis=1)

    z, h = np.concatenate([q0, v], axis=1), 1 / steps
    for _ in range(steps):
        k1 = change(z)
        k2 = change(z + h / 2 * k1)
        k3 = change(z + h / 2 * k2)
        z = z + h / 6 * (k1 + 2 * k2 + 2 * k3 + change(z + h * k3))
    gone = np.linalg.norm(z[:, :2] - q0, axis=1)
    assert gone.max() <= 5.0 + 1e-6
    assert gone.max() > 4.5
    np.testing.assert_allclose(z[:, 2] ** 2 + (1 + z[:, 0] ** 2) * z[:, 3] ** 2, 25.0, rtol=1e-6)

    p = jax.vmap(paper.analytic_metric(2.0))
    way = np.outer((np.arange(1000) + 0.5) / 1000, [1.0, 0.5, 0.0]) + np.array([0.0, 0.0, 1.0])
    direction = np.array([1.0, 0.5, 0.0])
    length = np.sqrt(np.einsum("i,kij,j->k", direction, np.asarray(p(jnp.asarray(way))), direction)).mean()
    assert length == pytest.approx(0.53, abs=0.005)
    least = np.linalg.eigvalsh(np.asarray(p(jnp.asarray(way[[0, -1]]))))[:, 0]
    assert least[0] < 1e-5 * least[1]
