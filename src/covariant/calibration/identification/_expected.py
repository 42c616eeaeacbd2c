"""Standard errors of a robot's numbers that a log of a motion is expected to give, from the noise of its sensors.

The error of `fit_robot` is linear in small noise: `(A + P)⁻¹ Σ zᵀ D r` over the points of its grid, with derivatives z
of the torques averaged over windows, weights D, information A, prior P, and residual torques r. Encoder noise is in r
as `M(q)` times the second derivative of the polynomial through a window. So the covariance of the errors is known,
although neighbouring windows overlap.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from covariant.calibration._least_squares import PRIOR
from covariant.calibration.diagnosis import acceleration_kernel, derivative_weights
from covariant.calibration.identification._fourier import FourierMotion
from covariant.calibration.identification._robot_combinations import Combinations
from covariant.calibration.identification._robot_torques import (
    BLOCK,
    FEWEST,
    FEWEST_BLOCKS,
    RESTING,
    WINDOWS,
    Determined,
    convolved,
    efforts,
    in_batches,
    inverse_inputs,
    sticking_speeds,
    usual_sizes,
)
from covariant.models import RobotFamily
from scalargraph.errors import InputError

FINE = 4
"""Points of the grid in half of the shortest window."""
KERNEL = 64
"""Points in half a window at which its averaging is summed up."""


class Sensing(NamedTuple):
    """What disturbs a log.

    Attributes:
        noise: Standard deviations (n,) of measured positions [rad or m], white.
        torque_noise: Standard deviations (n,) of logged torques or forces as felt at the joints [N m or N], white.
        rate: Rows in a second [Hz].

    Example:
        >>> import numpy as np
        >>> from covariant.calibration import Sensing
        >>> Sensing(np.array([1e-4]), np.array([0.0]), 500.0).rate
        500.0
    """

    noise: Float[np.ndarray, "n"]
    torque_noise: Float[np.ndarray, "n"]
    rate: float


class FitWindow(NamedTuple):
    """A window of the fit.

    Attributes:
        half: Half width [s].
        duration: Length of the log [s].
        accelerations: Variances (n,) of residual accelerations.
        torque: Variances (n,) of residual torques beyond these.
    """

    half: float
    duration: float
    accelerations: Float[np.ndarray, "n"]
    torque: Float[np.ndarray, "n"]

    def arrays(self, points: int, frequency: float) -> tuple[Array, ...]:
        """What the objective of a design needs, for a grid of so many points over one period."""
        kernel = acceleration_kernel(self.half, KERNEL)
        lags = self.half / KERNEL * np.arange(-KERNEL, KERNEL + 1)
        pace = 2 * np.pi * frequency * np.arange(points // 2 + 1)
        transfer = np.cos(pace[:, None] * lags) @ kernel / kernel.sum()
        weight = self.duration / self.half / points
        return tuple(jnp.asarray(each) for each in (transfer, weight, self.accelerations, self.torque))


class ExpectedErrors(NamedTuple):
    """What a log of a motion is expected to show of open numbers.

    Attributes:
        errors: Standard errors (p,) of the numbers, NaN where the log would not show one by itself.
        determined: Whether a fit of the log would say of each number (p,) that it is determined.
        combinations: What it would determine of numbers that it cannot tell apart.
        condition: Condition number of the regressor, scaled to usual sizes, over the directions that are determined.
        size: Logarithm of the size of the errors: that of the determinant of their covariance, over 2 p.
        window: The window of the fit that makes the errors smallest; None for a fit of commands, which has no window.

    Example:
        >>> from covariant.calibration import ExpectedErrors
        >>> ExpectedErrors._fields
        ('errors', 'determined', 'combinations', 'condition', 'size', 'window')
    """

    errors: Float[np.ndarray, "p"]
    determined: Bool[np.ndarray, "p"]
    combinations: Combinations
    condition: float
    size: float
    window: Any = None

    @classmethod
    def of(
        cls,
        family: RobotFamily,
        sizes: Float[np.ndarray, "p"],
        information: Float[np.ndarray, "p p"],
        covariance: Float[np.ndarray, "p p"],
        window: FitWindow | None = None,
    ) -> "ExpectedErrors":
        """Evaluate the information, without the prior, and the covariance, with it, of numbers in usual sizes (p,)."""
        outer = np.outer(sizes, sizes)
        known = Determined.of(family, np.zeros(len(sizes)), sizes, information / outer, covariance * outer)
        values, rank = np.linalg.eigvalsh(information)[::-1], known.combinations.rank
        condition = float(np.sqrt(values[0] / values[rank - 1])) if rank else np.inf
        size = float(np.linalg.slogdet(covariance * outer)[1]) / (2 * len(sizes))
        return cls(known.standard_errors, known.determined, known.combinations, condition, size, window)


def expected_errors(
    family: RobotFamily,
    derivatives: Callable[..., np.ndarray],
    motion: FourierMotion,
    sensing: Sensing,
    duration: float,
    half: float,
) -> ExpectedErrors:
    """Standard errors that a fit is expected to give from a log of a motion, all of which it sees."""
    half = max(half, FEWEST / sensing.rate)
    # A fit loses half a window at both ends.
    shortest = (FEWEST_BLOCKS * BLOCK + 2) * half
    if shortest > duration:
        raise InputError(
            f"duration: a fit needs a log of {shortest:.3g} s, and this one has {duration:.3g} s; "
            "give a longer duration, or a shorter [reference] half"
        )
    model: Any = family.file.model
    count = int(np.ceil(FINE / half / motion.frequency))
    step = 1 / motion.frequency / count
    q, v, a = motion.at(step * np.arange(count))
    torque = in_batches(efforts, model, q, v, a)
    sizes, speed = usual_sizes(family, torque[:, 0], torque[:, 1], v, a)
    u = inverse_inputs(model).apply(torque[:, 0], q, v)
    repeats = round(duration * motion.frequency)
    period = derivatives(q, v, a, u) * sizes, in_batches(_inertia, model, q), np.abs(v) < sticking_speeds(family, speed)
    rows = _Rows(*(np.concatenate([each] * repeats) for each in period), step=step)
    tried = []
    for factor in WINDOWS:
        points = max(round(factor * half / step), 3)
        if factor > 1 and points * step * FEWEST_BLOCKS * BLOCK > duration:
            break
        tried.append(rows.covariance(points, sensing))
    return ExpectedErrors.of(family, sizes, *min(tried, key=lambda each: np.linalg.slogdet(each[1])[1]))


def _inertia(model: Any, q: Array) -> Array:
    return model.space(q)


class _Rows(NamedTuple):
    """A log along an even grid: derivatives (K, n, p) of torques in usual sizes of the numbers, inertia matrices
    (K, n, n), joints (K, n) that may stick, and the step [s]."""

    slopes: Float[np.ndarray, "K n p"]
    inertia: Float[np.ndarray, "K n n"]
    rests: Any
    step: float

    def covariance(self, points: int, sensing: Sensing) -> tuple[np.ndarray, np.ndarray, FitWindow]:
        """Information and covariance (p, p) of the numbers in usual sizes, with windows of ± so many points."""
        step, half, spacing = self.step, points * self.step, 1 / sensing.rate
        kernel = acceleration_kernel(half, points)
        kernel = kernel / kernel.sum()
        # Densities in time, so that a sum over samples is one over points times the ratio of their spacings.
        curvature = derivative_weights(step * np.arange(-points, points + 1), half) / step
        z = convolved(self.slopes, kernel)
        rests = convolved(self.rests.astype(float), np.abs(kernel) / np.abs(kernel).sum())
        used = rests < RESTING
        used[:points] = used[len(used) - points :] = False
        window = FitWindow(
            half,
            step * len(self.slopes),
            sensing.noise**2 * spacing * step * np.sum(curvature**2),
            sensing.torque_noise**2 * spacing * np.sum(kernel**2) / step,
        )
        variance = np.mean(self.inertia**2 @ window.accelerations, axis=0) + window.torque
        weighed = z * (used / variance)[:, :, None] * (step / half)
        information = np.einsum("kjp,kjq->pq", weighed, z, optimize=True)
        padding = ((points, points), (0, 0), (0, 0))
        of_positions = np.pad(np.einsum("kji,kjp->kip", self.inertia, weighed, optimize=True), padding)
        scores = np.zeros_like(information)
        for coefficients, density, std in (
            (of_positions, curvature, sensing.noise),
            (np.pad(weighed, padding), kernel / step, sensing.torque_noise),
        ):
            felt = convolved(coefficients, density) * std[:, None]
            scores += step * spacing * np.einsum("kip,kiq->pq", felt, felt, optimize=True)
        prior = np.eye(len(information)) / PRIOR**2
        inverse = np.linalg.inv(information + prior)
        return information, inverse @ (scores + prior) @ inverse, window
