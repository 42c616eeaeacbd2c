"""What takes long of `test_lagrangian_metric.py`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from charts import Pullback

from covariant.geometry import Budget, Euclidean, distance, exp, hyperbolic, log, sphere, transport
from covariant.models import Lagrangian, free_body
from covariant.observers import Intrinsic, LagrangianMetric
from covariant.signals import StepCode

ALPHA, BETA = 12.0, 60.0


@pytest.mark.exhaustive
def test_a_sample_counts_for_the_time_since_the_last_one():
    """Rows without a measurement change nothing, and the next one has waited for all of them."""
    observer = LagrangianMetric(Lagrangian(Euclidean(), inputs=1), 6.0, 12.0)
    state, u, y = observer.init(jnp.zeros(1)), jnp.zeros(1), jnp.array([8.0])
    once, _ = observer.step(state, u, y, 0.5)
    state, info = observer.step(state, u, jnp.array([jnp.nan]), 0.3)
    assert int(info.result) == StepCode.COASTED
    state, info = observer.step(state, u, y, 0.2)
    assert int(info.result) == StepCode.OK
    np.testing.assert_allclose([state.q, state.v], [once.q, once.v], rtol=1e-14)


def test_the_largest_gain_takes_the_measurement():
    """And moves the velocity by σ times the error, however large α is."""
    observer = LagrangianMetric(Lagrangian(Euclidean(), inputs=1), 1e12, 2e12)
    state, _ = observer.step(observer.init(jnp.zeros(1)), jnp.zeros(1), jnp.array([100.0]), 0.1)
    np.testing.assert_allclose([state.q.item(), state.v.item()], [100.0, 200.0], rtol=1e-10)


ROUND = Lagrangian(sphere(), lambda q: 0.4 * q[0] + 0.3 * q[0] * q[1])


def test_a_step_on_the_sphere_is_along_the_geodesic():
    observer = LagrangianMetric(ROUND, ALPHA, BETA)
    y, v, h = jnp.array([0.5, -0.3]), jnp.array([0.4, 0.9]), 0.05
    state = observer.init(jnp.array([-0.4, 0.6]))._replace(v=v, age=jnp.array(h))
    new, info = observer.correct(state, jnp.zeros(2), y)
    theta, sigma = ALPHA * h / (1 + ALPHA * h), BETA / ALPHA
    ahead = log(ROUND.space, state.q, y)
    end = exp(ROUND.space, state.q, theta * ahead)
    np.testing.assert_allclose(new.q, end, atol=1e-12)
    np.testing.assert_allclose(new.v, transport(ROUND.space, state.q, v + sigma * theta * ahead, end), atol=1e-12)
    apart = distance(ROUND.space, state.q, y)
    assert info.distance.item() == pytest.approx(apart.item(), rel=1e-12)
    assert distance(ROUND.space, new.q, y).item() == pytest.approx((1 - theta) * apart.item(), rel=1e-10)


def bend(q):
    return jnp.stack([q[0] + 0.2 * q[1] ** 2, q[1]])


def unbend(z):
    return jnp.stack([z[0] - 0.2 * z[1] ** 2, z[1]])


def sampled(observer, q, v, rows):
    """Position and velocity (2, n) after samples `(h, y)` (K,), (K, n) at irregular times."""

    def step(state, row):
        return observer.step(state, jnp.zeros(2), row[1], row[0])[0], None

    state = jax.lax.scan(step, observer.init(q)._replace(v=v), rows)[0]
    return jnp.stack([state.q, state.v])


@eqx.filter_jit
def gap_between_charts(plain, bent):
    """Largest difference of the estimates by two observers of one system in two charts, after some samples."""
    h = jnp.array([0.05, 0.1, 0.02, 0.2, 0.08])
    y = jnp.stack([0.3 * jnp.cos(jnp.arange(5.0)), 0.4 * jnp.sin(jnp.arange(5.0))], axis=1)
    q, v = jnp.array([-0.3, 0.5]), jnp.array([0.7, -0.4])
    q_bent, v_bent = jax.jvp(bend, (q,), (v,))
    first = sampled(plain, q, v, (h, y))
    q, v = sampled(bent, q_bent, v_bent, (h, jax.vmap(bend)(y)))
    return jnp.abs(first - jnp.stack(jax.jvp(unbend, (q,), (v,)))).max()


BENT_ROUND = Lagrangian(Pullback(sphere(), unbend, bend), lambda z: ROUND.potential(unbend(z)))


@pytest.mark.exhaustive
def test_samples_give_the_same_estimate_in_two_charts_of_the_sphere():
    plain, bent = (LagrangianMetric(model, ALPHA, BETA, substeps=20) for model in (ROUND, BENT_ROUND))
    assert gap_between_charts(plain, bent) < 1e-8
    plain, bent = (Intrinsic(model, ALPHA, BETA, substeps=20) for model in (ROUND, BENT_ROUND))
    assert gap_between_charts(plain, bent) > 1e-3


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
