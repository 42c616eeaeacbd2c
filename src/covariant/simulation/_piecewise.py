"""Simulates a model under the inputs of a log, which are known at stamps and held or linear between them.

Within each interval between stamps the input is smooth, so an adaptive method integrates it without losing order at the
jumps.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from covariant._integrate import compiled
from covariant._typing import Number
from covariant.models import MechanicalSystem, StateSpace
from covariant.signals import Record
from covariant.simulation._simulate import simulate
from scalargraph.errors import InputError

DIGITS = 12
"""Number of decimals to which the times [s] at which intervals begin are rounded."""

NumpyArray = np.ndarray


class PiecewiseInputs(eqx.Module):
    """Inputs in J intervals: `value + rate s + transient exp(−decay s)`, with s [s] since the interval began.

    Args:
        begin: Times (J,) at which the intervals begin [s]; the last one has no end.
        value: Constant parts (J, m).
        rate: Slopes (J, m) [1/s].
        transient: Parts (J, m) that decay, caused by a lag.
        decay: Inverse of the time constant of that lag [1/s]; 0 if there is none.

    Example:
        >>> import numpy as np
        >>> from covariant.simulation import logged_inputs
        >>> inputs = logged_inputs(np.array([0.0, 1.0]), np.array([[2.0], [5.0]]))
        >>> inputs.at(1, 1.5).tolist()
        [5.0]
    """

    begin: Float[NumpyArray, "J"]
    value: Float[NumpyArray, "J m"]
    rate: Float[NumpyArray, "J m"]
    transient: Float[NumpyArray, "J m"]
    decay: Number = 0.0

    def at(
        self, interval: int | Int[NumpyArray, "*k"], t: Number | Float[NumpyArray, "*k"]
    ) -> Float[NumpyArray, "*k m"]:
        """Inputs at times within some of the intervals.

        Args:
            interval: Index of an interval, from 0, or several (*k).
            t: Time [s], or one for each interval (*k).

        Returns:
            The inputs (*k, m).
        """
        value, rate, transient = (part[interval] for part in (self.value, self.rate, self.transient))
        begin, time = (np.asarray(each)[..., None] for each in (self.begin[interval], t))
        return np.asarray(_acting(begin, value, rate, transient, self.decay, time))


def logged_inputs(
    t: Float[NumpyArray, "T"],
    u: Float[NumpyArray, "T m"],
    between: str = "held",
    delay: float | Sequence[float] = 0.0,
    lag: float = 0.0,
    at: Float[NumpyArray, "_"] | None = None,
    lead: float | Sequence[float] = 0.0,
) -> PiecewiseInputs:
    """Inputs that act on a machine to which the inputs of a log are applied.

    Args:
        t: Stamps (T,) of the log [s].
        u: Logged inputs (T, m). Before the first stamp the first one acts.
        between: How the input changes from one stamp to the next, as in `signals.acting_inputs`: "held" or "linear".
        delay: Time [s] from its stamp until an input acts; one number, or one for each input.
        lag: Time constant [s] of a first-order lag between logged and acting input, which begins at rest; 0 for none.
        at: Further times [s] at which intervals begin, such as those of measurements.
        lead: Time [s]; an input is increased by this time multiplied by its rate. If inputs are held, the jump at a
            stamp is spread until the next stamp. One number, or one for each input.

    Returns:
        One interval from each of all these times to the next.

    Raises:
        ValueError: `between` is neither "held" nor "linear".

    Example:
        >>> import numpy as np
        >>> from covariant.simulation import logged_inputs
        >>> inputs = logged_inputs(np.array([0.0, 1.0]), np.array([[0.0], [2.0]]), "linear", delay=0.5)
        >>> inputs.begin.tolist(), inputs.at(0, 1.0).tolist()
        ([0.5, 1.5], [1.0])
    """
    if between not in ("held", "linear"):
        raise InputError(f"logged_inputs: between must be 'held' or 'linear'; got {between!r}")
    late, ahead = (np.broadcast_to(np.asarray(each, float), u.shape[1:]) for each in (delay, lead))
    # Times that agree in so many digits count as one, although they were computed in different ways.
    begin = np.unique(np.round(np.concatenate([(t[:, None] + late).ravel(), [] if at is None else at]), DIGITS))
    steps = np.diff(begin)
    middle = begin + np.append(steps / 2, 1.0)  # in the middle, rounding of the ends cannot change which input acts
    # −1 stands for before the first stamp: `rise` has a zero row there, and below the index becomes 0, the first input.
    k = np.searchsorted(t, middle[:, None] - late) - 1
    slope, none = np.diff(u, axis=0) / np.diff(t)[:, None], np.zeros_like(u[:1])
    rise = slope if between == "linear" else np.zeros_like(slope)
    rise = np.concatenate([none, rise, none])  # no slope before the first stamp or after the last one
    # The jump of a held input is spread over the interval that follows it; the last interval is as long as the one
    # before.
    jump = slope if between == "linear" else np.diff(u, axis=0) / np.append(np.diff(t)[1:], t[-1] - t[-2])[:, None]
    jump = np.concatenate([none, jump, none] if between == "linear" else [none, none, jump])
    rate, added = (np.take_along_axis(each, k + 1, axis=0) for each in (rise, ahead * jump))
    k = np.maximum(k, 0)
    value = np.take_along_axis(u, k, axis=0) + rate * (begin[:, None] - late - t[k]) + added
    if lag == 0:
        return PiecewiseInputs(begin, value, rate, np.zeros_like(value))
    value = value - rate * lag  # a lag makes a ramp follow later
    transient, now = np.empty_like(value), u[0]
    # The solution of lag·x' + x = value + rate·s is a ramp and a transient, which keeps x continuous when inputs jump.
    for j, step in enumerate(np.append(steps, 0.0)):
        transient[j] = now - value[j]
        now = value[j] + rate[j] * step + transient[j] * np.exp(-step / lag)
    return PiecewiseInputs(begin, value, rate, transient, 1 / lag)


@compiled
def simulate_piecewise(
    model: MechanicalSystem | StateSpace,
    x0: Any,
    inputs: PiecewiseInputs,
    *,
    rtol: Number = 1e-10,
    atol: Number = 1e-12,
) -> Record:
    """Integrate a model from x0 under inputs that jump, and record its state at the beginning of each interval.

    Args:
        model: A mechanical system, or a `StateSpace`.
        x0: Its state at the beginning of the first interval, as for `simulate`.
        inputs: The inputs, for example from `logged_inputs`.
        rtol: Relative tolerance of the integrator.
        atol: Absolute tolerance of the integrator.

    Returns:
        The record at the times `inputs.begin`, as from `simulate`; each u is the input just after that time.

    Example:
        >>> import numpy as np
        >>> from covariant import models
        >>> from covariant.simulation import logged_inputs, simulate_piecewise
        >>> t, u = np.array([0.0, 1.0, 2.0]), np.array([[1.0], [0.0], [0.0]])
        >>> record = simulate_piecewise(models.duffing(), np.zeros(2), logged_inputs(t, u))
        >>> record.x.shape
        (3, 2)
    """
    begin = jnp.asarray(inputs.begin)
    # The last interval has no end; it gets the length of the one before, as only its first state is recorded.
    ends = jnp.append(begin[1:], 2 * begin[-1] - begin[-2])

    def interval(x, piece):
        start, end, *parts = piece
        acting = eqx.Partial(_acting, start, *parts, inputs.decay)
        record = simulate(model, x, jnp.stack([start, end]), acting, rtol=rtol, atol=atol)
        first, last = (jax.tree.map(lambda leaf, i=i: leaf[i], record) for i in (0, 1))
        return last.x, first

    pieces = (begin, ends, *map(jnp.asarray, (inputs.value, inputs.rate, inputs.transient)))
    return jax.lax.scan(interval, x0, pieces)[1]


def _acting(begin, value, rate, transient, decay, t, x=None) -> Array:
    s = t - begin
    return value + rate * s + transient * jnp.exp(-decay * s)
