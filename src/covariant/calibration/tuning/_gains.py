"""Gains of a mechanical observer from the numbers of a data sheet.

In the parallel frame the error law is a double integrator driven by white measurement noise of density S_m and
unmodelled acceleration of density S_a, so the best isotropic gains are those of its stationary Kalman filter.
"""

import math
from typing import Annotated, NamedTuple

import numpy as np

from covariant._domains import POSITIVE, NotNegative, Positive, check_numbers
from covariant._typing import Number


class Gains(NamedTuple):
    """Constant gains of a mechanical observer, and the errors that they should leave.

    Build an observer as `Intrinsic(model, gains.alpha, gains.beta)`. The predicted errors are for white noise and a
    small error; use them to compare gains, rather than as bounds.

    Attributes:
        alpha: Position gain α [1/s].
        beta: Velocity gain β [1/s²].
        position_std: Predicted standard deviation of the position error, in metric units.
        velocity_std: Predicted standard deviation of the velocity error, in metric units.
        force_rate: Rate ρ [1/s] at which `IntrinsicForce` learns an unknown force; 0 for observers without one.

    Example:
        >>> from covariant.calibration import Gains
        >>> print(Gains(alpha=10.0, beta=50.0, position_std=1e-3, velocity_std=0.02).summary)
        alpha = 10 1/s, beta = 50 1/s²; predicted standard deviation of the position 0.001 and of the velocity 0.02
    """

    alpha: float
    beta: float
    position_std: float
    velocity_std: float
    force_rate: float = 0.0

    @property
    def summary(self) -> str:
        """The gains and predicted errors in one line."""
        rate = f", force rate = {self.force_rate:.4g} 1/s" if self.force_rate else ""
        return (
            f"alpha = {self.alpha:.4g} 1/s, beta = {self.beta:.4g} 1/s²{rate}; predicted standard deviation of the "
            f"position {self.position_std:.2g} and of the velocity {self.velocity_std:.2g}"
        )


@check_numbers
def gains(
    measurement_std: Positive,
    rate: Positive,
    acceleration_std: Positive,
    correlation_time: Positive | None = None,
    damping: Positive = math.sqrt(0.5),
    natural_frequency: Positive | None = None,
    force_std: NotNegative = 0.0,
    force_time: Positive | None = None,
    force_rate: NotNegative | None = None,
) -> Gains:
    """Gains α = 2ζω, β = ω² with ω = (S_a/S_m)^¼, for the noise of a sensor and the error of a model.

    They are the gains of the stationary Kalman filter of the error law, for `Intrinsic` and its relatives. Only the
    ratio S_a/S_m decides ω: a better sensor or a worse model makes the observer faster. The design is in continuous
    time, so ω should be well below the sampling rate. `tune` finds the numbers from logs, and `observer_gains` reads
    them from a data sheet.

    Args:
        measurement_std: Standard deviation of one position sample [rad or m]; for an encoder, one step divided by √12.
        rate: Sampling rate [Hz]; S_m = measurement_std² / rate.
        acceleration_std: Standard deviation of the acceleration that the model does not explain [rad/s² or m/s²].
        correlation_time: Time [s] over which it persists, S_a = 2 acceleration_std² correlation_time; by default it is
            independent at each sample.
        damping: Damping ratio ζ; √½ is optimal for white disturbances, and a larger one helps when they are faster than
            the observer.
        natural_frequency: Another ω [rad/s], such as one identified from a log.
        force_std: Standard deviation of the acceleration by an unknown force that lasts, for `IntrinsicForce`
            [rad/s² or m/s²]; 0 (default) for none.
        force_time: Time constant [s] with which that force is forgotten. By default it is a random walk, with
            `force_std` the standard deviation of its change in one second.
        force_rate: Another rate ρ [1/s] at which the force is learnt, 0 for none.

    Returns:
        The gains, and the errors that they should leave. With a force the velocity error is 2 to 6 % above that of the
        stationary Kalman filter, which forgets the force.

    Raises:
        ValueError: A number is not positive.

    Example:
        >>> from covariant.calibration import gains
        >>> design = gains(measurement_std=1e-3, rate=100.0, acceleration_std=1.0, correlation_time=0.5)
        >>> round(design.alpha, 2), round(design.beta)  # ω = (1 / 1e-8)^¼ = 100 rad/s
        (141.42, 10000)
        >>> loaded = gains(1e-3, 100.0, 0.1, 0.5, force_std=1.0, force_time=0.5)
        >>> round(loaded.beta**0.5), round(loaded.force_rate)
        (33, 16)
    """
    # Independent at each sample: S_a = 2 std² time is then std² / rate, as for the measurement.
    time = 1 / (2 * rate) if correlation_time is None else correlation_time
    measurement_density = measurement_std**2 / rate
    acceleration_density = 2 * acceleration_std**2 * time
    forgetting = 0.0 if force_time is None else 1 / force_time
    force_density = force_std**2 * (1 if force_time is None else 2 * forgetting)
    densities = measurement_density, acceleration_density, force_density, forgetting
    designed, rho = (acceleration_density / measurement_density) ** 0.25, 0.0
    if force_std:
        designed, rho = _force_poles(*densities)
    omega = natural_frequency or designed
    rho = rho * omega / designed if force_rate is None else force_rate
    if not rho:
        return predict_errors(2 * damping * omega, omega**2, measurement_density, acceleration_density)
    return _force_errors(Gains(2 * damping * omega, omega**2, math.nan, math.nan, rho), *densities)


