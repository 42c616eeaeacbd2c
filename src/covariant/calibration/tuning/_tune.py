"""Noise and gains from logs: those with the likeliest innovations, confirmed on held-out rows.

The gains of a constant-gain observer are those of several candidates whose velocities are nearest to what other rows
tell, as in `_constant_gains`. The noise of Kalman filters is that of the greatest likelihood of their innovations,
computed on the errors of one run as in `_error_model`. A reference is compared with on the later rows only; what is
worse there than before is not taken.

Source: Ljung 1999, System Identification, section 7.4, for prediction errors and likelihood; Schweppe 1965; Mehra 1970,
On the identification of variances and adaptive Kalman filtering, IEEE TAC 15(2), for whiteness.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant.calibration.identification import NoiseLevels
from covariant.calibration.tuning._constant_gains import (
    Candidate,
    Judge,
    Poles,
    as_frequency,
    best_gains,
    best_innovations,
    candidates,
)
from covariant.calibration.tuning._data_sheet import DataSheet
from covariant.calibration.tuning._estimators import observer_gains
from covariant.calibration.tuning._filters import relative_error
from covariant.calibration.tuning._judge import ErrorRatio
from covariant.calibration.tuning._noise_search import RunErrors, best_noise, largest_speed, likelier_drift
from covariant.calibration.tuning._tuning_log import Runs, TuningLog, by_jax, followed, refuse_noise_free, tuning_logs
from covariant.models import Family, MechanicalSystem
from covariant.signals import Record

NumpyArray = np.ndarray


class HeldOut(NamedTuple):
    """Errors of the tuned estimators on the held-out rows, for n velocities.

    Attributes:
        one_step: Root mean square (n,) of the innovations of the constant-gain observer [rad or m].
        gains_error: Velocity RMSE (n,) of this observer [rad/s or m/s].
        kalman_error: Velocity RMSE (n,) of the Kalman filter [rad/s or m/s].
        relative: The same two errors (2,) as fractions of the velocities, root mean square over the coordinates.
        likelihood: Mean log-likelihood of a measured number under the Kalman filter [nats].
        nis: Mean normalised innovation squared; 1 is expected.
        correlation: Correlation (n,) of neighbouring innovations of the Kalman filter; 0 where they are white.

    Example:
        >>> import numpy as np
        >>> from covariant.calibration import HeldOut
        >>> one = np.array([0.01])
        >>> errors = HeldOut(one, 3 * one, 2 * one, np.array([0.03, 0.02]), likelihood=4.8, nis=1.1, correlation=one)
        >>> ("constant gains", "Kalman filter")[errors.relative.argmin()]
        'Kalman filter'
    """

    one_step: Float[NumpyArray, "n"]
    gains_error: Float[NumpyArray, "n"]
    kalman_error: Float[NumpyArray, "n"]
    relative: Float[NumpyArray, "2"]
    likelihood: float
    nis: float
    correlation: Float[NumpyArray, "n"]


class Tuning(NamedTuple):
    """Gains and noise estimated from logs, and their errors on the held-out rows.

    Attributes:
        natural_frequency: ω [rad/s] of a constant-gain observer, α = 2ζω and β = ω².
        damping: Its damping ratio ζ.
        noise: Noise levels of a Kalman filter.
        before: Held-out errors with the gains and noise of a data sheet; None where none was given.
        after: Held-out errors with the tuned gains and noise.
        rows: Number of rows for tuning.
        candidates: Gains that were compared by their velocities on held-out rows; empty where none were.
        source: Which of them these gains are.
        force_rate: Rate ρ [1/s] at which `IntrinsicForce` learns a force; 0 for an observer without one.
        same: Least and largest ω [rad/s] of gains that are as good within 2 %, or better; None where that is unknown.
        gains_kept: Whether the gains are those of the data sheet because others, which seemed better, had a larger
            velocity error on held-out rows.
        noise_kept: Why the noise is that of the data sheet: "likelihood", because held-out measurements are likelier
            with it, or "velocities" from the verb `tune`, because a filter's velocities are; empty where it is tuned.
        drift: Standard deviation of the relative change in a second of numbers that a filter estimates; 0 for none.

    Example:
        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> from covariant.calibration import HeldOut, Tuning
        >>> from covariant.calibration.identification import NoiseLevels
        >>> one = np.array([0.01])
        >>> errors = HeldOut(one, 3 * one, 2 * one, np.array([0.03, 0.02]), likelihood=4.8, nis=1.1, correlation=one)
        >>> noise = NoiseLevels(jnp.array(0.05), jnp.array([1e-3]), jnp.array(0.0))
        >>> Tuning(5.0, 0.7, noise, None, errors, rows=1000).after.nis
        1.1
    """

    natural_frequency: float
    damping: float
    noise: NoiseLevels
    before: HeldOut | None
    after: HeldOut
    rows: int
    candidates: tuple[Candidate, ...] = ()
    source: str = "innovations"
    force_rate: float = 0.0
    same: tuple[float, float] | None = None
    gains_kept: bool = False
    noise_kept: str = ""
    drift: float = 0.0


def tune(
    model: MechanicalSystem,
    records: Sequence[Record],
    velocities: Sequence[Float[np.ndarray, "_ n"]],
    *,
    std: Float[np.ndarray, "n"] | None = None,
    before: DataSheet | None = None,
    progress: Callable[[str], object] = lambda stage: None,
    runs: Runs | None = None,
    names: Sequence[str] = (),
    uncertain: Family | None = None,
) -> Tuning:
    """Tune gains and noise of a model on the first two thirds of each record, and confirm them on the rest.

    Use it where the parameters of the model are right already; fit these first. A wrong mass or friction is
    otherwise covered by noise. A log should be several times as long as the slowest motion in it. The verb
    `covariant.tune` starts from files, and prints lines for the model file.

    Args:
        model: The mechanical system.
        records: The logs.
        velocities: Reference velocities (T, n) of each, as from `scoring.zero_phase_velocity`, to judge by.
        std: Least standard deviation (n,) of a reading, such as that of one tick of an encoder; by default a small
            fraction of the innovations.
        before: Data sheet whose gains and noise are judged as well. What is worse than it on held-out rows, by the
            likelihood or by the error of velocities, is not taken.
        progress: Called with the name of each of the three stages when it begins.
        runs: Runs the observers with constant gains, of which there are dozens; by default JAX, one by one.
        names: What messages call the records; by default record 1, record 2, ….
        uncertain: The model with the numbers open that a filter estimates along with the motion, as the `family` of a
            model file; none by default.

    Returns:
        Gains, noise, and their errors on the held-out rows.

    Raises:
        ValueError: The records are too short, something in them stands still or they have no noise, or no gains give a
            finite estimate.
    """
    names = names or [f"record {k + 1}" for k in range(len(records))]
    logs = tuning_logs(model, records, velocities, names)
    rate, n = logs[0].rate, logs[0].velocity.shape[1]
    progress("gains")
    runner = runs or by_jax
    frequency, damping, size = best_innovations(model, logs, runner)
    refuse_noise_free(size, logs)
    proposed: dict[str, Poles] = {"innovations": (frequency, damping, 0.0)}
    estimates = followed(model, logs, proposed["innovations"], runner)
    progress("noise")
    drift = 0.0 if uncertain is None else uncertain.file.parameters_drift
    speed, both = largest_speed(logs), list(zip(logs, estimates, strict=True))
    errors = [RunErrors.of(model, *each, uncertain) for each in both]
    likeliest = best_noise(errors, frequency, size, std)
    if uncertain is not None:  # forces need not be linear in numbers that are far from those of the model
        at = [each.uncertain(likeliest, speed) for each in errors]
        errors = [RunErrors.of(model, *each, uncertain, z) for each, z in zip(both, at, strict=True)]
        likeliest = best_noise(errors, frequency, size, std)
        if (by := likelier_drift(errors, likeliest)) != 1:
            drift, errors = by * drift, [each.drifting(by) for each in errors]
            likeliest = best_noise(errors, frequency, size, std)
    noise = likeliest
    progress("held-out rows")
    baseline, kept, old = None, "", None
    if before is not None:
        proposed |= {"model file": sheet_poles(model, before, rate)}
        old = followed(model, logs, proposed["model file"], runner), noise_levels(before, rate, n)
        baseline = _held_out_errors(errors, *old, speed)
        if _held_out_errors(errors, estimates, noise, speed).likelihood < baseline.likelihood:
            kept, noise, likeliest = "likelihood", old[1], old[1]
    filtered = [each.filtered(likeliest, speed) for each in errors]
    proposed |= candidates(likeliest, [each.system for each in errors], filtered, rate)
    judges = [Judge.of(each, likeliest, speed) for each in errors]
    judged, best, same = best_gains(model, logs, proposed, judges, runner, bool(np.any(likeliest.force)))
    gains_kept = False
    gained = followed(model, logs, (best.natural_frequency, best.damping, best.force_rate), runner)
    if old is not None and best.source != "model file" and _worse(logs, *(_velocities(e) for e in (gained, old[0]))):
        best, gains_kept, gained = next(each for each in judged if each.source == "model file"), True, old[0]
    after = _held_out_errors(errors, gained, noise, speed)
    return Tuning(
        best.natural_frequency,
        best.damping,
        noise,
        baseline,
        after,
        sum(int(log.tuned.sum()) for log in logs),
        judged,
        best.source,
        best.force_rate,
        None if gains_kept else same,
        gains_kept,
        kept,
        drift,
    )


def sheet_poles(model: MechanicalSystem, sheet: DataSheet, rate: float) -> Poles:
    """Natural frequency, damping and force rate of the observer that is designed from a data sheet by default."""
    learns = sheet.external_force_time if sheet.force_rate is None and sheet.natural_frequency is None else None
    gains = observer_gains(sheet, rate, model.space if learns or sheet.force_rate else None)
    return *as_frequency(gains.alpha, gains.beta), gains.force_rate


def _velocities(estimates: list[Any]) -> list[np.ndarray]:
    return [np.asarray(v) for _, v, _ in estimates]


def _worse(logs: list[TuningLog], new: list[np.ndarray], old: list[np.ndarray]) -> bool:
    """Whether velocities are clearly farther from the reference than others on held-out rows."""
    reference = [log.velocity for log in logs]
    parts = ([v[log.held_out] for v, log in zip(each, logs, strict=True)] for each in (new, old, reference))
    return ErrorRatio.of_velocities(*parts).is_worse


def noise_levels(sheet: DataSheet, rate: float, n: int) -> NoiseLevels:
    """Noise levels of a Kalman filter for n velocities from a data sheet; the force is 0 where the sheet has none."""
    acceleration = jnp.asarray(np.sqrt(2 * sheet.white_time(rate)) * sheet.acceleration_std)
    std = jnp.asarray(sheet.stds(n))
    if sheet.external_force_std is None:
        return NoiseLevels(acceleration, std, jnp.asarray(sheet.external_force or 0.0))
    force, forgotten = (jnp.asarray(each) for each in (sheet.external_force_std, sheet.external_force_time))
    return NoiseLevels(acceleration, std, force, forgotten)


def _held_out_errors(errors: list[RunErrors], gained: list[Any], noise: NoiseLevels, speed: Array) -> HeldOut:
    """Errors on the held-out rows: of the runs `gained` with constant gains, and of a noise by the errors of a run."""
    parts = []
    for each, (_, gains_v, r) in zip(errors, gained, strict=True):
        log, result = each.log, each.filtered(noise, speed)
        rows, present = log.held_out, np.asarray(each.system.present)
        white = np.asarray(result.innovation) / np.where(present, result.spread, 1.0)
        off = each.corrected(result.error) - log.velocity
        columns = (r, np.asarray(gains_v) - log.velocity, off, log.velocity, np.asarray(result.loss), white, present)
        parts.append([column[rows] for column in columns])
    products = np.sum([_neighbours(*part[-2:]) for part in parts], axis=0)
    r, gains, kalman, v, loss, white, present = (np.concatenate(each) for each in zip(*parts, strict=True))
    count = present.sum()

    def rms(x):
        return np.sqrt(np.mean(x**2, axis=0))

    relative = np.array([relative_error(v + off, v) for off in (gains, kalman)])
    return HeldOut(
        np.sqrt(np.sum(r**2, axis=0) / present.sum(axis=0)),
        rms(gains),
        rms(kalman),
        relative,
        # `loss` lacks the constant log 2π of each measured number.
        float(-0.5 * (loss.sum() / count + np.log(2 * np.pi))),
        float(np.sum(white**2) / count),
        products[0] / products[1],
    )


def _neighbours(white: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Sums (2, n) of the products of neighbouring innovations, and of their squares."""
    both = present[1:] & present[:-1]
    return np.stack([np.sum(both * white[1:] * white[:-1], axis=0), np.sum(both * white[1:] ** 2, axis=0)])
