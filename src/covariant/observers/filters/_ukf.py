"""Unscented Kalman filter: the model propagates sigma points, and no derivatives are needed.

The error is the same as in the EKF, `(local(q̂, q), v − v̂)` in the frame of the space, so on a group the points are
drawn around the estimate by its retraction. There the mean is computed to first order, in the frame at the propagated
central point, and deviations are then taken from the mean. The filter stores a square root of the covariance, and all
weights of the covariance are positive, so it never becomes indefinite.

A measured configuration is linear in that error, `local(q̂, y)`, and the unscented transform is exact for linear maps.
So the correction is that of the Kalman filter, and needs no points.

Source: Julier & Uhlmann 2004, Unscented filtering and nonlinear estimation, Proc. IEEE 92(3), for the scaled set;
Brossard, Barrau & Bonnabel 2020, A code for unscented Kalman filtering on manifolds, ICRA; van der Merwe & Wan 2001,
The square-root unscented Kalman filter, ICASSP; Bar-Shalom, Li & Kirubarajan 2001, section 5.4, for the gate.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._linalg import triangular, upper_solve
from covariant._typing import Matrix, Scalar, Vector
from covariant.models import MechanicalSystem, Motion
from covariant.observers.base import Covariance, Gate, as_gain, covariance_at, predict, white_acceleration
from covariant.observers.filters._noise_scale import scaled
from covariant.observers.filters._square_root_filter import AbstractSquareRootFilter, SquareRootState
from scalargraph.errors import InputError


class UKF(AbstractSquareRootFilter):
    """Unscented Kalman filter with 4n + 1 sigma points, in square-root form.

    Each covariance is a matrix (n, n) in the frame, equal everywhere; a function of the configuration; or a number, a
    variance in metric units that is equal in all directions.

    It uses no Jacobians of the model, and is better than `EKF` if the motion between two samples is strongly nonlinear.
    Each step integrates the model 4n + 1 times, so it costs more.

    Attributes:
        model: Mechanical system, in coordinates or on a Lie group.
        process_cov: Spectral density of the white acceleration noise [(rad/s²)² s, or (m/s²)² s].
        measurement_cov: Covariance of `local(q, y)` of one sample [rad² or m²].
        initial_velocity_std: Standard deviation of the initial velocity, whose mean is zero [rad/s or m/s], one for all
            components or one for each (n,); 1 by default. The gate uses it as the usual speed.
        substeps: Runge–Kutta steps in each sample; None (default) uses as many as dt and the friction need (offline).
        spread: Distance of the sigma points from the mean, in units of √(2n) standard deviations: α of the scaled set,
            whose other parameters are κ = 0 and β = 2. Closer points reduce the effect of terms beyond the quadratic
            ones on the covariance; between 0.52 and 1.93 no weight of the covariance is negative. 0.6 by default.
        gate: Gate that refuses outliers; None refuses nothing. See `Gate`.
        adaptive: Whether the filter learns the size of the unknown noise from its innovations: `process_cov` is then a
            lower bound, and the covariance grows if the log shows more. False by default.

    Raises:
        ValueError: A covariance is not valid, the measurement has no noise, or the spread is out of bounds.

    Example:
        >>> import numpy as np
        >>> from covariant import Record, models, observers
        >>> ukf = observers.UKF(models.oscillator(), process_cov=1e-3, measurement_cov=1e-4, substeps=1)
        >>> record = Record(np.array([0.0, 0.1]), np.zeros((2, 1)), np.array([[1.0], [np.cos(0.1)]]))
        >>> run = observers.run(ukf, record)
        >>> run.estimate[1].round(3).tolist()
        [0.995, -0.1]
    """

    model: MechanicalSystem
    process_cov: Covariance = eqx.field(converter=as_gain)
    measurement_cov: Covariance = eqx.field(converter=as_gain)
    initial_velocity_std: Scalar | Vector = eqx.field(default=1.0, converter=as_gain)
    substeps: int | None = eqx.field(default=None, static=True)
    spread: float = eqx.field(default=0.6, static=True)
    gate: Gate | None = Gate()
    adaptive: bool = eqx.field(default=False, static=True)

    def __check_init__(self):
        # The weight 4 − α⁻² − α² of the central point is positive for α² between 2 − √3 and 2 + √3.
        if not 0.52 <= self.spread <= 1.93:
            raise InputError(f"UKF: spread must be between 0.52 and 1.93; got {self.spread}")

    def _predicted(
        self, state: SquareRootState, u: Float[Array, "m"], dt: Scalar, carry: bool
    ) -> tuple[SquareRootState, Matrix | None]:
        manifold, n = self.model.manifold, state.v.shape[0]
        squared_radius = 2 * n * self.spread**2  # L + λ = α²(L + κ) of the scaled set, L = 2n

        def propagated(error):
            start = manifold.retract(state.q, error[:n])
            return predict(self.model, state.t, start, state.v + error[n:], u, dt, self.substeps)

        points = squared_radius**0.5 * state.root.T
        ends = jax.vmap(propagated)(jnp.concatenate([jnp.zeros_like(points[:1]), points, -points]))

        def errors_from(q, v):
            return jax.vmap(lambda p, w: jnp.concatenate([manifold.local(q, p), w - v]))(*ends)

        first = Motion(ends.q[0], ends.v[0])
        # These deviations are relative to the central point, so its weight does not matter here.
        mean = jnp.sum(errors_from(*first), axis=0) / (2 * squared_radius)
        q, v = manifold.retract(first.q, mean[:n]), first.v + mean[n:]
        deviations = errors_from(q, v)
        centre = 4 - self.spread**-2 - self.spread**2  # λ/(L + λ) + 1 − α² + β
        columns = jnp.concatenate([centre**0.5 * deviations[:1], deviations[1:] / (2 * squared_radius) ** 0.5]).T
        noise = white_acceleration(covariance_at(self.process_cov, self.model.space, q), dt)
        # The statistical linearisation of ΦS is half the difference of opposite points, divided by their distance from
        # the mean. S times its transpose is the covariance between the points before and after, as with a matrix Φ.
        plus, minus = jnp.split(deviations[1:], 2)
        carried = (plus - minus).T / (2 * squared_radius**0.5)
        noise, scale = scaled(state.noise_scale, upper_solve(state.root, carried.T).T, noise)
        # The triangular factor of both roots side by side is the root of the sum of their covariances.
        root = triangular(jnp.concatenate([columns, noise.astype(columns.dtype)], axis=1))
        new = state._replace(q=q, v=v, t=state.t + dt, root=root, gate=state.gate.advanced(dt), noise_scale=scale)
        return new, carried if carry else None
