"""Predictions of a model over windows of a log, and their errors."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from covariant._typing import Number
from covariant.calibration.identification._rows import Rows
from covariant.models import MechanicalSystem, friction
from scalargraph import evaluate_batch

LONGEST_STEP = 0.01
"""Longest Runge–Kutta step [s] of a prediction."""
MOST_SUBSTEPS = 100
WORST_GROWTH, WORST_COORDINATE = 1.01, 1.05
"""A fit is worse whose held-out errors are larger than so many times those before, over all coordinates or in one: 1 %
is no difference."""
BEYOND_CHANCE, FEWEST_WINDOWS = 2.0, 3
"""Standard errors by which a coordinate has to be worse, and the least number of windows that tell these."""
FAR = 16.0
"""Cap on squared errors, as a multiple of their 90 % quantile; it limits the influence of outliers."""


class PredictionErrors(NamedTuple):
    """Root mean square errors of predictions over windows, each from the motion at its start that suits it best.

    Squares are capped at a multiple of their 90 % quantile, which limits the influence of outliers.

    Attributes:
        position: Errors (n,) of the positions [units of the frame].
        velocity: Errors (n,) of the velocities, against the reference [the same units a second].
        windows: Mean squares (W, n) of the errors of positions in each window, which show what is chance; or None.
        resolution: Difference of two errors that is none, such as a tick of the encoders.

    Example:
        >>> import numpy as np
        >>> from covariant.calibration import PredictionErrors
        >>> errors = PredictionErrors(position=np.array([0.02]), velocity=np.array([0.1]))
        >>> errors.position.tolist()
        [0.02]
    """

    position: Float[np.ndarray, "n"]
    velocity: Float[np.ndarray, "n"]
    windows: Float[np.ndarray, "W n"] | None = None
    resolution: float | Float[np.ndarray, "n"] = 0.0


def lagged(inputs: Float[Array, "S m"], steps: Float[Array, "S"], lag: Number) -> Float[Array, "S m"]:
    """Inputs after a first-order lag, as in `signals.lag_inputs`."""
    if not isinstance(lag, Tracer) and float(lag) == 0:
        return inputs

    def step(previous, row):
        # Exact for an input that is constant over the step.
        decay = jnp.exp(-row[1] / lag)
        current = decay * previous + (1 - decay) * row[0]
        return current, current

    return jax.lax.scan(step, jnp.zeros_like(inputs[0]), (inputs, steps))[1]


def needed_substeps(model: MechanicalSystem, rows: Rows) -> int:
    """Number of Runge–Kutta steps in one step of the log, none longer than 10 ms nor than 1/rate of the friction.

    The rate is bounded by the trace of the Jacobian of the friction at rest, where Coulomb friction is steepest, and at
    the largest velocities of the log.
    """
    t, q, v = (np.asarray(each) for each in (rows.t, rows.start.q, rows.start.v))
    longest = float(np.max(np.diff(t)[~np.asarray(rows.fresh)[1:]], initial=0.0))
    fastest = np.abs(v).max(axis=0)

    def rate(t, q, v, u):
        return -jnp.trace(jax.jacfwd(lambda w: friction(model, t, q, w, u))(v))

    sampled = np.arange(0, len(t), max(1, len(t) // 8))
    speeds = np.repeat([np.zeros_like(fastest), fastest], len(sampled), axis=0)
    sampled = np.tile(sampled, 2)
    inputs = np.asarray(rows.inputs)[np.asarray(rows.rows)[sampled]]
    rates = evaluate_batch(rate, t[sampled], q[sampled], speeds, inputs)
    # At h · rate ≤ 1 the Runge–Kutta method, stable on the real axis down to −2.78, has a margin.
    needed = longest * max(1 / LONGEST_STEP, np.nanmax(rates))
    return int(np.clip(np.ceil(needed), 1, MOST_SUBSTEPS))


def error_growth(before: PredictionErrors, after: PredictionErrors, resolved: bool = False) -> float:
    """Ratio of the RMS position errors after and before a fit; infinite if those after it are not finite.

    If `resolved`, differences below the resolution are no growth.
    """
    ratio = float(np.sqrt(np.mean(_growths(before, after if resolved else after._replace(resolution=0.0)) ** 2)))
    return ratio if np.isfinite(ratio) else np.inf


def predicts_worse(before: PredictionErrors, after: PredictionErrors) -> bool:
    """Whether a fit predicts worse than before, over all coordinates or one of them clearly."""
    return not error_growth(before, after, True) <= WORST_GROWTH or bool(worse_coordinates(before, after).any())


def worse_coordinates(before: PredictionErrors, after: PredictionErrors) -> Bool[np.ndarray, "n"]:
    """Coordinates (n,) that a fit predicts worse than before, by more than chance does where windows show that."""
    worse = ~(_growths(before, after) <= WORST_COORDINATE)
    if before.windows is None or after.windows is None:
        return worse
    more = after.windows - before.windows
    more = more[np.isfinite(more).all(axis=1)]
    if len(more) < FEWEST_WINDOWS:
        return worse
    chance = np.std(more, axis=0, ddof=1) / np.sqrt(len(more))
    return worse & ~(np.mean(more, axis=0) <= BEYOND_CHANCE * chance)


def _growths(before: PredictionErrors, after: PredictionErrors) -> Float[np.ndarray, "n"]:
    """Ratios of the RMS position errors, of which none is above one by less than the resolution."""
    old, new = np.asarray(before.position), np.asarray(after.position)
    # A coordinate without any error before the fit does not count.
    growths = new / np.where(old > 0, old, np.inf)
    return np.where(new - old <= np.asarray(after.resolution), np.minimum(growths, 1.0), growths)


def mean_square(r: np.ndarray) -> float:
    """Mean square of errors, robust to outliers; infinite if one is not finite, or there are none."""
    if not r.size or not np.isfinite(r).all():
        return float("inf")
    square = r**2
    return float(np.mean(np.minimum(square, FAR * np.quantile(square, 0.9))))
