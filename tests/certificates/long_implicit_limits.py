"""What takes long of `test_implicit_limits.py`."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant.certificates import part_limits
from covariant.geometry import Budget, Euclidean, hyperbolic, sphere
from covariant.models import Lagrangian, free_body
from covariant.observers import LagrangianMetric

GRAVITY = 9.81


PENDULUM = Lagrangian(Euclidean(), lambda q: -GRAVITY * jnp.cos(q[0]), inputs=1)


SIGMA, H = 3.0, 0.02


@eqx.filter_jit
def shares(observer, m0, q, v, q_other, v_other, h):
    """What a step leaves of the length of each error (K,): of two estimates, which see one of the two."""

    def after(q, v, y):
        state = observer.init(jnp.zeros(1))._replace(q=q[None], v=v[None])
        return observer.step(state, jnp.zeros(1), y, h)[0]

    def length(xi, zeta):
        return jnp.sqrt(m0 * xi**2 + (zeta - observer.beta / observer.alpha * xi) ** 2)

    def share(q, v, q_other, v_other):
        y = observer.predict(observer.init(q_other[None])._replace(v=v_other[None]), jnp.zeros(1), h).q
        one, two = after(q, v, y), after(q_other, v_other, y)
        return length(*(a[0] for a in (one.q - two.q, one.v - two.v))) / length(q - q_other, v - v_other)

    return jax.vmap(share)(q, v, q_other, v_other)


def worst_share(part, m0, count, h=H):
    """Over pairs near the top and the bottom or anywhere, apart by 1e-3 to 1000 rad, at all ratios of ξ and w."""
    rng = np.random.default_rng(1)
    gain = part / (h * (1 - part))  # negative for θ > 1, which the observer itself refuses
    observer = LagrangianMetric(PENDULUM, 1.0, 1.0, substeps=4)
    observer = eqx.tree_at(lambda o: (o.alpha, o.beta), observer, (jnp.array(gain), jnp.array(SIGMA * gain)))
    angle, size = rng.uniform(0, 2 * np.pi, count), 10 ** rng.uniform(-3, 3, count)
    q = np.where(rng.uniform(size=count) < 0.5, np.pi * rng.integers(2, size=count), rng.uniform(-np.pi, np.pi, count))
    v = rng.uniform(-3, 3, count) * rng.integers(2, size=count)
    xi = size * np.cos(angle) / np.sqrt(m0)
    zeta = size * np.sin(angle) + SIGMA * xi
    pairs = (jnp.asarray(a) for a in (q + xi, v + zeta, q, v))
    return float(shares(observer, jnp.asarray(m0), *pairs, h=jnp.asarray(h)).max())


def check_a_pendulum(count):
    """No pair violates the bound, at any θ of the interval; some attain it to 1e-3; half of the least θ violates it."""
    for rate in (0.0, 0.5):
        limits = part_limits(H, SIGMA, -GRAVITY, GRAVITY, rate)
        bound = math.exp(-rate * H)
        for part in (limits.least, limits.most):
            assert bound - 1e-3 < worst_share(part, limits.before, count) <= bound * (1 + 1e-9)
        for part in np.linspace(limits.least, limits.most, 5)[1:-1]:
            assert worst_share(part + 1e-9, limits.before, count) <= bound * (1 + 1e-9)
        assert worst_share(limits.least / 2, limits.before, count) > 1.01
        assert worst_share(2 - limits.least / 2, limits.before, count) > 1.01


@pytest.mark.exhaustive
def test_errors_of_a_pendulum_fall_as_proved_however_large():
    check_a_pendulum(5_000)


@pytest.mark.exhaustive
def test_no_error_of_a_million_falls_more_slowly():
    check_a_pendulum(1_000_000)


BUDGET = Budget(newton=2, steps=16)


@eqx.filter_jit
def corrected(observer, q, v, y, age, xi, w):
    """(ξ⁺, w⁺) of a correction, by the derivative of the observer's own step, and its new frame's point."""
    space, manifold, sigma = observer.model.space, observer.model.manifold, observer.beta / observer.alpha

    def correct(s, v):
        state = observer.init(q)._replace(q=manifold.retract(q, s), v=v, age=age)
        new = observer.correct(state, jnp.zeros_like(v), y)[0]
        return new.q, new.v

    new_q, new_v = correct(jnp.zeros_like(v), v)
    shift = w + sigma * xi - space.connection(q, xi, v)  # of the components of v

    def nearby(s, v):
        q, v = correct(s, v)
        return manifold.local(new_q, q), v

    _, (xi_new, change) = jax.jvp(nearby, (jnp.zeros_like(v), v), (xi, shift))
    return xi_new, change + space.connection(new_q, xi_new, new_v) - sigma * xi_new


@eqx.filter_jit
def by_jacobi_field(observer, q, v, y, age, xi, w, kappa):
    """The same by the Jacobi field of constant curvature κ, and Gauss's quadrature."""
    space, sigma = observer.model.space, observer.beta / observer.alpha
    part = observer.alpha * age / (1 + observer.alpha * age)
    along = space.shoot(q, y, budget=BUDGET).velocity
    x = jnp.sqrt(jnp.abs(kappa)) * space.norm(q, along)
    sine = jnp.sin if kappa > 0 else jnp.sinh

    def inner(a, b):
        return space.lower(q, a) @ b

    parallel = inner(xi, along) / inner(along, along) * along

    def field(s):  # in components at q̂, carried in parallel
        return (1 - s) * parallel + sine((1 - s) * x) / sine(x) * (xi - parallel)

    def curved(s):
        moving = v + sigma * s * along
        return kappa * (inner(field(s), moving) * along - inner(along, moving) * field(s))

    nodes, weights = np.polynomial.legendre.leggauss(12)
    gathered = part / 2 * weights @ jax.vmap(curved)(part * (1 + nodes) / 2)
    return space.transport_along(q, part * along, jnp.stack([field(part), w + gathered]), BUDGET).w


SPACES = {
    "sphere": (Lagrangian(sphere()), jnp.array([-0.4, 0.6]), jnp.array([0.5, -0.3]), 1.0),
    "hyperbolic plane": (Lagrangian(hyperbolic()), jnp.array([-0.4, 0.3]), jnp.array([0.3, -0.2]), -1.0),
    "SO(3)": (free_body((1.0, 1.0, 1.0)), jnp.eye(3), jnp.array([0.7, -0.4, 0.9]), 0.25),
}


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", SPACES)
def test_a_correction_follows_the_jacobi_field(name):
    """`ξ⁺ = J(θ)`, `w⁺ = Π(w + ∫₀^θ R(γ', J)(v̂ + σsγ') ds)`: on a curved space w does not stay as it is."""
    model, q, y, kappa = SPACES[name]
    y = model.manifold.retract(q, y) if y.shape != q.shape else y
    observer = LagrangianMetric(model, 12.0, 60.0, BUDGET)
    n = 3 if name == "SO(3)" else 2
    v, xi, w = np.random.default_rng(2).normal(size=(3, n))
    given = (observer, q, jnp.asarray(v), y, jnp.array(0.15), jnp.asarray(xi), jnp.asarray(w))
    np.testing.assert_allclose(jnp.stack(corrected(*given)), by_jacobi_field(*given, kappa), rtol=0, atol=1e-7)
