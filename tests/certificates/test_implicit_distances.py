"""Distances between states in `m|ξ|² + |w|²`, found by shooting in NumPy, against what is proved about them.

The distance of (q̂, v̂) from (q, v) is that of a curve in the positions along which v̂ is transported, and pays for its
length and for what is left of the velocity. Its equation is `m∇_p p = −R(v, u)p, ∇_p u = 0, u = ∇_p v − σp`.
"""

import math

import numpy as np
import pytest

from covariant.certificates import distance_decay, part_limits
from covariant.certificates.theory import DistanceBounds
from covariant.certificates.theory._implicit_distances import contracted


class Surface:
    """Metric diag(1, f(r)²) on the plane of (r, θ), with f and its first derivative, and its curvature."""

    def __init__(self, f, slope, curvature, highest):
        self.f, self.slope, self.curvature, self.highest = f, slope, curvature, highest  # 0 or 1

    def inner(self, q, a, b):
        return a[..., 0] * b[..., 0] + self.f(q[..., 0]) ** 2 * a[..., 1] * b[..., 1]

    def connection(self, q, a, b):
        f, slope = self.f(q[..., 0]), self.slope(q[..., 0])
        mixed = a[..., 0] * b[..., 1] + a[..., 1] * b[..., 0]
        return np.stack([-f * slope * a[..., 1] * b[..., 1], slope / f * mixed], -1)

    def flow(self, sigma, m, q, v, p, u, steps=12):
        """Positions and velocities at the end of geodesics of the states; m = ∞ for those of positions."""

        def rate(x):
            q, v, p, u = x
            bend = (self.curvature(q[..., 0]) / m)[..., None]
            bend = bend * (self.inner(q, u, p)[..., None] * v - self.inner(q, v, p)[..., None] * u)
            connection = self.connection
            return np.stack([p, u + sigma * p - connection(q, p, v), -bend - connection(q, p, p), -connection(q, p, u)])

        x, h = np.stack([q, v, p, u]), 1 / steps
        for _ in range(steps):
            k1 = rate(x)
            k2 = rate(x + h / 2 * k1)
            k3 = rate(x + h / 2 * k2)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + h * k3))
        return x

    def shoot(self, sigma, m, start, end, guess):
        """Initial p and u (…, 4) of the geodesics, and their lengths; infinite where none was found."""

        @np.errstate(all="ignore")
        def miss(z):
            q, v = start
            return np.concatenate(self.flow(sigma, m, q, v, z[..., :2], z[..., 2:])[:2], -1) - np.concatenate(end, -1)

        z, f, e = guess, miss(guess), 1e-6
        for _ in range(12):
            if np.linalg.norm(f, axis=-1).max() < 1e-9:
                break
            columns = [(miss(z + e * row) - miss(z - e * row)) / (2 * e) for row in np.eye(4)]
            slopes = np.nan_to_num(np.stack(columns, -1), posinf=0.0, neginf=0.0) + 1e-13 * np.eye(4)
            step = np.linalg.solve(slopes, f[..., None])[..., 0]
            for share in (1.0, 0.5, 0.2, 0.05):
                tried = miss(z - share * step)
                better = (np.linalg.norm(tried, axis=-1) < np.linalg.norm(f, axis=-1))[..., None]
                z, f = np.where(better, z - share * step, z), np.where(better, tried, f)
                step = np.where(better, 0.0, step)
        q = start[0]
        length = np.sqrt(m * self.inner(q, z[..., :2], z[..., :2]) + self.inner(q, z[..., 2:], z[..., 2:]))
        return z, np.where(np.linalg.norm(f, axis=-1) < 1e-7, length, math.inf)

    def correct(self, sigma, q, v, y, part):
        """The correction of `LagrangianMetric`, and the geodesic to y."""
        m, none = np.full(len(q), math.inf), np.zeros_like(q)
        z, length = self.shoot(0.0, m, (q, none), (y, none), np.concatenate([y - q, none], -1))
        assert not np.isnan(length).all()
        return *self.flow(sigma, m, q, v, part * z[..., :2], none)[:2], z[..., :2]


