"""Gains of a mechanical observer from the numbers of a data sheet.

In the parallel frame the error law is a double integrator driven by white measurement noise of density S_m and
unmodelled acceleration of density S_a, so the best isotropic gains are those of its stationary Kalman filter.
"""

import math
from typing import NamedTuple

import numpy as np

from covariant._typing import Number


class Gains(NamedTuple):
    """`alpha` [1/s], `beta` [1/s²], and the standard deviations of the errors they should leave, in metric units."""

    alpha: float
    beta: float
    position_std: float
    velocity_std: float

    @property
    def summary(self) -> str:
        return (
            f"alpha = {self.alpha:.4g} 1/s, beta = {self.beta:.4g} 1/s²; predicted standard deviation of the position "
            f"{self.position_std:.2g} and of the velocity {self.velocity_std:.2g}"
        )


def gains(
    measurement_std: float,
    rate: float,
    acceleration_std: float,
    correlation_time: float | None = None,
    damping: float = math.sqrt(0.5),
    natural_frequency: float | None = None,
) -> Gains:
    """Gains α = 2ζω, β = ω² with ω = (S_a/S_m)^¼.

    - `measurement_std`: standard deviation of one position sample [rad or m]; for an encoder, one step divided by √12.
    - `rate`: samples per second [Hz].
    - `acceleration_std`: standard deviation of the acceleration that the model does not explain [rad/s² or m/s²].
    - `correlation_time`: time [s] over which it persists, S_a = 2 std² time; by default it is independent at each
      sample.
    - `damping`: ζ; √½ is optimal for white disturbances, and more helps when they are faster than the observer.
    - `natural_frequency`: another ω [rad/s], such as one found from a log.

    Raises `ValueError` for numbers that are not positive.
    """
    time = 1 / (2 * rate) if correlation_time is None else correlation_time
    given = {
        "measurement_std": measurement_std,
        "rate": rate,
        "acceleration_std": acceleration_std,
        "correlation_time": time,
        "damping": damping,
    }
    if natural_frequency is not None:
        given["natural_frequency"] = natural_frequency
    for name, value in given.items():
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"gains: {name} must be a positive number; got {value}")
    measurement_density = measurement_std**2 / rate
    acceleration_density = 2 * acceleration_std**2 * time
    omega = natural_frequency or (acceleration_density / measurement_density) ** 0.25
    return predict_errors(2 * damping * omega, omega**2, measurement_density, acceleration_density)


def predict_errors(alpha: Number, beta: Number, measurement_density: float, acceleration_density: float) -> Gains:
    """Stationary errors of given gains: `Var q̃ = (α²+β) S_m/2α + S_a/2αβ`, `Var ṽ = β² S_m/2α + (α²+β) S_a/2αβ`."""
    alpha, beta = float(alpha), float(beta)
    both = alpha**2 + beta
    position = both * measurement_density / (2 * alpha) + acceleration_density / (2 * alpha * beta)
    velocity = beta**2 * measurement_density / (2 * alpha) + both * acceleration_density / (2 * alpha * beta)
    return Gains(alpha, beta, math.sqrt(position), math.sqrt(velocity))


def predict_sampled_errors(
    alpha: Number, beta: Number, rate: float, measurement_std: float, acceleration_density: float = 0.0
) -> Gains:
    """Stationary errors just after a sample, of an observer that takes `rate` samples a second [Hz].

    Those of the sampled loop with the poles exp(λ/rate), which `predict_errors` has for ever faster samples:
    `ξ⁺ = ξ + k1 (n − ξ)`, `ζ⁺ = ζ + k2 (n − ξ)`, and in between ξ grows by ζ dt and a density of accelerations acts.

    - `measurement_std`: of one sample; on a curved space the root of the mean of |n|² in its metric.

    Raises `ValueError` for gains or a rate that are not positive.
    """
    alpha, beta = float(alpha), float(beta)
    for name, value in {"alpha": alpha, "beta": beta, "rate": rate}.items():
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"predict_sampled_errors: {name} must be a positive number; got {value}")
    dt = 1 / rate
    one, two = np.exp(np.roots([1.0, alpha, beta]) * dt)
    k1, k2 = float((1 - one * two).real), float(((1 - one) * (1 - two)).real) / dt
    taken = np.array([[1 - k1, 0.0], [-k2, 1.0]])
    loop = taken @ np.array([[1.0, dt], [0.0, 1.0]])
    acting = acceleration_density * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    added = measurement_std**2 * np.outer([k1, k2], [k1, k2]) + taken @ acting @ taken.T
    cov = np.linalg.solve(np.eye(4) - np.kron(loop, loop), added.ravel()).reshape(2, 2)
    return Gains(alpha, beta, math.sqrt(cov[0, 0]), math.sqrt(cov[1, 1]))


def bias(alpha: Number, beta: Number, acceleration: float) -> tuple[float, float]:
    """Position and velocity errors due to a constant unmodelled acceleration a: `a/β` and `αa/β`."""
    return acceleration / float(beta), float(alpha) * acceleration / float(beta)
