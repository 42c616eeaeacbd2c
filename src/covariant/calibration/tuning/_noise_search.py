"""Noise of the greatest likelihood of innovations, on the errors of one run as in `_error_model`.

A force that the model does not know has a size in each component, and is forgotten: a Gauss–Markov process, of which a
random walk is the limit of a long time. Its sizes start from a force that explains all innovations, so that the model
need not be right in anything. The likelihood of its time constant has several maxima: several starts are tried.

Source: Schweppe 1965; Ljung 1999, System Identification, section 7.4; Schwarz 1978, Estimating the dimension of a
model, Annals of Statistics 6(2).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant.calibration.identification import (
    ErrorModel,
    Filtered,
    NoiseLevels,
    Unknowns,
    descend,
    error_model,
    from_later,
    kalman,
    levels,
    smoothed,
    stretch,
    total_loss,
)
from covariant.calibration.tuning._tuning_log import TuningLog, constant_gains
from covariant.models import Family, MechanicalSystem, Motion
from covariant.observers import with_fixed_substeps
from covariant.signals import AnyArray

LEAST = 0.01
"""Least noise of a reading, as a fraction of the innovations: with less of it no estimate changes."""
DRIFTS = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
"""Factors that are tried of the drift that a model file states."""
TIMES = 3
"""Number of time constants that the search starts from."""
RANGE = 1e4
"""Ratio of the bounds of a noise to what explains all innovations."""
STEPS, FIRST_STEPS = 30, 8
"""Largest number of steps of a search, and of that from each start."""


class RunErrors(NamedTuple):
    """A log, velocities (T, n) of a run over it, and a linear model of its errors."""

    log: TuningLog
    v: Float[np.ndarray, "T n"]
    system: ErrorModel

    @classmethod
    def of(
        cls,
        model: MechanicalSystem,
        log: TuningLog,
        estimate: tuple[Array, Array, Array],
        uncertain: Family | None,
        z: Array | None = None,
    ) -> "RunErrors":
        """Linearise at relative changes z (k,) of the uncertain numbers; by default, at the values of the model."""
        q, v, _ = estimate
        unknowns = Unknowns.none(model) if uncertain is None else Unknowns.of(uncertain, known=True)
        t, u, y = (jnp.asarray(each) for each in log.record[:3])
        sampled = np.linspace(0, len(t) - 2, min(200, len(t) - 1)).astype(int)
        fixed = with_fixed_substeps(constant_gains(model, 1.0, 1.0), log.rate, q[sampled], v[sampled], u[sampled])
        rows = stretch(t, y, u, Motion(q, v))
        z, steps = jnp.zeros_like(unknowns.first) if z is None else z, jnp.asarray(fixed.substeps or 1)
        return cls(log, np.asarray(v), error_model(unknowns, z, rows.start, rows, steps))

    def drifting(self, factor: float) -> "RunErrors":
        """The same with numbers that drift by a factor more."""
        return self._replace(system=self.system._replace(walk=factor * self.system.walk))

    def uncertain(self, noise: NoiseLevels, speed: jax.Array) -> Array:
        """Mean change (k,) of the uncertain numbers over the log, beside those of the linearisation."""
        n, size = self.v.shape[1], self.system.defect.shape[1]
        return jnp.mean(smoothed_errors(self.system, noise, speed)[:, 2 * n : size], axis=0)

    def filtered(self, noise: NoiseLevels, speed: jax.Array) -> Filtered:
        """The Kalman filter on the errors."""
        return _filtered(self.system, noise, speed)

    def corrected(self, errors: AnyArray) -> Float[np.ndarray, "T n"]:
        """Velocities (T, n) with estimates (T, ≥ 2n) of the errors of the run."""
        n = self.v.shape[1]
        return self.v + np.asarray(errors)[:, n : 2 * n]


_filtered, smoothed_errors, later_errors = eqx.filter_jit(kalman), eqx.filter_jit(smoothed), from_later


def largest_speed(logs: list[TuningLog]) -> jax.Array:
    """Largest velocity of the reference: the standard deviation of velocities before anything is measured."""
    return jnp.asarray(max(float(np.abs(log.velocity[log.tuned]).max()) for log in logs))


def likelier_drift(runs: list[RunErrors], noise: NoiseLevels) -> float:
    """Factor of the drift of numbers that walk with which the rows for tuning are likeliest; 1 if none is worth it."""
    speed = largest_speed([run.log for run in runs])

    def loss(factor: float) -> float:
        each = (run.drifting(factor).filtered(noise, speed).loss[run.log.tuned] for run in runs)
        return float(sum(map(jnp.sum, each)))

    losses = {factor: loss(factor) for factor in DRIFTS}
    best = min(losses, key=losses.__getitem__)
    return best if losses[1.0] - losses[best] > 2 else 1.0  # what a number has to be worth (Akaike 1974)


def best_noise(runs: list[RunErrors], frequency: float, size: np.ndarray, std: np.ndarray | None) -> NoiseLevels:
    """Noise of the greatest likelihood; with an unknown force where that gains more than its parameters cost.

    `frequency` [rad/s] and `size` (n,) are those of the least innovations, `std` the least noise (n,) of a reading.
    """
    logs, systems, n = [run.log for run in runs], [run.system for run in runs], len(size)
    least = LEAST * size if std is None else np.asarray(std, float)
    # At first one half of the variance of the innovations is noise of the reading.
    first = np.maximum(size / np.sqrt(2), least)
    explained = frequency**2 * float(np.sqrt(np.mean(first**2)))
    gains = [np.sqrt(np.mean(np.asarray(s.input_matrix)[:, n : 2 * n] ** 2, axis=(0, 1))) for s in systems]
    force = explained / np.mean(gains, axis=0)  # (n,) that explains all innovations
    rate = logs[0].rate
    ends = [len(log.first_part.t) for log in logs]
    parts = [jax.tree.map(lambda a, end=end: a[:end], system) for system, end in zip(systems, ends, strict=True)]
    masks = [np.asarray(part.present) & log.tuned[:end, None] for log, part, end in zip(logs, parts, ends, strict=True)]
    speed = largest_speed(logs)
    span = min(float(np.ptp(np.asarray(log.record.t))) for log in logs)
    usual = np.log([explained / np.sqrt(rate), *first, *force, 4 / rate])
    lower, upper = usual - np.log(RANGE), usual + np.log(RANGE)
    lower[1 : 1 + n], lower[-1], upper[-1] = np.log(least), np.log(4 / rate), np.log(max(span, 8 / rate))
    bounds = np.stack([lower, upper], axis=1)

    def search(start, free, steps):
        return descend(start, free, bounds, parts, masks, speed, steps)

    none = usual.copy()
    none[1 + n : 1 + 2 * n] = -np.inf
    plain, without = search(none, np.arange(1 + n), STEPS)
    starts = []
    for time in np.geomspace(8 / rate, span / 4, TIMES):
        start = np.concatenate([plain[: 1 + n], np.log(force), [np.log(time)]])
        start[0] = max(start[0] - np.log(10), lower[0])
        starts.append(search(np.clip(start, lower, upper), np.arange(2 + 2 * n), FIRST_STEPS))
    forced, lower_loss = search(min(starts, key=lambda each: each[1])[0], np.arange(2 + 2 * n), STEPS)
    count = sum(int(mask.sum()) for mask in masks)
    held_out = [np.asarray(system.present) & log.held_out[:, None] for log, system in zip(logs, systems, strict=True)]
    tried = [total_loss(z, systems, held_out, speed)[0] for z in (plain, forced)]
    # Schwarz's criterion for n + 1 parameters more, and what is held out has to confirm them.
    confirmed = without - lower_loss > (n + 1) * np.log(count) and tried[1] < tried[0]
    return levels(forced, n, n) if confirmed else levels(plain, n, n)._replace(force=jnp.asarray(0.0))
