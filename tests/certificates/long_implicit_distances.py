"""What takes long of `test_implicit_distances.py`."""

import math

import numpy as np
import pytest
from test_implicit_distances import BEAM, Surface

from covariant.certificates import distance_decay
from covariant.certificates.theory import DistanceBounds
from covariant.certificates.theory._implicit_distances import contracted

SPHERE = Surface(np.cos, lambda r: -np.sin(r), np.ones_like, 1.0)


def pairs(surface, rng, count):
    """Estimates, true motions and their speeds."""

    def vectors(q, lengths):
        angle = rng.uniform(0, 2 * np.pi, count)
        return (lengths * np.array([np.cos(angle), np.sin(angle) / surface.f(q[:, 0])])).T

    q = rng.normal(size=(count, 2)) * [0.3, 1.0]
    speed = 10 ** rng.uniform(-0.5, 0.7, count)
    v = vectors(q, speed)
    there = q + vectors(q, 10 ** rng.uniform(-1.0, 0.0, count))
    return (there, v + vectors(q, 10 ** rng.uniform(-0.5, 0.7, count))), (q, v), speed


@pytest.mark.parametrize("surface", [BEAM, SPHERE], ids=["ball and beam", "sphere"])
def test_no_correction_increases_a_distance_up_to_the_bound(surface):
    """At the largest weight m₀ that the bound admits, for small and for whole corrections."""
    rng, sigma, count = np.random.default_rng(3), 1.0, 24
    m = 10 ** rng.uniform(-0.5, 1.0, count)
    estimate, truth, speed = pairs(surface, rng, count)
    straight = np.concatenate([truth[0] - estimate[0], truth[1] - estimate[1] - sigma * (truth[0] - estimate[0])], -1)
    z, before = surface.shoot(sigma, m, estimate, truth, straight)
    reach, tested = np.where(np.isfinite(before), before, 9.0) / np.sqrt(m), 0
    for part in (0.1, 0.6, 1.0):
        found = np.isfinite(before) & (surface.highest * reach < 1.5)
        x = surface.highest * np.where(found, reach, 0.0)
        left, strip = np.array([contracted(part, float(one)) for one in x]).T
        turning = (speed + sigma * (left + part) * reach) * reach / np.sqrt(m)
        rest = 1 - turning * strip / math.pi
        found &= rest > 0
        m0 = m * np.where(found, rest, 1.0) / max(1 - part, 0.1) ** 2 * ((1 - part) / np.maximum(left, 1e-9)) ** 2
        m0 = np.where(found & (part < 1), m0, m)
        q, v, _ = surface.correct(sigma, *estimate, truth[0], part)
        guess = np.concatenate([(1 - part) * z[:, :2], z[:, 2:]], -1)
        _, after = surface.shoot(sigma, m0, (q, v), truth, guess)
        found &= np.isfinite(after)
        assert (after[found] <= before[found] * (1 + 1e-9)).all()
        tested += found.sum()
    assert tested > 30


def test_the_decay_is_consistent():
    """Each of its conditions, from its own numbers; more error, speed or curvature never prove more."""
    bounds = DistanceBounds(1.0, 0.5, 1.0, (-1.0, 1.0), (-1.0, 0.2))
    h, part, sigma = 0.02, 0.8, 6.0
    decay = distance_decay(h, part, sigma, bounds)
    assert decay.rate > 0
    assert decay.radius >= math.hypot(math.sqrt(decay.after) * 0.5, 1.0 + sigma * 0.5)
    assert decay.reach >= decay.radius / math.sqrt(decay.after) * (1 - 1e-12)
    left, strip = contracted(part, math.sqrt(0.2) * decay.reach)
    assert left**2 * decay.before / decay.after + decay.turning * strip / math.pi <= 1
    worse = [bounds._replace(error=0.7), bounds._replace(curvature=(-1.5, 0.2)), bounds._replace(stiffness=(-3.0, 3.0))]
    assert all(distance_decay(h, part, sigma, one).rate < decay.rate for one in worse)
    tight = distance_decay(h, part, sigma, bounds._replace(injectivity=0.9 * decay.reach))
    assert tight.rate == -math.inf or tight.reach < 0.9 * decay.reach
