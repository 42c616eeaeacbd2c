"""Shooting for geodesics: outcome, conjugate points, derivatives, and the fixed budget of real time."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import geometry
from covariant.geometry import Budget, Metric, _geodesics
from covariant.models import ball_and_beam
from covariant.signals import StepCode

SPHERE = geometry.sphere()
NUMERIC = Metric(SPHERE)
BUDGET = Budget(steps=12)
P, Q = jnp.array([[0.3, -0.4], [-0.2, 0.5]])

shoot = jax.jit(lambda p, q, guess: geometry.shoot(NUMERIC, p, q, guess, BUDGET))


def close(a, b, tolerance):
    np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * max(1.0, np.abs(b).max()))


# Outcome


def test_log_is_nan_where_not_converged():
    """A fixed budget stays short of the target, which `shoot` shows and `log` does not hide."""
    far = jnp.array([-1.0, 0.0]), jnp.array([2.0, 1.5])
    metric, budget = ball_and_beam().metric, Budget(newton=0, steps=1)
    shot, log = jax.jit(lambda p, q: (geometry.shoot(metric, p, q, None, budget), geometry.log(metric, p, q, budget)))(
        *far
    )
    assert shot.result == StepCode.NOT_CONVERGED
    assert np.isnan(log).all()


def test_each_stage_of_a_search_starts_where_the_one_before_points(monkeypatch):
    """In flat space that is the answer: on the way to a target the velocity grows as the distance does."""
    seen = []

    def search(space, p, target, start, budget):
        jax.debug.callback(lambda *pair: seen.append(pair), target.s, start, ordered=True)
        return jnp.where(jnp.isnan(start), start, target.s)

    monkeypatch.setattr(_geodesics, "damped_newton", search)
    found = _geodesics.find_geodesic(
        geometry.Euclidean(), P, _geodesics.aim(geometry.Euclidean(), P, Q - P), jnp.full(2, jnp.nan), BUDGET
    )
    jax.effects_barrier()
    (_, direct), *stages = seen
    assert np.isnan(direct).all()
    fractions = np.arange(1, _geodesics.CONTINUATION_STAGES + 1) / _geodesics.CONTINUATION_STAGES
    for fraction, (answer, start) in zip(fractions, stages, strict=True):
        close(answer, fraction * (Q - P), 1e-15)
        close(start, answer, 1e-15)
    close(found, Q - P, 1e-15)


# Conjugate points


# Derivatives


# The fixed budget


def test_near_ends_need_a_number_of_corrections():
    """Without one the search iterates until it converges, which is not what was asked for."""
    with pytest.raises(ValueError, match="near=True makes a fixed number of corrections; name it, as in newton=1"):
        geometry.shoot(NUMERIC, P, Q, None, Budget(near=True))
