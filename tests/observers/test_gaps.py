"""Long steps: what a sample tells after a while is no more than what the model's error has become by then."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant.geometry import Euclidean
from covariant.models import Motion
from covariant.observers.base._sampled import LONGEST_GAP, sampled_correction, sampled_gains

ALPHA, BETA = 20.0, 200.0


# The loop of one sample, in one dimension, where the model does `ξ' = ζ, ζ' = Nξ` to an error.


@jax.jit
def corrected(stiffness, dt, xi):
    zero = jnp.zeros(1)
    taken = sampled_correction(Euclidean(), Motion(zero, zero), sampled_gains(ALPHA, BETA, dt), dt, xi, -stiffness * xi)
    return taken.part, taken.velocity, taken.restarted


def loop(stiffness: float, dt: float) -> np.ndarray:
    part, velocity, _ = (float(x[0]) if x.ndim else float(x) for x in corrected(stiffness, dt, jnp.ones(1)))
    root = np.sqrt(complex(stiffness))
    c, s = np.cosh(root * dt), np.sinh(root * dt)
    alone = np.array([[c, s / root], [root * s, c]]).real
    return np.array([[1 - part, 0.0], [velocity, 1.0]]) @ alone


def wanted(dt: float) -> np.ndarray:
    return np.exp(np.roots([1.0, ALPHA, BETA]) * dt)


@pytest.mark.parametrize("stiffness", [-40.0, 40.0])
def test_the_loop_has_the_poles_of_the_law_to_second_order_in_the_step(stiffness):
    gaps = []
    for dt in (0.01, 0.02):
        found = loop(stiffness, dt)
        gaps.append(abs(np.trace(found) - wanted(dt).sum().real))
        assert np.linalg.det(found) == pytest.approx(wanted(dt).prod().real, rel=1e-12)
    assert gaps[1] < 5e-5
    assert np.log2(gaps[1] / gaps[0]) > 3.5  # (N dt²)²


@pytest.mark.parametrize("stiffness", [-100.0, -20.0, 20.0, 100.0])
@pytest.mark.parametrize("dt", np.geomspace(1e-3, 1.0, 13))
def test_it_is_stable_as_long_as_it_does_not_start_anew(stiffness, dt):
    restarted = bool(corrected(stiffness, dt, jnp.ones(1))[2])
    assert restarted == (abs(stiffness) * dt**2 > LONGEST_GAP)
    if not restarted:
        assert np.abs(np.linalg.eigvals(loop(stiffness, dt))).max() < 1


def test_without_an_error_nothing_starts_anew():
    part, velocity, restarted = corrected(100.0, 1.0, jnp.zeros(1))
    assert (float(velocity[0]), bool(restarted)) == (0.0, False)
    assert 0 < float(part) <= 1
