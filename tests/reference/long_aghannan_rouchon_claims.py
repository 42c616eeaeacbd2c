"""What Aghannan & Rouchon say about convergence in words, and what `docs/aghannan-rouchon.md` adds, in numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.certificates import contraction_rate, lyapunov, tangent_metric
from covariant.geometry import Budget
from covariant.observers import Geodesic, Intrinsic, ModelCopy
from covariant.papers import aghannan_rouchon as paper
from covariant.papers._errata import PrintedBallAndBeam
from covariant.simulation import observe

BEAM = models.ball_and_beam()


def gains(omega):
    return jnp.asarray(2 * omega), jnp.asarray(omega**2)


@pytest.mark.parametrize(
    ("observer", "low", "high"), [(ModelCopy, 1.0, 1.5), pytest.param(None, 1.2, 2.0, marks=pytest.mark.exhaustive)]
)
def test_with_large_gains_the_printed_observer_and_the_copy_converge(observer, low, high):
    """Appendix I-C, from the start of figure 4: (15) from ω0 = 1.5 on and not at 1, (14) as printed from 2, not 1.2."""

    def left(omega):
        alpha, beta = gains(omega)
        chosen = observer(BEAM, alpha, beta) if observer else PrintedBallAndBeam(alpha, beta)
        return paper.figure4(chosen, (0.0, 60.0), rtol=1e-8).error[-1]

    assert left(low) > 0.5
    assert left(high) < 1e-11
    assert left(2 * high) < 1e-11


@pytest.mark.parametrize("omega", [0.5**0.5, 20.0])
def test_noise_passes_with_large_gains(omega):
    """Of 0.01 m at 50 rad/s, r̂ keeps |αs + β|/|s² + αs + β|: 3 % with the gains of figure 4, 70 % with ω0 = 20.

    In v̂_r it is βs over the same with the large gains; with the small ones the curvature term at v̂_θ adds to β.
    """
    alpha, beta = gains(omega)
    window = 40.0 + 0.4 * np.pi * np.arange(400) / 400  # whole periods of both disturbances, at 50 and at 40 rad/s
    run = paper.figure4(Intrinsic(BEAM, alpha, beta), np.concatenate([[0.0], window]), noisy=True, rtol=1e-8)
    off = (run.estimate - run.x)[1:, [0, 2]]
    position, velocity = 2 * np.abs((off * np.exp(-50j * window)[:, None]).mean(axis=0))
    s = 50j
    transfer = np.abs(np.array([alpha * s + beta, beta * s]) / (s**2 + alpha * s + beta))
    assert position == pytest.approx(0.01 * transfer[0], rel=0.05)
    assert transfer[0] == pytest.approx(0.7 if omega > 1 else 0.028, rel=0.02)
    if omega > 1:
        assert velocity == pytest.approx(0.01 * transfer[1], rel=0.05)
    else:
        assert velocity < 1e-3


def test_the_velocity_estimate_may_be_far_off():
    """Section V: contraction at q̂ = q for every v̂. From the right position, 20 rad/s and 10 m/s off, (2) converges."""
    observer = Geodesic(BEAM, paper.ALPHA, paper.BETA, Budget(steps=4))
    x0 = jnp.array(paper.TRUTH)
    state = observer.init(x0[:2])._replace(v=jnp.array([10.0, -20.0]))
    x, states = observe(BEAM, observer, x0, state, jnp.array([0.0, 1.0, 40.0]), paper.feedback, rtol=1e-8, atol=1e-10)
    error = np.linalg.norm(np.concatenate([states.q, states.v], axis=1) - np.asarray(x), axis=1)
    assert error[0] > 22
    assert error[1] > 1
    assert error[2] < 1e-4


def test_contraction_of_the_approximate_observer_ends_at_an_error_of_about_a_tenth():
    """(12) in the metric of figure 4's gains, at the speed 1: λ > 0 for errors of 0.1, and not of 0.12."""
    metric = tangent_metric(BEAM.space, lyapunov(paper.ALPHA, paper.BETA))
    observer, rng, trials = Intrinsic(BEAM, paper.ALPHA, paper.BETA), np.random.default_rng(0), 4000

    @jax.jit
    @jax.vmap
    def rate(q, v, e):
        def flow(t, z):
            moved = observer.flow(t, observer.init(q - e)._replace(q=z[:2], v=z[2:]), jnp.zeros(1), q - e)
            return jnp.concatenate([moved.q, moved.v])

        return contraction_rate(flow, metric, jnp.zeros(()), jnp.concatenate([q, v]))

    def least(error, speed=1.0):
        q = rng.uniform(-1, 1, (trials, 2)) * np.array([0.1, 0.9])  # where the motion of figure 4 is
        turn = np.exp(1j * rng.uniform(0, 2 * np.pi, (2, trials)))
        unit = np.stack([turn.real, turn.imag / np.sqrt(1 + q[:, 0] ** 2)], axis=2)
        return float(rate(*map(jnp.asarray, (q, speed * unit[0], error * unit[1]))).min())

    assert least(0.0) == pytest.approx(0.385, abs=5e-4)
    assert least(0.1) > 0 > least(0.12)
    assert least(0.05, 2.3) < 0  # at the speed of figure 4 it is less


