"""Builds observers of a state-space model from its noise levels."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._typing import Matrix, Vector
from covariant.metrics import Equation, RiccatiMetric, metric_at
from covariant.models import StateSpace
from covariant.observers.filters._riccati import InformationEKF, Riccati
from covariant.observers.filters._state_ekf import StateEKF
from covariant.signals import StepCode
from scalargraph.errors import InputError

SETTLED = 0.1
"""Affine-invariant distance to the metric of an infinite past below which a past counts as long enough."""
POINTS = 8
"""Number of states around the first estimate for which the necessary length of the past is computed."""
FEWEST_STEPS, MOST_STEPS = 16, 256
"""Bounds on the number of Runge–Kutta steps along the past in every sample."""


class StateNoise(NamedTuple):
    """Noise and initial uncertainty of a state-space model.

    The registry's observers for state-space models are tuned by it. Choose `process_cov` by the errors of the model,
    for
    each state and per second. It is a density, while `measurement_cov` is the variance of one sample; `equation`
    converts between them with the rate.

    Attributes:
        process_cov: Spectral density (n, n) of the white noise in f [(unit of x)²/s].
        measurement_cov: Covariance (p, p) of one sample of the outputs [(unit of y)²].
        start: First estimate (n,).
        start_cov: Covariance (n, n) of the first estimate [(unit of x)²].
        rate: Sampling rate [Hz].

    Example:
        >>> import numpy as np
        >>> from covariant import observers
        >>> noise = observers.StateNoise(np.eye(2), np.array([[0.5]]), np.zeros(2), np.eye(2), rate=100.0)
        >>> noise.equation.measurement_cov.tolist()  # a spectral density
        [[0.005]]
    """

    process_cov: Matrix
    measurement_cov: Float[Array, "p p"]
    start: Vector
    start_cov: Matrix
    rate: float

    @property
    def equation(self) -> Equation:
        """Riccati equation, with samples treated as continuous white noise of density `measurement_cov / rate`."""
        return Equation(process_cov=self.process_cov, measurement_cov=self.measurement_cov / self.rate)


def covariance_ekf(model: StateSpace, noise: StateNoise) -> StateEKF:
    """Extended Kalman filter in covariance form."""
    return StateEKF(model, noise.process_cov, noise.measurement_cov, noise.start, noise.start_cov)


def information_ekf(model: StateSpace, noise: StateNoise) -> InformationEKF:
    """Extended Kalman filter in information form, with measurements treated as in continuous time."""
    return InformationEKF(model, noise.equation, noise.start, jnp.linalg.inv(noise.start_cov))


def riccati(model: StateSpace, noise: StateNoise) -> Riccati:
    """Observer with a contraction metric that is computed along the past of the estimate.

    The past is as long as states around the first estimate need.
    """
    equation, first = noise.equation, jnp.linalg.inv(noise.start_cov)
    std = np.sqrt(np.diag(np.asarray(noise.start_cov)))
    # The seed is fixed, so that the same model and noise give the same observer.
    offsets = np.random.default_rng(0).uniform(-0.5, 0.5, (POINTS, len(std)))
    points = jnp.asarray(np.asarray(noise.start) + offsets * std)
    solve = jax.jit(jax.vmap(lambda x: metric_at(model, equation, x, start=first, tolerance=SETTLED)))
    metrics = solve(points)
    settled = np.asarray(metrics.result) == int(StepCode.OK)
    if not settled.any():
        worst = StepCode(int(np.min(np.asarray(metrics.result)))).message
        raise InputError(f"riccati has no metric near the first estimate ({worst}); take a filter that needs none")
    length = float(np.max(np.asarray(metrics.horizon)[settled]))
    zero, u = jnp.zeros(()), jnp.zeros(model.inputs)
    fastest = np.abs(np.linalg.eigvals(np.asarray(jax.vmap(lambda x: model.jacobians(zero, x, u)[0])(points)))).max()
    # The step h satisfies h·|λ| ≤ 1/2 for the fastest eigenvalue λ of ∂f/∂x.
    steps = int(np.clip(np.ceil(2 * length * fastest), FEWEST_STEPS, MOST_STEPS))
    metric = RiccatiMetric(model, equation, length, steps, first)
    return Riccati(model, metric, noise.start, 0.5, equation.measurement_cov)
