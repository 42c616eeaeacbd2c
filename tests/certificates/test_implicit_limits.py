"""What is proved about the implicit geodesic observer, against other integrations, exact norms and simulated errors.

Every bound is also tried where it must fail: below the least gain, and beyond the longest interval.
"""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from covariant.certificates import longest_interval, part_limits
from covariant.certificates.theory._implicit_limits import weight_of

UNIFORM = [(4.0, 1.0), (4.0, 5.0), (0.0, 3.0), (-4.0, 5.0), (-4.0, 1.0), (9.81, 6.0)]
"""k and σ."""


# The weight m and the longest interval


def test_the_weight_obeys_its_differential_equation():
    """Against a Runge–Kutta method, and the maximum over a grid of k and f in place of the corners."""
    rng = np.random.default_rng(0)
    for _ in range(25):
        sigma, share = rng.uniform(0.5, 8.0), rng.uniform(0.0, 0.9)
        k, f = np.sort(rng.uniform(-20.0, 20.0, 2)), np.sort(-rng.uniform(0.0, 3.0, 2)) * rng.integers(2)
        weight = weight_of(sigma, share * sigma, k.tolist(), f.tolist())
        m0, h = math.exp(rng.uniform(-1.0, 6.0)), 0.3 * min(weight.longest(), 1.0)
        grid_k, grid_f = np.meshgrid(np.linspace(k[0], k[1], 31), np.linspace(f[0], f[1], 31))

        def slope(_, m, sigma=sigma, rho=share * sigma, k=grid_k, f=grid_f):
            return -2 * (sigma + rho) * m - ((m - sigma**2 - k + sigma * f) ** 2 / (2 * (sigma - rho - f))).max()

        m = solve_ivp(slope, (0.0, h), [m0], rtol=1e-10, atol=1e-10).y[0, -1]
        assert weight.after(m0, h) == pytest.approx(max(m, 0.0), rel=1e-6, abs=1e-6)


@pytest.mark.parametrize(("k", "sigma"), UNIFORM)
def test_the_longest_interval_in_closed_form(k, sigma):
    root = math.sqrt(abs(k))
    slow, fast = sorted((sigma, root))
    if k > 0:
        expected = 2 / root * math.atan(root / sigma)
    else:
        expected = 2 / root * math.atanh(slow / fast) if k < 0 else 2 / sigma
    assert longest_interval(sigma, k, k) == pytest.approx(expected, rel=1e-12)


def test_errors_that_only_grow_exponentially_have_no_longest_interval():
    """At σ = √−k the correction leaves the decaying direction of the model, whatever h is."""
    assert longest_interval(2.0, -4.0, -4.0) == math.inf
    assert part_limits(30.0, 2.0, -4.0, -4.0).least == pytest.approx(1.0, abs=1e-12)


def linear_step(k, sigma, h, part):
    """Step (2, 2) of (ξ, w) for a constant K: the exponential of the error law, then the correction."""
    return np.diag([1 - part, 1.0]) @ expm(h * np.array([[sigma, 1.0], [-(k + sigma**2), -sigma]]))


def norm_in(m0, step):
    root = np.sqrt([m0, 1.0])
    return np.linalg.norm(root[:, None] * step / root, 2)


def least_norm(step):
    """In the best of all metrics m₀|ξ|² + |w|²."""
    m0 = np.exp(np.linspace(-8.0, 12.0, 4001))
    return min(norm_in(m, step) for m in m0)


@pytest.mark.core(4)
@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
@pytest.mark.parametrize(("k", "sigma"), UNIFORM)
def test_for_one_k_the_interval_of_parts_is_exact(k, sigma, share):
    """At both ends the step is just not expansive, and outside it is, in any of the metrics."""
    h = share * longest_interval(sigma, k, k)
    limits = part_limits(h, sigma, k, k)
    for part in (limits.least, limits.most):
        assert norm_in(limits.before, linear_step(k, sigma, h, part)) == pytest.approx(1.0, abs=1e-9)
    for part in (0.97 * limits.least, 2 - 0.97 * limits.least):
        assert least_norm(linear_step(k, sigma, h, part)) > 1.0 + 1e-5


@pytest.mark.parametrize(("k", "sigma"), UNIFORM)
def test_beyond_the_longest_interval_the_largest_gain_is_unstable(k, sigma):
    longest = longest_interval(sigma, k, k)
    radius = [np.abs(np.linalg.eigvals(linear_step(k, sigma, s * longest, 1.0))).max() for s in (0.999, 1.001)]
    assert radius[0] < 1 < radius[1]


def test_with_friction_errors_fall_as_proved():
    """At constant k and f. A wide range of it raises the least θ: what it takes from ζ, it does not take from w."""
    sigma, h, k, f = 6.0, 0.05, (-9.0, 9.0), (-4.0, -1.0)
    limits = part_limits(h, sigma, *k, friction=f)
    assert limits.least > part_limits(h, sigma, *k).least
    norms = []
    for stiffness in k:
        for slope in f:
            a = np.array([[sigma, 1.0], [-(stiffness + sigma**2 - sigma * slope), slope - sigma]])
            norms.append(norm_in(limits.before, np.diag([1 - limits.least, 1.0]) @ expm(h * a)))
    assert 0.99 < max(norms) <= 1.0 + 1e-12


def test_the_least_part_has_the_rate_that_it_was_asked_for():
    """At the worse end of k, and with 2 % less it does not."""
    limits = part_limits(0.05, 6.0, -9.81, 9.81, 1.5)
    found = [
        max(norm_in(limits.before, linear_step(k, 6.0, 0.05, part)) for k in (-9.81, 9.81))
        for part in (limits.least, 0.98 * limits.least)
    ]
    assert found[0] <= math.exp(-1.5 * 0.05) * (1 + 1e-12) < found[1]


@pytest.mark.parametrize("spoil", [{"h": 1.0}, {"h": -1.0}, {"sigma": 0.0}, {"k_minus": 20.0}, {"k_plus": math.nan}])
def test_numbers_that_make_no_sense_are_refused(spoil):
    with pytest.raises(ValueError, match="part_limits"):
        part_limits(**{"h": 0.05, "sigma": 6.0, "k_minus": -9.81, "k_plus": 9.81, **spoil})