def other_chart(z):
    """r = sinh σ and θ = φ + 0.3 σ², from (σ, φ)."""
    return jnp.stack([jnp.sinh(z[0]), z[1] + 0.3 * z[0] ** 2])


def in_other_chart(x):
    """State (σ, φ, σ', φ') of a state in (r, θ)."""
    sigma = jnp.arcsinh(x[0])
    z = jnp.stack([sigma, x[1] - 0.3 * sigma**2])
    return jnp.concatenate([z, jnp.linalg.solve(jax.jacfwd(other_chart)(z), x[2:])])


def back(z):
    return jnp.concatenate([other_chart(z[:2]), jax.jacfwd(other_chart)(z[:2]) @ z[2:]])


def other_beam():
    """The ball and beam in the coordinates σ and φ."""

    def metric(z):
        j = jax.jacfwd(other_chart)(z)
        return j.T @ BEAM.metric(other_chart(z)) @ j

    def torque(t, z, u):
        return jax.jacfwd(other_chart)(z).T @ jnp.stack([jnp.zeros_like(u[0]), u[0]])

    return models.Lagrangian(
        metric, lambda z: BEAM.potential(other_chart(z)), torque, coordinates=("sigma", "phi"), inputs=1
    )


@pytest.mark.exhaustive("geodesic")
@pytest.mark.parametrize(
    ("make", "least", "most"),
    [
        pytest.param(Intrinsic, 0.44, 0.46, id="intrinsic"),
        pytest.param(lambda *a: Geodesic(*a, Budget()), 0.0, 1e-9, id="geodesic"),
    ],
)
def test_in_another_chart_the_approximate_observer_is_another_one_and_the_exact_one_is_not(make, least, most):
    """Figure 4 in σ and φ: the largest distance between the estimates, both in (r, θ, v_r, v_θ)."""
    t, x0, start = jnp.linspace(0.0, 10.0, 101), jnp.array(paper.TRUTH), jnp.array(paper.ESTIMATE)
    estimates = []
    for model, to, of in ((BEAM, lambda x: x, lambda x: x), (other_beam(), in_other_chart, back)):
        observer = make(model, paper.ALPHA, paper.BETA)
        begin = to(start)
        state = observer.init(begin[:2])._replace(v=begin[2:])
        _, states = observe(
            model, observer, to(x0), state, t, lambda t, x, of=of: paper.feedback(t, of(x)), rtol=1e-11, atol=1e-13
        )
        estimates.append(np.asarray(jax.vmap(of)(jnp.concatenate([states.q, states.v], axis=1))))
    assert least <= np.linalg.norm(estimates[0] - estimates[1], axis=1).max() <= most
