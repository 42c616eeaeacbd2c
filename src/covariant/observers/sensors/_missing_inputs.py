"""Models inputs that are missing for a while as a stationary process of second order between known values.

Each input is its mean and a process z that white noise drives,

    z'' + 2a z' + (a² + b²) z = w,   with the covariance   σ² e^{−as} (cos bs + (a/b) sin bs)   after the time s,

which covers oscillating torques (b² > 0), smooth ones (b = 0) and rough ones (b² < 0; cos and sin become cosh and
sinh). While an input is known, z is the known value. From then on z returns to the mean as the covariance does, and its
variance grows to σ². Over a gap such an input acts like an unknown force that persists for a while: the error of the
velocity grows at least as t, and not as √t.

Source: Gelb 1974, Applied Optimal Estimation, section 2.2, for Gauss–Markov processes of second order.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from covariant._functional import Functional
from covariant._linalg import triangular
from covariant._typing import Number, Scalar, Vector
from covariant.observers.base import check_finite, check_not_negative, check_positive
from covariant.observers.sensors._slow import SlowVector

LEAST_SPLIT = 1e-3
"""Least distance of the two poles, relative to their mean: at a double pole sin bs/b is 0/0."""


class MissingInputs(Functional):
    """Model of inputs while they are missing, for the field `inputs` of an `IntrinsicKalman`.

    An input is missing if it is NaN, and over a step longer than `hold`, in which rows are missing. The filter then
    includes the uncertainty of the input, while without this it would trust the last one. Use `missing_inputs` of
    `covariant.calibration` to get the numbers from a log.

    Attributes:
        mean: Means (m,) of the inputs [their units].
        std: Standard deviations (m,) of the inputs.
        decay: Rates a (m,) [1/s] at which they return to the mean.
        square: Squared angular frequencies b² (m,) [1/s²] of oscillation; negative, above −a², for rough inputs.
        hold: Longest step [s] over which a known input counts as held.

    Raises:
        ValueError: A number is not finite, a decay or `hold` is not positive, or the process is not stationary.

    Example:
        >>> import numpy as np
        >>> from covariant import Record, models, observers
        >>> one = np.ones(1)
        >>> inputs = observers.MissingInputs(mean=0 * one, std=one, decay=one, square=4 * one, hold=0.02)
        >>> kalman = observers.IntrinsicKalman(models.oscillator(), 1e-3, 1e-6, 1.0, inputs=inputs)
        >>> t = np.arange(0.0, 1.0, 0.01)
        >>> record = Record(t, np.where((t > 0.5) & (t < 0.7), np.nan, 0.0)[:, None], 0 * t[:, None])
        >>> record.y[51:70] = np.nan
        >>> std = observers.run(kalman, record).info.velocity_std[:, 0]
        >>> bool(std[69] > 4 * std[50]), bool(std[75] < 2 * std[50])
        (True, True)
    """

    mean: Vector = eqx.field(converter=jnp.asarray)
    std: Vector = eqx.field(converter=jnp.asarray)
    decay: Vector = eqx.field(converter=jnp.asarray)
    square: Vector = eqx.field(converter=jnp.asarray)
    hold: Scalar = eqx.field(converter=jnp.asarray)

    def __check_init__(self):
        check_finite("MissingInputs", mean=self.mean, square=self.square)
        check_not_negative("MissingInputs", std=self.std)
        check_positive("MissingInputs", decay=self.decay, hold=self.hold)
        check_positive("MissingInputs", **{"decay² + square": self.decay**2 + self.square})

    def transition(self, h: Number) -> Float[Array, "m 2 2"]:
        """Transition matrix of (z, z') of each input over a time h [s]."""
        a, square = self.decay, self.square
        least = (LEAST_SPLIT * a) ** 2
        b = jnp.sqrt(jnp.maximum(jnp.abs(square), least))
        swings, pace = square > 0, a**2 + jnp.where(square > 0, b**2, -(b**2))
        # cosh and sinh include their decay, as they would overflow alone.
        up, down = jnp.exp(-(a - b) * h) / 2, jnp.exp(-(a + b) * h) / 2
        decayed = jnp.exp(-a * h)
        even = jnp.where(swings, decayed * jnp.cos(b * h), up + down)
        odd = jnp.where(swings, decayed * jnp.sin(b * h), up - down) / b
        rows = jnp.stack([even + a * odd, odd]), jnp.stack([-pace * odd, even - a * odd])
        return jnp.moveaxis(jnp.stack(rows), -1, 0)

    @property
    def rate_std(self) -> Vector:
        """Standard deviations (m,) of z'."""
        return self.std * jnp.sqrt(self.decay**2 + self.square)

    def added_root(self, h: Number) -> Float[Array, "m 2 2"]:
        """Lower triangular root of the covariance that is added to (z, z') of each input in a time h [s]."""
        left = self.transition(h)
        first, second = self.std**2, self.rate_std**2
        z = first - left[:, 0, 0] ** 2 * first - left[:, 0, 1] ** 2 * second
        cross = -(left[:, 0, 0] * left[:, 1, 0] * first + left[:, 0, 1] * left[:, 1, 1] * second)
        rate = second - left[:, 1, 0] ** 2 * first - left[:, 1, 1] ** 2 * second
        # For short times, the first variance, which grows as h³, is lost in rounding.
        some = z > 1e-14 * first
        low = jnp.sqrt(jnp.where(some, z, 1.0))
        below = jnp.where(some, cross / low, 0.0)
        last = jnp.sqrt(jnp.maximum(rate - below**2, 0.0))
        low, zero = jnp.where(some, low, 0.0), jnp.zeros_like(low)
        return jnp.moveaxis(jnp.stack([jnp.stack([low, zero]), jnp.stack([below, last])]), -1, 0)


class InputStates(NamedTuple):
    """The states (z, z') of missing inputs over a step, a group among the slow states of a filter.

    Attributes:
        inputs: The process.
        missing: Which inputs (m,) are missing.
        u: The inputs (m,), as far as they are known.
    """

    inputs: MissingInputs
    missing: Bool[Array, "m"]
    u: Vector
    force = None
    model = None
    offset = None
    values = None
    law = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the states: of the inputs, and of their rates."""
        return tuple(f"missing_input{kind}{i + 1}" for kind in ("", "_rate") for i in range(len(self.u)))

    @property
    def first(self) -> SlowVector:
        """Values at the start: the mean inputs."""
        return jnp.zeros(2 * len(self.u))

    def first_root(self) -> Float[Array, "k k"]:
        """Square root of the covariance at the start."""
        return jnp.diag(jnp.concatenate([self.inputs.std, self.inputs.rate_std]))

    def advanced(self, v: Vector, s: SlowVector, h: Scalar) -> tuple[SlowVector, SlowVector]:
        """The expected states: the mean over a step, and the values at its end.

        A known input is known at the start of the step, so at the end it is as old as the step is long.
        """
        left = self.inputs.transition(h).astype(s.dtype)
        known = jnp.stack([self.u - self.inputs.mean, jnp.zeros_like(self.u)]).astype(s.dtype)
        pairs = jnp.where(self.missing, jnp.stack(jnp.split(s, 2)), known)
        end = jnp.einsum("mij,jm->im", left, pairs).ravel()
        return (s + end) / 2, end

    def spread(self, v: Vector, h: Scalar) -> Float[Array, "k k"]:
        """Square root of the covariance that a step adds; the rate of a known input is not known."""
        m, left = len(self.u), self.inputs.transition(h)
        rate = jnp.where(self.missing, 0.0, self.inputs.rate_std)
        added = jnp.concatenate([self.inputs.added_root(h), left[:, :, 1:] * rate[:, None, None]], axis=2)
        each = jax.vmap(triangular)(added)
        return jnp.einsum("mij,mk->imjk", each, jnp.eye(m, dtype=each.dtype)).reshape(2 * m, 2 * m)

    def acting(self, u: Vector, s: SlowVector) -> Vector:
        """The inputs (m,) that act, given the states."""
        return jnp.where(self.missing, self.inputs.mean.astype(u.dtype) + s[: len(self.u)], u)


def missing_now(inputs: MissingInputs, absent: Bool[Array, "m"], dt: Scalar) -> Bool[Array, "m"]:
    """Which inputs are missing over a step: the absent ones, or all if rows are missing."""
    return absent | (dt > inputs.hold.astype(dt.dtype))
