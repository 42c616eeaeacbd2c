"""The same oscillator in the chart q and in r = exp(q)."""

import jax.numpy as jnp
import numpy as np
import pytest

from covariant.models import acceleration, energy, oscillator

Q, V, U = jnp.array([0.4]), jnp.array([-0.7]), jnp.array([0.3])
R, VR = jnp.exp(Q), jnp.exp(Q) * V
TIME = jnp.zeros(())


def test_acceleration_is_the_same_in_both_charts():
    """`r̈ = r(q̈ + q̇²)`."""
    in_q = acceleration(oscillator("q", 2.0), TIME, Q, V, U)
    in_r = acceleration(oscillator("r", 2.0), TIME, R, VR, U)
    np.testing.assert_allclose(in_q, -2.0 * Q + U, rtol=1e-15)
    np.testing.assert_allclose(in_r, R * (in_q + V**2), rtol=1e-14)


def test_energy_is_the_same_in_both_charts():
    np.testing.assert_allclose(energy(oscillator("q", 2.0), Q, V), energy(oscillator("r", 2.0), R, VR), rtol=1e-14)


def test_unknown_chart_is_named():
    with pytest.raises(ValueError, match="chart must be 'q' or 'r'; got 's'"):
        oscillator("s")
