"""Noise of the greatest likelihood of innovations, on the errors of one run as in `_error_model`.

A force that the model does not know is a random walk, or is forgotten: a Gauss–Markov process, whose size and time
constant come from a coarse grid first, because the likelihood of both has several maxima.

Source: Schweppe 1965; Ljung 1999, System Identification, section 7.4; Schwarz 1978, Estimating the dimension of a
model, Annals of Statistics 6(2).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from covariant.calibration.identification import ErrorModel, Filtered, NoiseLevels, error_model, kalman, smoothed
from covariant.calibration.tuning._tuning_log import TuningLog, intrinsic
from covariant.models import MechanicalSystem
from covariant.observers import with_fixed_substeps

LEAST = 0.01
"""Least noise of a reading, as a fraction of the innovations: with less of it no estimate changes."""
TIMES, SIZES, REST = 7, np.geomspace(1e-3, 3.0, 8), (1.0, 0.3, 0.1, 0.01)
"""The grid of a force that is forgotten: number of time constants, from four samples to a quarter of the log; sizes, as
fractions of the acceleration that would explain all innovations; and what is left of the white acceleration."""


class RunErrors(NamedTuple):
    """A log, velocities (T, n) of a run over it, Runge–Kutta steps in each sample, and a linear model of its errors."""

    log: TuningLog
    v: Float[np.ndarray, "T n"]
    substeps: int
    system: ErrorModel

    @classmethod
    def of(cls, model: MechanicalSystem, log: TuningLog, estimate: Any) -> "RunErrors":
        q, v, _ = estimate
        t, u, y = (jnp.asarray(each) for each in log.record[:3])
        sampled = np.linspace(0, len(t) - 2, min(200, len(t) - 1)).astype(int)
        fixed = with_fixed_substeps(intrinsic(model, 1.0, 1.0), log.rate, q[sampled], v[sampled], u[sampled])
        substeps = fixed.substeps or 1
        return cls(log, np.asarray(v), substeps, error_model(model, q, v, t, u, y, substeps))

    def filtered(self, noise: NoiseLevels, speed: jax.Array) -> Filtered:
        """The Kalman filter on the errors."""
        return _filtered(self.system, noise, speed)

    def corrected(self, errors: Any) -> Float[np.ndarray, "T n"]:
        """Velocities (T, n) with estimates (T, 2n) of the errors of the run."""
        return self.v + np.asarray(errors)[:, self.v.shape[1] :]


_filtered, smoothed_errors = eqx.filter_jit(kalman), eqx.filter_jit(smoothed)


@eqx.filter_jit
def _losses(system: ErrorModel, noises: NoiseLevels, mask: jax.Array, speed: jax.Array) -> jax.Array:
    """Twice the negative log-likelihoods (K,) of K noises, whose fields have K rows."""

    def loss(*levels):
        return jnp.sum(jnp.where(mask, kalman(system, NoiseLevels(*levels), speed).loss, 0.0))

    return jax.vmap(loss)(*noises)


def largest_speed(logs: list[TuningLog]) -> jax.Array:
    """Largest velocity of the reference: the standard deviation of velocities before anything is measured."""
    return jnp.asarray(max(float(np.abs(log.velocity[log.tuned]).max()) for log in logs))


def best_noise(
    runs: list[RunErrors],
    frequency: float,
    size: np.ndarray,
    std: np.ndarray | None,
    forgotten: Float[np.ndarray, "n"] | None = None,
) -> NoiseLevels:
    """Noise of the greatest likelihood; with an unknown force where that gains more than its parameters cost.

    `frequency` [rad/s] and `size` (n,) are those of the least innovations, `std` the least noise (n,) of a reading.
    The force is forgotten where `forgotten` has the relative sizes (n,) of its components; without, it is a walk.
    """
    logs, systems = [run.log for run in runs], [run.system for run in runs]
    least = LEAST * size if std is None else np.asarray(std, float)
    # At first one half of the variance of the innovations is noise of the reading.
    first = np.maximum(size / np.sqrt(2), least)
    explained = frequency**2 * float(np.sqrt(np.mean(first**2)))
    gain = float(np.mean([np.abs(np.asarray(s.input_matrix)).max() for s in systems]))
    force = explained * np.sqrt(frequency / logs[0].rate) / gain
    ends = [len(log.first_part.t) for log in logs]
    parts = [jax.tree.map(lambda a, end=end: a[:end], system) for system, end in zip(systems, ends, strict=True)]
    masks = [np.asarray(part.present) & log.tuned[:end, None] for log, part, end in zip(logs, parts, ends, strict=True)]
    speed = largest_speed(logs)
    shape = np.ones(()) if forgotten is None else forgotten

    def noise(z):
        """Of the logarithms of the noise of acceleration, force and its time constant, and of readings."""
        measured = np.maximum(np.exp(z[3:]), least)
        levels = np.exp(z[0]), measured, np.exp(z[1]) * shape, np.exp(z[2])
        return NoiseLevels(*(jnp.asarray(x) for x in levels))

    def loss(z, of, counted):
        levels = noise(z)
        return sum(
            float(np.sum(np.where(mask, _filtered(one, levels, speed).loss, 0.0)))
            for one, mask in zip(of, counted, strict=True)
        )

    def cost(z):
        total = loss(z, parts, masks)
        return total if np.isfinite(total) else np.inf

    # The logarithms of no force, and of a time without an end.
    start = np.log([explained / np.sqrt(logs[0].rate), 1.0, 1.0, *first])
    start[1:3] = -np.inf, np.inf
    plain, without = _descend(cost, start)
    forced = plain.copy()
    count = sum(int(mask.sum()) for mask in masks)
    if forgotten is None:
        forced[1] = np.log(force)
        forced, lower = _descend(cost, forced)
        # Schwarz's criterion: one parameter more has to lower twice the negative log-likelihood by log N.
        return noise(forced if without - lower > np.log(count) else plain)
    spans = [float(np.ptp(np.asarray(log.record.t))) for log in logs]
    times = np.geomspace(4 / logs[0].rate, min(spans) / 4, TIMES)
    sizes = explained / gain * SIZES
    grid = [(plain[0] + np.log(rest), np.log(one), np.log(time), *plain[3:]) for time in times for one in sizes
            for rest in REST]  # fmt: skip
    levels = [noise(np.array(z)) for z in grid]
    noises = NoiseLevels(*(jnp.stack([jnp.asarray(x) for x in field]) for field in zip(*levels, strict=True)))
    totals = sum(_losses(part, noises, jnp.asarray(mask), speed) for part, mask in zip(parts, masks, strict=True))
    forced, lower = _descend(cost, np.array(grid[int(np.nanargmin(np.asarray(totals)))]))
    held_out = [np.asarray(system.present) & log.held_out[:, None] for log, system in zip(logs, systems, strict=True)]
    # Two parameters more, and what is held out has to confirm them.
    confirmed = without - lower > 2 * np.log(count)
    confirmed = confirmed and loss(forced, systems, held_out) < loss(plain, systems, held_out)
    return noise(forced if confirmed else plain)


def _descend(cost: Callable, start: np.ndarray) -> tuple[np.ndarray, float]:
    """Minimise the cost from a start whose infinite entries stay; returns the minimiser and the cost."""
    from scipy.optimize import minimize

    moving = np.isfinite(start)
    simplex = np.concatenate([np.zeros((1, moving.sum())), np.eye(int(moving.sum()))])

    def at(z):
        full = start.copy()
        full[moving] += z
        return full

    options = {"initial_simplex": simplex, "xatol": 0.03, "fatol": 0.1, "maxfev": 60 * int(moving.sum())}
    minimum = minimize(lambda z: cost(at(z)), simplex[0], method="Nelder-Mead", options=options)
    return at(minimum.x), float(minimum.fun)
