"""Defines the observer of a lifted kinetic-energy metric, which converges from far away at a large enough gain.

In continuous time it is the observer of Sanfelice & Praly's part II in the metric `P = m|ξ|² + |w|²` of the states,
with the position error ξ, the velocity error ζ and `w = ζ − σξ`:

    q̂' = v̂ + α log_q̂ y,   ∇v̂ = S(q̂) + β log_q̂ y,   β = σα

Between samples the estimate follows the model. A sample y, a time h after the previous one, moves the estimate along
the geodesic to y and changes its velocity in the same direction:

    q̂ ← exp_q̂(θ log_q̂ y),   v̂ ← Π(v̂ + σθ log_q̂ y),   θ = αh/(1 + αh),   σ = β/α,

where Π is the parallel transport along that geodesic. θ is the fraction of the error that an implicit Euler step of
`ξ' = −αξ` removes; it is below 1 for all α and h. The correction is the proximal step of `½αh d(q, y)²` in the metric
`|ξ|² + |w|²`, so that no α makes it unstable. In a flat metric it reduces ξ to (1 − θ)ξ and leaves w unchanged, however
large the errors are. It uses neither the source nor the curvature at y, and neglects no terms of higher order.

The model alone acts on w between samples. That limits σ and h, but not α.

Source: Sanfelice & Praly 2015, (3), with half of the squared distance as δ. Rockafellar 1976, Monotone operators and
the proximal point algorithm, SIAM J. Control Optim. 14(5), for the step; Kalata 1984, The tracking index, IEEE TAES
20(2), for constant gains θ and σθh beside a prediction.
"""

import equinox as eqx
from jaxtyping import Array, Float

from covariant._typing import Scalar, Vector
from covariant.geometry import Budget
from covariant.models import source
from covariant.observers.base import time_since_measurement
from covariant.observers.constant_gain._geodesic import (
    AbstractGeodesicObserver,
    GeodesicInfo,
    GeodesicState,
    Path,
    path_to,
)


class LagrangianMetric(AbstractGeodesicObserver):
    """Follow the model, corrected along the geodesic to the measurement; converges from far away at high gains.

    It is an observer of Sanfelice & Praly in the lifted kinetic-energy metric, `q̂' = v̂ + α log_q̂ y`,
    `∇v̂ = S(q̂) + β log_q̂ y`, whose samples are implicit steps.

    A sample at the time h after the previous one removes the fraction `θ = αh/(1 + αh)` of the error along the geodesic
    to the measurement, and adds `σ = β/α` times that displacement to the velocity. Unlike `Geodesic` it does not
    compensate the model's effect on an error between samples: to first order `ξ' = ζ − αξ, ζ' = −Kξ − βξ` with
    `K = R(·, v)v − ∇S`. In exchange no α is too large and, in a flat metric, no error is. β/α must be well below 2/h.
    If no geodesic is found, the first-order error of `Intrinsic` replaces it, and `result` says `NOT_CONVERGED`.

    Use it for a high gain at a low sampling rate, long gaps, or large errors. At low gains on a curved space
    it may not converge where `Intrinsic` does.

    Attributes:
        model: The mechanical system.
        alpha: Gain α [1/s].
        beta: Gain β [1/s²].
        budget: Work spent on the geodesic, as for `Geodesic`.
        substeps: Number of Runge–Kutta steps in each sample; None (default) uses as many as dt and the friction need
            (offline).

    Raises:
        ValueError: A gain is not positive and finite.

    Example:
        A pendulum is seen 20 times a second, and started 100 turns away: the angle is a number here, not a circle.

        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> from covariant import Record, models, observers
        >>> pendulum = models.Lagrangian(lambda q: jnp.eye(1), lambda q: -9.81 * jnp.cos(q[0]))
        >>> observer = observers.LagrangianMetric(pendulum, alpha=60.0, beta=360.0)
        >>> t = 0.05 * np.arange(100)
        >>> y = np.zeros((100, 1))  # at rest
        >>> y[0] = 628.0
        >>> run = observers.run(observer, Record(t, np.zeros((100, 1)), y))
        >>> bool(np.abs(run.estimate[-1]).max() < 1e-6)
        True
    """

    substeps: int | None = eqx.field(default=None, static=True)

    def correct(self, state: GeodesicState, u: Float[Array, "m"], y: Array) -> tuple[GeodesicState, GeodesicInfo]:
        path, waited = path_to(self.model, state.q, state.log, y, self.budget), time_since_measurement(state)
        part = self.alpha * waited / (1 + self.alpha * waited)  # θ
        # The change of velocity is along the geodesic, so transport maps it to the same multiple of the velocity there.
        kicked = state.v + self.beta * waited / (1 + self.alpha * waited) * path.log  # σθ
        return self._moved(state, u, y, path, part, kicked, kicked, path.result)

    def _correction(
        self, t: Scalar, state: GeodesicState, u: Float[Array, "m"], y: Array, budget: Budget
    ) -> tuple[Path, Vector]:
        return path_to(self.model, state.q, state.log, y, budget), source(self.model, t, state.q, u)
