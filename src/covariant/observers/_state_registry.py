"""The registry of observers of state-space models that `design` can tune: one entry for each."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._typing import Matrix, Vector
from covariant.metrics import Equation, RiccatiMetric, metric_at
from covariant.models import StateSpace
from covariant.observers._protocol import AbstractObserver
from covariant.observers._riccati import InformationEKF, Riccati
from covariant.observers._state_ekf import StateEKF
from covariant.signals import Result

SETTLED = 0.1
"""Affine-invariant distance to the metric of an infinite past, from which a past is long enough."""
POINTS = 8
"""States near the first estimate that are asked how long a past they need."""
FEWEST_STEPS, MOST_STEPS = 16, 256
"""Runge–Kutta steps along the past in every sample."""


class Noise(NamedTuple):
    """What a state-space model does not know.

    - `process_cov` (n, n): spectral density of white noise in its equation; `measurement_cov` (p, p): covariance of
      one sample, of which there are `rate` in a second.
    - `start` (n,), `start_cov` (n, n): first estimate and its covariance.
    """

    process_cov: Matrix
    measurement_cov: Float[Array, "p p"]
    start: Vector
    start_cov: Matrix
    rate: float

    @property
    def equation(self) -> Equation:
        """The equation of information and metric, in which samples are noise of as much density."""
        return Equation(process_cov=self.process_cov, measurement_cov=self.measurement_cov / self.rate)


class StateEntry(NamedTuple):
    """An observer of state-space models: its name on the command line, its class, `make(model, noise)`, what it is,
    when to choose it, and where it was published."""

    name: str
    observer: type[AbstractObserver]
    make: Callable[[StateSpace, Noise], AbstractObserver]
    about: str
    when: str
    source: str


def covariance_ekf(model: StateSpace, noise: Noise) -> StateEKF:
    """The filter in covariance form."""
    return StateEKF(model, noise.process_cov, noise.measurement_cov, noise.start, noise.start_cov)


def information_ekf(model: StateSpace, noise: Noise) -> InformationEKF:
    """The filter in information form, in continuous time."""
    return InformationEKF(model, noise.equation, noise.start, jnp.linalg.inv(noise.start_cov))


def riccati(model: StateSpace, noise: Noise) -> Riccati:
    """The observer whose metric is computed along the past of the estimate, as long as states near the first one need.

    Raises `ValueError` where the past outputs do not tell these states.
    """
    equation, first = noise.equation, jnp.linalg.inv(noise.start_cov)
    spread = np.sqrt(np.diag(np.asarray(noise.start_cov)))
    off = np.random.default_rng(0).uniform(-0.5, 0.5, (POINTS, len(spread)))
    points = jnp.asarray(np.asarray(noise.start) + off * spread)
    solve = jax.jit(jax.vmap(lambda x: metric_at(model, equation, x, start=first, tolerance=SETTLED)))
    found = solve(points)
    settled = np.asarray(found.result) == int(Result.OK)
    if not settled.any():
        worst = Result(int(np.min(np.asarray(found.result)))).message
        raise ValueError(f"riccati has no metric near the first estimate ({worst}); take a filter that needs none")
    length = float(np.max(np.asarray(found.horizon)[settled]))
    zero, u = jnp.zeros(()), jnp.zeros(model.inputs)
    fastest = np.abs(np.linalg.eigvals(np.asarray(jax.vmap(lambda x: model.jacobians(zero, x, u)[0])(points)))).max()
    steps = int(np.clip(np.ceil(2 * length * fastest), FEWEST_STEPS, MOST_STEPS))
    metric = RiccatiMetric(model, equation, length, steps, first)
    return Riccati(model, metric, noise.start, 0.5, equation.measurement_cov)


STATE_REGISTRY = (
    StateEntry(
        name="covariance-ekf",
        observer=StateEKF,
        make=covariance_ekf,
        about="extended Kalman filter with sampled measurements, covariance in Joseph form, and a gate for outliers",
        when="the default: it knows how certain each state is",
        source="Gelb 1974, 6.1",
    ),
    StateEntry(
        name="information-ekf",
        observer=InformationEKF,
        make=information_ekf,
        about="extended Kalman filter in information form, measurements as in continuous time",
        when="dense samples, and states that are unknown at first",
        source="Sanfelice & Praly 2015, (13)–(14)",
    ),
    StateEntry(
        name="riccati",
        observer=Riccati,
        make=riccati,
        about="correction through the contraction metric that a Riccati equation gives at the estimate",
        when="a gain that depends on the estimate alone, and not on how it got there",
        source="Sanfelice & Praly 2015, (11)",
    ),
)
"""All entries; the first is the one to begin with."""
