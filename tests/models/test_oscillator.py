"""The same oscillator in the chart q and in r = exp(q)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import geometry
from covariant._adaptive import solve
from covariant.models import acceleration, energy, oscillator

Q, V, U = jnp.array([0.4]), jnp.array([-0.7]), jnp.array([0.3])
R, VR = jnp.exp(Q), jnp.exp(Q) * V
TIME = jnp.zeros(())


@pytest.mark.exhaustive
def test_acceleration_is_the_same_in_both_charts():
    """`r̈ = r(q̈ + q̇²)`."""
    in_q = acceleration(oscillator("q", 2.0), TIME, Q, V, U)
    in_r = acceleration(oscillator("r", 2.0), TIME, R, VR, U)
    np.testing.assert_allclose(in_q, -2.0 * Q + U, rtol=1e-15)
    np.testing.assert_allclose(in_r, R * (in_q + V**2), rtol=1e-14)


def test_energy_is_the_same_in_both_charts():
    np.testing.assert_allclose(energy(oscillator("q", 2.0), Q, V), energy(oscillator("r", 2.0), R, VR), rtol=1e-14)


@pytest.mark.exhaustive
def test_motion_is_the_same_in_both_charts():
    times = jnp.linspace(0.0, 6.0, 25)

    @jax.jit
    def motion(q, v):
        def flow(t, x):
            return x[1], acceleration(oscillator("r", 2.0), t, *x, jnp.zeros(1))

        return solve(flow, (jnp.exp(q), jnp.exp(q) * v), times)[0]

    w = np.sqrt(2.0)
    expected = np.exp(Q[0] * np.cos(w * times) + V[0] / w * np.sin(w * times))
    np.testing.assert_allclose(motion(Q, V)[:, 0], expected, rtol=1e-8)


@pytest.mark.exhaustive
def test_geodesics_in_r_are_exponentials():
    target, metric = jnp.array([3.0]), oscillator("r").metric
    log = jax.jit(lambda p, q: geometry.log(metric, p, q))(R, target)
    np.testing.assert_allclose(log, R * (jnp.log(target) - Q), rtol=1e-10)
    np.testing.assert_allclose(geometry.norm(metric, R, log), np.log(3.0) - Q[0], rtol=1e-10)


def test_unknown_chart_is_named():
    with pytest.raises(ValueError, match="chart must be 'q' or 'r'; got 's'"):
        oscillator("s")
