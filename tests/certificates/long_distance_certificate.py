"""What takes long of `test_distance_certificate.py`."""

import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_distance_certificate import FLAT

from covariant import geometry, models
from covariant.certificates import certify_distance
from covariant.certificates.theory._distance_certificate import _curvature, _Model, _stiffness
from covariant.models import source
from covariant.observers import LagrangianMetric
from scalargraph.proofs import box

BEAM = np.array([-2.5, -4.0]), np.array([2.5, 4.0])


def with_part(model, part, sigma, interval):
    alpha = part / (interval * (1 - part))
    return LagrangianMetric(model, alpha, sigma * alpha)


@pytest.mark.exhaustive
@pytest.mark.parametrize("model", [models.ball_and_beam(), models.pendulum_chain()], ids=["beam", "pendulum"])
def test_curvature_and_stiffness_are_those_of_the_geometry(model):
    """The formulas from derivatives of the metric, against the space, and −∇S against differences of S."""
    q, u = jnp.array([0.3, 0.7]), 0.4 * jnp.ones(model.inputs)
    domain = box(**dict.fromkeys(model.coordinates, (-1.0, 1.0)))
    known = _Model.of(model, domain, np.zeros((2, model.inputs)))
    z = jnp.concatenate([q, u])
    det = jnp.linalg.det(model.space(q))
    bend = known.form(lambda g, dg, ddg, f, df: _curvature(g, dg, ddg)[None, None])(z)[0, 0] / det**2
    assert float(bend) == pytest.approx(float(geometry.sectional_curvature(model.space, q, *jnp.eye(2))), rel=1e-10)
    stiff = known.form(_stiffness)(z) / det
    t = jnp.zeros(())
    at = source(model, t, q, u)
    slope = jax.jacfwd(source, 2)(model, t, q, u)
    columns = [slope[:, i] + model.space.connection(q, jnp.eye(2)[i], at) for i in range(2)]
    np.testing.assert_allclose(stiff, -model.space(q) @ jnp.stack(columns, 1), rtol=1e-9, atol=1e-9)


@pytest.mark.exhaustive
def test_a_flat_space_has_no_turning():
    """K is 0 and 2 1/s²; a certificate follows, and none for samples that are too far apart."""
    bounds = {"position": (-1e3, 1e3), "velocity": 1.0, "error": 5.0}
    certificate = certify_distance(with_part(FLAT, 0.9, 4.0, 0.05), interval=0.05, **bounds)
    assert certificate.statement.proved
    assert certificate.decay.turning == 0
    assert certificate.bounds.stiffness[0] <= 0
    assert 2 <= certificate.bounds.stiffness[1] < 2.2
    late = certify_distance(with_part(FLAT, 0.9, 4.0, 2.0), interval=2.0, **bounds)
    assert late.statement.verdict == "undecided"
    printed = str(late.statement)
    assert not re.search(r"\bnan\b", printed)
    for known in ("1/s or faster", "radius ", "metric: m"):  # there is no such metric without a rate
        assert known in str(certificate.statement)
        assert known not in printed


@pytest.mark.exhaustive
def test_the_ball_and_beam_is_proved():
    observer = with_part(models.ball_and_beam(), 0.95, 20.0, 0.01)
    certificate = certify_distance(observer, interval=0.01, position=BEAM, velocity=0.25, error=0.25)
    assert certificate.statement.proved
    assert certificate.decay.rate > 14
    # AR's gains are too slow for this at once.
    slow = LagrangianMetric(models.ball_and_beam(), math.sqrt(2), 0.5)
    refused = certify_distance(slow, interval=0.01, position=BEAM, velocity=0.25, error=0.25)
    assert refused.statement.verdict == "undecided"


@pytest.mark.exhaustive
def test_the_double_pendulum_is_proved_and_its_estimates_keep_to_it():
    """Both joints at 8 rad/s, errors of .3 rad in each, velocities unknown, 500 Hz; `√m_h d ≤ D` is simulated."""
    model, h, sigma = models.pendulum_chain(), 0.002, 60.0
    observer = with_part(model, 0.95, sigma, h)
    certificate = certify_distance(observer, interval=h, position=(-3.2, 3.2), velocity=8.0, error=0.3)
    assert certificate.statement.proved
    assert certificate.decay.rate > 15
    decay, rng, u = certificate.decay, np.random.default_rng(0), jnp.zeros(2)
    predict, correct = jax.jit(observer.predict), jax.jit(observer.correct)
    for _ in range(5):
        q = jnp.asarray(rng.uniform(-3, 3, 2))
        truth = observer.init(q)._replace(v=jnp.asarray(rng.uniform(-6, 6, 2)))
        estimate = observer.init(q + jnp.asarray(rng.uniform(-0.3, 0.3, 2)))
        for k in range(30):
            truth, estimate = (predict(state, u, jnp.asarray(h)) for state in (truth, estimate))
            assert model.space.norm(truth.q, truth.v) < certificate.bounds.speed
            estimate, info = correct(estimate, u, truth.q)
            # The age counts from the first sample; before it only the model has moved the error.
            if k:
                assert math.sqrt(decay.after) * float(info[1]) <= decay.radius * math.exp(-decay.rate * k * h)
