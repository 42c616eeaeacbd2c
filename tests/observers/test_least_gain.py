"""The least gain against the error's linear law: V' ≤ −ρV above it, and not below."""

import numpy as np
import pytest

from covariant.observers import least_gain


def test_the_rate_holds_above_the_least_gain_and_not_below():
    rng = np.random.default_rng(0)
    for _ in range(300):
        n = int(rng.integers(1, 5))
        k = rng.normal(size=(n, n)) * 10 ** rng.uniform(-1, 2)
        q22, q12 = rng.uniform(0.1, 3.0), -rng.uniform(0.1, 3.0)
        q = np.array([[q12**2 / q22 * rng.uniform(1.1, 5.0), q12], [q12, q22]])
        rate = rng.uniform(0.0, 0.9) * -2 * q12 / q22
        gains = least_gain(k, q, rate)
        whole = np.kron(q, np.eye(n))
        for share, holds in ((0.99, False), (1.01, True), (30.0, True)):
            unit, none = np.eye(n), np.zeros((n, n))
            law = np.block([[-share * gains.alpha * unit, unit], [-k - share * gains.beta * unit, none]])
            largest = np.linalg.eigvalsh(whole @ law + law.T @ whole + rate * whole)[-1]
            size = np.abs(whole @ law).max()
            # Where no gain is needed, none is too small.
            assert (largest <= 1e-9 * size) == holds or (gains.gain == 0 and largest <= 1e-9 * size)


def test_what_is_no_metric_is_refused():
    for q, rate in (
        ([[1.0, 0.5], [0.5, 1.0]], 0.0),
        ([[1.0, -2.0], [-2.0, 1.0]], 0.0),
        ([[1.0, -0.5], [-0.5, 1.0]], 1.0),
    ):
        with pytest.raises(ValueError, match="least_gain"):
            least_gain(np.zeros((1, 1)), np.array(q), rate)
