"""Defines the extended Kalman filter, the standard choice, with the error expressed in the frame of the space.

In coordinates it is the usual filter on (q, v); on SO(3) it is the multiplicative filter with momentum dynamics; on
SE(3) it is the left-invariant filter.

Source: Gelb 1974, Applied Optimal Estimation, section 6.1. Lefferts, Markley &
Shuster 1982 for the multiplicative error; Barrau & Bonnabel 2017, section 3, for the left-invariant one; Bar-Shalom,
Li & Kirubarajan 2001, section 5.4, for the gate.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._linalg import triangular
from covariant._typing import Matrix, Scalar, Vector
from covariant.models import MechanicalSystem
from covariant.observers.base import Covariance, Gate, as_gain, covariance_at, predict, white_acceleration
from covariant.observers.filters._noise_scale import scaled
from covariant.observers.filters._square_root_filter import AbstractSquareRootFilter, SquareRootState


class EKF(AbstractSquareRootFilter):
    """Extended Kalman filter whose Jacobians are those of the integrated model, by automatic differentiation.

    It is the standard choice if the noise is known and the initial velocity is not. Its gain follows from the
    covariances, so it adapts to gaps and to the sampling rate. It is cheaper than `UKF`; in coordinates its result
    depends on the chart. `IntrinsicKalman` does not depend on the chart, and also estimates forces, biases and
    parameters. `StateEKF` is the filter for a model in state-space form.

    Attributes:
        model: Mechanical system, in coordinates or on a Lie group.
        process_cov: Spectral density (n, n) of the white acceleration noise, in the frame
            [(rad/s²)² s, or (m/s²)² s].
        measurement_cov: Covariance (n, n) of `local(q, y)` of one sample [rad² or m²].
        initial_velocity_std: Standard deviation of the initial velocity, whose mean is zero [rad/s or m/s], one for all
            components or one for each (n,); 1 by default. The gate uses it as the usual speed.
        substeps: Runge–Kutta steps in each sample; None (default) uses as many as dt and the friction need (offline).
        gate: Gate that refuses outliers; None refuses nothing. See `Gate`.
        adaptive: Whether the filter learns the size of the unknown noise from its innovations: `process_cov` is then a
            lower bound, and the covariance grows if the log shows more. False by default.

    Raises:
        ValueError: A covariance or the standard deviation is not valid, or the measurement has no noise.

    Example:
        >>> import numpy as np
        >>> from covariant import Record, models, observers
        >>> t = np.linspace(0.0, 5.0, 501)
        >>> ekf = observers.EKF(models.oscillator(), np.array([[1e-3]]), np.array([[1e-4]]), substeps=1)
        >>> run = observers.run(ekf, Record(t, np.zeros((501, 1)), np.cos(t)[:, None]))
        >>> bool(np.allclose(run.estimate[-1], [np.cos(5.0), -np.sin(5.0)], atol=1e-2))
        True
    """

    model: MechanicalSystem
    process_cov: Covariance = eqx.field(converter=as_gain)
    measurement_cov: Covariance = eqx.field(converter=as_gain)
    initial_velocity_std: Scalar | Vector = eqx.field(default=1.0, converter=as_gain)
    substeps: int | None = eqx.field(default=None, static=True)
    gate: Gate | None = Gate()
    adaptive: bool = eqx.field(default=False, static=True)

    def _predicted(
        self, state: SquareRootState, u: Float[Array, "m"], dt: Scalar, carry: bool
    ) -> tuple[SquareRootState, Matrix | None]:
        n = state.v.shape[0]

        def propagated_error(error):
            start = self.model.manifold.retract(state.q, error[:n])
            end = predict(self.model, state.t, start, state.v + error[n:], u, dt, self.substeps)
            # Its value is zero, since the end is compared with itself; its derivative is the displacement in the frame.
            apart = self.model.manifold.local(jax.lax.stop_gradient(end.q), end.q)
            return jnp.concatenate([apart, end.v]), end

        transition, (q, v) = jax.jacfwd(propagated_error, has_aux=True)(jnp.zeros(2 * n, state.v.dtype))
        noise = white_acceleration(covariance_at(self.process_cov, self.model.space, q), dt)
        noise, scale = scaled(state.noise_scale, transition, noise)
        carried = transition @ state.root
        root = triangular(jnp.concatenate([carried, noise.astype(carried.dtype)], axis=1))
        new = state._replace(q=q, v=v, t=state.t + dt, root=root, gate=state.gate.advanced(dt), noise_scale=scale)
        return new, carried if carry else None