def _force_poles(
    measurement_density: float, acceleration_density: float, force_density: float, forgetting: float
) -> tuple[float, float]:
    """ω of two poles and ρ of the third for an unknown acceleration that is coloured noise, forgotten at a rate r.

    The spectral density `(W + D/(r² − s²))/s⁴` of the positions that the model does not explain gives the poles of the
    stationary Kalman filter as roots of `R x²(r² − x) + W(r² − x) + D = 0` in x = s². Here its feedback acts on a force
    that is not forgotten, and the poles are those of this loop. For D → 0 they are (W/R)^¼ and 0.
    """
    r, noise = forgetting, measurement_density
    squares = np.roots([-noise, noise * r**2, -acceleration_density, force_density + acceleration_density * r**2])
    _, first, second, third = np.poly(-np.sqrt(squares.astype(complex))).real
    # (s + r)(s² + k1 s + k2) + k3, the polynomial of the filter with its feedback k, has these coefficients.
    k1 = first - r
    k2 = second - k1 * r
    poles = np.asarray(np.roots([1.0, k1, k2, max(third - k2 * r, 0.0)]), complex)
    # A cubic has a real root; of three the slowest one is that of the force.
    turning = np.abs(np.imag(poles))
    rho = -float(np.real(poles)[turning <= turning.min()].max())
    others = poles[np.argsort(np.abs(poles + rho))[1:]]
    return math.sqrt(abs(np.prod(others))), max(rho, 0.0)


def _force_errors(gains: Gains, noise: float, acceleration: float, force: float, forgetting: float) -> Gains:
    """Gains with the stationary errors of `IntrinsicForce` under white noise and the noise that drives a force."""
    alpha, beta, rho, r = gains.alpha, gains.beta, gains.force_rate, forgetting
    # ξ' = ζ − k1(ξ − n), ζ' = η − k2(ξ − n) − w, η' = −k3(ξ − n) + r a − d, a' = −r a + d, with white n, w and d.
    gain = np.array([alpha + rho, beta + alpha * rho, beta * rho, 0.0])
    loop = np.diag([1.0, 1.0, r], 1) - np.diag([0.0, 0.0, 0.0, r])
    loop[:, 0] -= gain
    sources = np.stack([gain, [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 1.0]], axis=1)
    # A random walk drifts without a bound, and does not act on the errors.
    n = 4 if r else 3
    loop, sources, eye = loop[:n, :n], sources[:n], np.eye(n)
    added = sources * np.array([noise, acceleration, force]) @ sources.T
    cov = np.linalg.solve(np.kron(loop, eye) + np.kron(eye, loop), -added.ravel()).reshape(n, n)
    return gains._replace(position_std=math.sqrt(cov[0, 0]), velocity_std=math.sqrt(cov[1, 1]))