BEAM = Surface(lambda r: np.sqrt(1 + r * r), lambda r: r / np.sqrt(1 + r * r), lambda r: -1 / (1 + r * r) ** 2, 0.0)
"""The ball and beam."""


def test_beyond_the_bound_distances_grow_at_every_gain():
    """On the ball and beam a fast ball, 8 cm and .12 rad off: the shortest way turns its velocity by a loop.

    For θ = 1 both numbers are bounds: D before is at most the length of a curve, and after it at least what the
    isoperimetric inequality and |K| ≤ 1 leave.
    """
    sigma, m, speed, angle, off = math.sqrt(0.125), np.full(1, 0.1), 4.0, 0.12, 0.08
    truth = np.zeros((1, 2)), np.array([[speed, 0.0]])
    turned = speed * np.array([[math.cos(angle), math.sin(angle)]])
    estimate = np.array([[-off, 0.0]]), turned
    loop = np.array([GUESS])
    z, before = BEAM.shoot(sigma, m, estimate, truth, loop)
    error = np.linalg.norm(turned - truth[1]) + sigma * off
    # λ of the pair is three times 2π.
    assert speed * error / m[0] > 18
    _, _, geodesic = BEAM.correct(sigma, *estimate, truth[0], 1.0)
    cosine = BEAM.inner(estimate[0], z[:, :2], geodesic) / np.sqrt(
        BEAM.inner(estimate[0], z[:, :2], z[:, :2]) * BEAM.inner(estimate[0], geodesic, geodesic)
    )
    assert cosine[0] < -0.9  # it leaves away from the measurement
    last = before
    for part in (0.25, 0.5, 0.75, 1.0):
        q, v, _ = BEAM.correct(sigma, *estimate, truth[0], part)
        z, after = BEAM.shoot(sigma, m, (q, v), truth, z)
        assert after[0] > last[0]
        last = after
    # v after the whole correction; loops of length ℓ turn it by (V + σℓ/2)ℓ²/4π at most.
    left, loops = np.linalg.norm(v - truth[1]), np.linspace(0, 3, 3001)
    turns = (speed + sigma * loops / 2) * loops**2 / (4 * np.pi)
    lowest = np.sqrt(np.min(m * loops**2 + np.maximum(left - turns, 0.0) ** 2))
    assert before[0] < lowest < after[0] * (1 + 1e-9)


GUESS = (-0.87, -0.39, -0.01, -0.15)
"""Initial p and u of that way, roughly."""


def test_one_output_has_the_limits_of_lengths_at_any_distance():
    """Without curvature the condition is that of `part_limits`: 1 − θ = √(m_h/m₀) at the least part."""
    h, sigma, k = 0.05, 6.0, (-9.81, 9.81)
    limits = part_limits(h, sigma, *k)
    far = DistanceBounds(1e3, 1e3, 1e3, k)
    assert distance_decay(h, 1.02 * limits.least, sigma, far).rate >= 0
    assert distance_decay(h, 0.98 * limits.least, sigma, far).rate == -math.inf


def test_a_cone_shrinks_as_on_the_sphere():
    """Circles around a pole: their lengths are sines of the distance, their areas 1 − cos."""
    for x in (1e-6, 2e-4, 0.3, 2.9):
        left, strip = contracted(0.3, x)
        assert left == pytest.approx(math.sin(0.7 * x) / math.sin(x), rel=1e-9)
        # From x/2 · sin x, half the length times the radius, as in the plane.
        area = 2 * math.sin((1 + 0.7) * x / 2) * math.sin(0.3 * x / 2)
        assert strip == pytest.approx(area / (x / 2 * math.sin(x)), rel=1e-9)


@pytest.mark.parametrize("change", [{"speed": -1.0}, {"curvature": (1.0, 0.0)}, {"injectivity": 0.0}])
def test_bounds_that_are_none_are_refused(change):
    with pytest.raises(ValueError, match="distance_decay"):
        distance_decay(0.02, 0.8, 6.0, DistanceBounds(1.0, 0.5, 1.0, (-1.0, 1.0))._replace(**change))
