"""Noise of a filter from its smoother: a step of expectation and maximisation.

The process noise w of a step has the covariance Q, and the smoother knows the error e after the prediction to have the
mean m and the covariance P̃. As w and e are Gaussian together, with the covariance Q between them,

    E wwᵀ = Q + Q(P⁻)⁻¹(m mᵀ + P̃ − P⁻)(P⁻)⁻¹Q.

Of the noise that one joint adds, `Q_j = B_j B_jᵀ` with p columns, the likeliest size is s_j times the assumed one,

    s_j = 1 + mean tr(B_jᵀ(P⁻)⁻¹(m mᵀ + P̃ − P⁻)(P⁻)⁻¹B_j)/p,

and the noise of a reading is the mean square of its distance to the smoothed position, with the variance of that. No
step lowers the likelihood of the innovations, up to the linearisation of the filter.

Source: Shumway & Stoffer 1982, An approach to time series smoothing and forecasting using the EM algorithm, Journal of
Time Series Analysis 3(4); Dempster, Laird & Rubin 1977, Maximum likelihood from incomplete data via the EM algorithm,
Journal of the Royal Statistical Society B 39(1).
"""

import dataclasses
import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from covariant._linalg import cholesky, lower_solve, solve_square, upper_solve
from covariant._typing import Matrix, Scalar, Vector
from covariant.observers.base import AbstractObserver, Rows, checked, covariance_at, in_jax, scan
from covariant.observers.filters._ekf import EKF
from covariant.observers.filters._intrinsic_kalman import IntrinsicKalman
from covariant.observers.filters._smoother import Recorder, Smoothing, Step, backward_map, error_before
from covariant.observers.filters._ukf import UKF
from covariant.signals import Record, StepCode
from scalargraph.errors import InputError


class NoiseStep(NamedTuple):
    """A filter with likelier noise.

    Attributes:
        observer: The filter with the new `process_cov` and `measurement_cov`.
        log_likelihood: Log-likelihood [nats] of the innovations of the filter as it was.

    Example:
        >>> import numpy as np
        >>> from covariant import Record, models, observers
        >>> t = np.linspace(0.0, 4.0, 401)
        >>> y = np.cos(t) + 0.01 * np.random.default_rng(0).normal(size=401)
        >>> ekf = observers.EKF(models.oscillator(), np.array([[1e-3]]), np.array([[4e-4]]), 1.0, substeps=1)
        >>> record, likelihoods = Record(t, np.zeros((401, 1)), y[:, None]), []
        >>> for _ in range(3):
        ...     ekf, likelihood = observers.noise_step(ekf, record)
        ...     likelihoods.append(likelihood)
        >>> likelihoods == sorted(likelihoods), round(float(ekf.measurement_cov[0, 0]) ** 0.5, 3)
        (True, 0.01)
    """

    observer: Any
    log_likelihood: float


class Statistics(NamedTuple):
    """What the smoother says of the noise.

    Attributes:
        process: Sums (J + 1,) of `tr(B_jᵀ…B_j)` over all steps, for each part of the process noise and for none of it.
        steps: Number of steps.
        squares: Sums (n,) of the squared noise of readings, relative to what is assumed.
        readings: Number (n,) of readings.
        log_likelihood: Log-likelihood of the innovations.
    """

    process: Float[Array, "J1"]
    steps: Scalar
    squares: Vector
    readings: Vector
    log_likelihood: Scalar


