"""Defines the times of measurements, the metric between them, and the loss of rate by the correction that runs."""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class Sampling(NamedTuple):
    """The times of measurements, and the metric between them.

    Attributes:
        interval: shortest and longest time (2,) between two samples [s].
        lost: largest number of samples lost in a row.
        slopes: R_1, R_2, … (k, 2, 2) of the metric; R_0 is the matrix Q of the certificate.
        shear: whether the frame of the metric is sheared with the age of the measurement.
        substeps: number of Runge–Kutta steps in a prediction; None if the observer chooses it.
        missing_rows: whether rows of lost samples may be absent, so that one prediction covers all of them. By default
            each lost sample is a row without a measurement, and so a separate prediction.

    Example:
        >>> import numpy as np
        >>> from covariant.certificates.base import Sampling
        >>> sampling = Sampling(np.array([0.009, 0.011]), lost=1)
        >>> sampling.ages.round(3).tolist(), round(sampling.oldest, 3)
        ([[0.009, 0.011], [0.018, 0.022]], 0.022)
    """

    interval: Float[np.ndarray, "2"]
    lost: int = 0
    slopes: Float[np.ndarray, "k 2 2"] = np.zeros((0, 2, 2))
    shear: bool = False
    substeps: int | None = None
    missing_rows: bool = False

    @property
    def ages(self) -> Float[np.ndarray, "p 2"]:
        """Least and largest age (p + 1, 2) [s] of a measurement, for each number of samples lost before it."""
        counts = np.arange(1.0, self.lost + 2)[:, None]
        # Rounded outward, since a product may round inward; the product by 1 is exact.
        return np.where(counts > 1, np.nextafter(counts * self.interval, [0.0, np.inf]), self.interval)

    @property
    def oldest(self) -> float:
        """Largest age of a measurement [s]."""
        return float(self.ages[-1, 1])

    @property
    def longest_step(self) -> float:
        """Length of the longest Runge–Kutta step [s], rounded up; only if the number of steps is known."""
        assert self.substeps is not None
        return float(np.nextafter(self.longest_prediction / self.substeps, np.inf))

    @property
    def longest_prediction(self) -> float:
        """Longest time that one prediction covers [s]."""
        return self.oldest if self.missing_rows else float(self.interval[1])

    def at(self, q: Any, age: Any) -> Array:
        """The matrix R(τ) (2, 2) of the metric at an age τ.

        Args:
            q: R_0 (2, 2).
            age: age of the measurement [s], which may be traced.
        """
        age = jnp.asarray(age)
        r = jnp.asarray(q, age.dtype)
        for power, slope in enumerate(self.slopes, start=1):
            r = r + jnp.asarray(slope, age.dtype) * age**power
        return r

    def document(self) -> dict[str, Any]:
        """Convert to data for the file."""
        return {
            "interval": self.interval.tolist(),
            "lost": self.lost,
            "slopes": self.slopes.tolist(),
            "shear": self.shear,
            "substeps": self.substeps or 0,
        } | ({"missing_rows": True} if self.missing_rows else {})


class Loss(NamedTuple):
    """Loss of the correction that runs, compared with the correction of first order in the missing acceleration.

    It divides the missing acceleration by 1 + s/18, s = |missing| h²/|ξ|, and restarts if s exceeds (π/2)².

    Attributes:
        rate: largest loss of the decay rate [1/s] of distances.
        restart: largest s, as a fraction of the value that causes a restart.
        change: D [1/s], see `of`.

    Example:
        >>> from covariant.certificates.base._sampling import Loss
        >>> Loss(0.1, 0.2).allowed(1.0), Loss(0.6, 0.2).allowed(1.0), Loss(0.1, 1.0).allowed(1.0)
        (True, False, False)
    """

    rate: float
    restart: float
    change: float = 0.0

    @classmethod
    def of(cls, sampling: Sampling, q: Float[np.ndarray, "2 2"], rate: float, square: float, limit: float) -> "Loss":
        """Compute the loss from the claim "missing".

        With |missing| ≤ N|ξ|, N² = `square`, and |ξ| ≤ `limit` r for a tube of radius r, s is at most S = Nh². In a
        step the factor reduces the change of velocity by κ s/(18 + s) |missing|, with κ ≤ h, of at most the length
        `h D r`, D = S/(18 + S) N `limit` 2 √(½ R_0[1, 1]); the 2 bounds how much longer a vector may be at the new
        position.
        Since `e^(−μh) + hD ≤ e^(−(μ − D e^(μh))h)`, the loss is D e^(μh), at the oldest age.
        """
        stiffness, oldest = math.sqrt(square), sampling.oldest
        s = stiffness * oldest**2
        change = s / (18 + s) * stiffness * limit * 2 * math.sqrt(q[1, 1] / 2)
        # The factors cover rounding, including that of (π/2)² in the step that runs.
        loss = change * math.exp(rate / 2 * oldest) * (1 + 1e-9)
        return cls(loss, s / (math.pi / 2) ** 2 * (1 + 1e-6), change * (1 + 1e-9))

    def allowed(self, rate: float) -> bool:
        """Whether a positive part of a rate λ [1/s] remains, and no correction restarts."""
        return self.rate < rate / 2 and self.restart < 1


def unit_reach(squares: Float[np.ndarray, "two_n"]) -> Float[np.ndarray, "n"]:
    """Bounds (n,) of each position error for a curve of unit length."""
    return np.sqrt(squares[: len(squares) // 2]) * (1 + 1e-12)