def predict_errors(alpha: Number, beta: Number, measurement_density: float, acceleration_density: float) -> Gains:
    """Stationary errors of an observer with gains α and β, in continuous time.

    `Var q̃ = (α²+β) S_m/2α + S_a/2αβ` and `Var ṽ = β² S_m/2α + (α²+β) S_a/2αβ`.

    Use it to compare gains that you have chosen by hand with those of `gains`. Both densities belong to white noise: a
    model error that persists for longer than 1/ω leaves larger errors. The result holds for a small error, and is in
    metric units.

    Args:
        alpha: Position gain α [1/s].
        beta: Velocity gain β [1/s²].
        measurement_density: Spectral density S_m of the measurement noise: variance of a sample over the rate [Hz].
        acceleration_density: Spectral density S_a of the unmodelled acceleration.

    Returns:
        The gains with the standard deviations of both errors.

    Example:
        >>> from covariant.calibration import predict_errors
        >>> errors = predict_errors(10.0, 50.0, measurement_density=1e-8, acceleration_density=1e-2)
        >>> round(errors.position_std, 5), round(errors.velocity_std, 4)
        (0.00317, 0.0387)
    """
    alpha, beta = float(alpha), float(beta)
    factor = alpha**2 + beta
    # From the Lyapunov equation of ξ' = ζ − αξ + αn, ζ' = −βξ + βn + a.
    position = factor * measurement_density / (2 * alpha) + acceleration_density / (2 * alpha * beta)
    velocity = beta**2 * measurement_density / (2 * alpha) + factor * acceleration_density / (2 * alpha * beta)
    return Gains(alpha, beta, math.sqrt(position), math.sqrt(velocity))


@check_numbers
def predict_sampled_errors(
    alpha: Annotated[Number, POSITIVE],
    beta: Annotated[Number, POSITIVE],
    rate: Positive,
    measurement_std: float,
    acceleration_density: float = 0.0,
) -> Gains:
    """Stationary errors just after a sample, of an observer that takes `rate` samples a second.

    Those of the sampled loop with the poles exp(λ/rate), which `predict_errors` has for ever faster samples:
    `ξ⁺ = ξ + k1 (n − ξ)`, `ζ⁺ = ζ + k2 (n − ξ)`, and in between ξ grows by ζ dt and a density of accelerations acts.

    Args:
        alpha: Position gain α [1/s].
        beta: Velocity gain β [1/s²].
        rate: Sampling rate [Hz].
        measurement_std: Standard deviation of one sample; on a curved space the root of the mean of |n|² in its metric.
        acceleration_density: Spectral density S_a of the unmodelled acceleration.

    Returns:
        The gains with the standard deviations of both errors.

    Raises:
        ValueError: A gain or the rate is not positive.

    Example:
        >>> from covariant.calibration import predict_errors, predict_sampled_errors
        >>> slow, fast = (predict_sampled_errors(10.0, 50.0, rate, 0.1 * rate**0.5) for rate in (50.0, 1e4))
        >>> limit = predict_errors(10.0, 50.0, measurement_density=0.01, acceleration_density=0.0).position_std
        >>> bool(abs(fast.position_std - limit) < 0.01 * limit < abs(slow.position_std - limit))
        True
    """
    alpha, beta = float(alpha), float(beta)
    dt = 1 / rate
    # The poles of λ² + αλ + β, sampled: both errors decay as in continuous time.
    pole1, pole2 = np.exp(np.roots([1.0, alpha, beta]) * dt)
    k1, k2 = float((1 - pole1 * pole2).real), float(((1 - pole1) * (1 - pole2)).real) / dt
    # The sample at the end of a step also reduces what the acceleration added within it.
    correction = np.array([[1 - k1, 0.0], [-k2, 1.0]])
    loop = correction @ np.array([[1.0, dt], [0.0, 1.0]])
    disturbance = acceleration_density * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    added_cov = measurement_std**2 * np.outer([k1, k2], [k1, k2]) + correction @ disturbance @ correction.T
    # The discrete Lyapunov equation P = A P Aᵀ + Q, as vec P = (I − A ⊗ A)⁻¹ vec Q.
    cov = np.linalg.solve(np.eye(4) - np.kron(loop, loop), added_cov.ravel()).reshape(2, 2)
    return Gains(alpha, beta, math.sqrt(cov[0, 0]), math.sqrt(cov[1, 1]))