def noise_step(observer: AbstractObserver, record: Record) -> NoiseStep:
    """Replace the noise that a filter assumes by a likelier one, which its smoother sees in a record.

    A diagonal matrix gets a new variance for each joint; a number, or a matrix that is not diagonal, is scaled. Steps
    are repeated until the likelihood hardly rises: noise that readings show well takes a few, process noise that is
    small beside theirs many. What the gate refuses is left out, and so is the step before a new start. Memory is taken
    for all rows at once.

    Args:
        observer: An `IntrinsicKalman`, `EKF` or `UKF`, without ticks, slow states of the sensor, and further sensors.
        record: A log.

    Returns:
        The filter with the new noise, and the log-likelihood of the innovations with the old one.

    Raises:
        ValueError: From `Record.check`; an observer of another kind, or a noise that is a function.

    Example:
        >>> import numpy as np
        >>> from covariant import Record, models, observers
        >>> t = np.linspace(0.0, 4.0, 401)
        >>> y = np.cos(t) + 0.01 * np.random.default_rng(0).normal(size=401)
        >>> ekf = observers.EKF(models.oscillator(), np.array([[1e-3]]), np.array([[4e-4]]), 1.0, substeps=1)
        >>> step = observers.noise_step(ekf, Record(t, np.zeros((401, 1)), y[:, None]))
        >>> bool(step.observer.measurement_cov[0, 0] < 2e-4)
        True
    """
    if not isinstance(observer, IntrinsicKalman | EKF | UKF):
        raise InputError(
            f"noise_step: {type(observer).__name__} has no such noise; take an IntrinsicKalman, EKF or UKF"
        )
    if callable(observer.process_cov) or callable(observer.measurement_cov):
        raise InputError("noise_step: process_cov and measurement_cov must be numbers or matrices, not functions")
    if isinstance(observer, IntrinsicKalman) and (
        observer.quantum is not None or any(each.offset is not None for each in observer.slow)
    ):
        raise InputError("noise_step: the noise of encoders that count ticks, or have an offset, is not estimated")
    if getattr(observer, "sensors", ()):
        raise InputError("noise_step: the noise of sensors beside the positions is not estimated; leave them out")
    # A filter that is adaptive would change the sizes that are sought.
    fixed = dataclasses.replace(observer, adaptive=False)
    rows = in_jax(checked(observer, record))
    process, measurement = (jnp.asarray(each) for each in (observer.process_cov, observer.measurement_cov))
    parts = _parts(process)
    stacked = jnp.concatenate([parts, jnp.zeros_like(process)[None]])
    sums = _statistics(fixed, stacked, *rows)
    n = len(sums.squares)
    # Noise of r joints enters each Runge–Kutta step by position and velocity; more columns would be slower, not wrong.
    columns = 2 * n if observer.substeps is None else min(2 * observer.substeps * n // len(parts), 2 * n)
    sizes = 1 + (sums.process[:-1] - sums.process[-1]) / (columns * sums.steps)
    process = jnp.einsum("j,j...->...", sizes, parts)
    relative = sums.squares / sums.readings
    measurement = measurement * (jnp.diag(relative) if _independent(measurement) else jnp.mean(relative))
    new = eqx.tree_at(lambda o: (o.process_cov, o.measurement_cov), observer, (process, measurement))
    return NoiseStep(new, float(sums.log_likelihood))


def _independent(cov: Array) -> bool:
    """Whether a covariance is a diagonal matrix."""
    return bool(cov.ndim) and not np.any(np.asarray(cov) - np.diag(np.diag(cov)))


def _parts(cov: Array) -> Array:
    """Covariances (J, …) whose sum it is: one for each joint where they are independent, else all of it."""
    return jax.vmap(jnp.diag)(jnp.diag(jnp.diag(cov))) if _independent(cov) else cov[None]


@eqx.filter_jit
def _statistics(observer: Any, parts: Array, t: Array, u: Array, y: Array) -> Statistics:
    rows = Rows.of(t, u, y)
    states, recorded = scan(Recorder(observer), observer.init(y[0], t[0]), rows)[1]
    steps, info = recorded.step, recorded.info
    before, following, after = (
        jax.tree.map(lambda a, part=part: a[part], tree)
        for tree, part in ((states, slice(-1)), (steps, slice(1, None)), (rows, slice(1, None)))
    )
    root = observer.root(jax.tree.map(lambda a: a[-1], states))
    last = Smoothing(jnp.zeros_like(root[0]), root)

    def earlier(error, step):
        return (error_before(error, step), error)

    first, errors = jax.lax.scan(earlier, last, jax.vmap(backward_map)(following), reverse=True)
    # Row by row, as the filter runs, so that the predictions of one row are in memory.
    process: Any = jax.lax.map(lambda row: _of_step(observer, parts, *row), (before, after, following, errors))
    everywhere = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, errors)
    judged = recorded.result
    used = (judged == int(StepCode.OK)) | (judged == int(StepCode.COASTED)) | (jnp.arange(len(t)) == 0)
    missing: Any = jax.vmap(observer.model.manifold.missing)(y)
    seen = ~missing & used[:, None]
    squares = jax.vmap(lambda *row: _of_reading(observer, *row))(states, y, everywhere)
    likelihood = jnp.where(used[1:], jax.vmap(_likelihood)(info.innovation_cov[1:], info.nis[1:], seen[1:]), 0.0)
    stepped: Any = jnp.logical_not(following.restarted)
    return Statistics(
        jnp.sum(process, 0, where=stepped[:, None]),
        jnp.sum(stepped).astype(root.dtype),
        jnp.sum(jnp.where(seen, squares, 0.0), 0),
        jnp.sum(seen, 0).astype(root.dtype),
        jnp.sum(likelihood),
    )


def _of_step(observer: Any, parts: Array, state: Any, row: Rows, step: Step, error: Smoothing) -> Float[Array, "J1"]:
    """`tr(B_jᵀ(P⁻)⁻¹(m mᵀ + P̃ − P⁻)(P⁻)⁻¹B_j)` (J + 1,) of a step from a state, given the error after it."""
    certain = observer.with_root(state, jnp.zeros_like(step.root))
    # The error before the correction, in the frame there.
    mean = step.error + solve_square(step.reset, error.error)
    root = solve_square(step.reset, error.root)

    def of_part(part):
        noisy = eqx.tree_at(lambda o: o.process_cov, observer, part)
        added = noisy.root(noisy.predict(certain, row.u, row.dt))
        weights = upper_solve(step.predicted, lower_solve(step.predicted, added))
        return jnp.sum((mean @ weights) ** 2) + jnp.sum((root.T @ weights) ** 2) - jnp.sum(added * weights)

    return jax.vmap(of_part)(parts)


def _of_reading(observer: Any, state: Any, y: Array, error: Smoothing) -> Vector:
    """Expected squares (n,) of the noise of a reading, relative to what is assumed."""
    left = observer.model.manifold.ambient.towards(state.q, y)
    n = len(left)
    noise = covariance_at(observer.measurement_cov, observer.model.space, state.q)
    return ((left - error.error[:n]) ** 2 + jnp.sum(error.root[:n] ** 2, axis=1)) / jnp.diag(noise)


def _likelihood(cov: Matrix, nis: Scalar, seen: Bool[Array, "n"]) -> Scalar:
    """Log-likelihood of an innovation, of what is seen of it, with its normalised square."""
    both = seen[:, None] & seen[None, :]
    root = cholesky(jnp.where(both, cov, jnp.eye(len(cov), dtype=cov.dtype)))
    count = jnp.sum(seen).astype(cov.dtype)
    return -(2 * jnp.sum(jnp.log(jnp.diag(root))) + nis + count * math.log(2 * math.pi)) / 2
