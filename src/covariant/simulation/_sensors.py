"""Simulates position sensors: sampling, jitter, noise, quantisation and dropouts, repeatable by a seed."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from scalargraph.errors import InputError

NumpyArray = np.ndarray
PerPosition = float | Sequence[float] | NumpyArray
"""One number for all positions, or one for each of them."""


class PositionSensor(NamedTuple):
    """Data of a position sensor: sampling rate, noise, quantisation, jitter and dropouts.

    It describes the instrument in a simulation: `stamps` gives its sampling instants, and `sense` its readings. Noise
    and quantum are in the unit of the position. Do not confuse it with the sensors of filters, such as
    `observers.encoder`, which describe to an estimator how to use a reading.

    Args:
        rate: Samples per second [Hz].
        noise_std: Standard deviation of the noise [unit of the position], one number or one for each position.
        quantum: Quantisation step [unit of the position], one number or one for each position; 0 for none.
        jitter: Standard deviation of a sampling instant [s], limited so that stamps keep their order.
        dropout: Probability that a sample is missing (NaN).

    Example:
        >>> import numpy as np
        >>> from covariant.simulation import PositionSensor, sense
        >>> sense(PositionSensor(100.0, quantum=[0.1, 0.5]), np.array([[0.33, 0.33]])).round(1).tolist()
        [[0.3, 0.5]]
    """

    rate: float
    noise_std: PerPosition = 0.0
    quantum: PerPosition = 0.0
    jitter: float = 0.0
    dropout: float = 0.0

    def check(self) -> "PositionSensor":
        """Check that every field is in its range.

        Returns:
            The sensor itself.

        Raises:
            ValueError: Names the first invalid field.
        """
        if not 0 < self.rate < np.inf:
            raise InputError(f"sensor: rate must be positive [Hz]; got {self.rate}")
        for name in ("noise_std", "quantum", "jitter"):
            values = np.asarray(getattr(self, name), float)
            if not ((values >= 0) & (values < np.inf)).all():
                raise InputError(f"sensor: {name} must be a number ≥ 0; got {getattr(self, name)}")
        if not 0 <= self.dropout < 1:
            raise InputError(f"sensor: dropout is a probability below 1; got {self.dropout}")
        return self


def stamps(sensor: PositionSensor, duration: float, seed: int = 0) -> Float[NumpyArray, "T"]:
    """Sampling instants of a sensor.

    Use the same sensor and seed as for `sense`, and simulate the model at these instants. With jitter, the stamps are
    the true instants and not those of an ideal clock.

    Args:
        sensor: The sensor; only its `rate` and `jitter` are used.
        duration: Length of the log [s].
        seed: Seed of the random jitter.

    Returns:
        Strictly increasing stamps (T,) [s] from 0 to about `duration`, the first at 0.

    Raises:
        ValueError: The sensor is invalid, or the duration does not hold two samples.

    Example:
        >>> from covariant.simulation import PositionSensor, stamps
        >>> stamps(PositionSensor(100.0), 0.05).round(2).tolist()
        [0.0, 0.01, 0.02, 0.03, 0.04, 0.05]
    """
    sensor.check()
    steps = duration * sensor.rate + 1e-9  # 0.29 s contain 29 steps at 100 Hz, although 0.29 * 100 rounds to less
    if not 1 <= steps < np.inf:
        raise InputError(f"sensor: {duration} s at {sensor.rate} Hz do not hold two samples or more")
    count = int(steps) + 1
    # Stamps (0) and values (1) have separate random streams, so neither depends on the draws of the other.
    offsets = np.random.default_rng([seed, 0]).normal(0, sensor.jitter, count) if sensor.jitter else np.zeros(count)
    offsets[0] = 0.0
    # Jitter is limited to less than half a sample on either side, so stamps stay strictly increasing.
    return np.arange(count) / sensor.rate + np.clip(offsets, -0.45 / sensor.rate, 0.45 / sensor.rate)


def sense(sensor: PositionSensor, q: Float[NumpyArray, "T n"], seed: int = 0) -> Float[NumpyArray, "T n"]:
    """Measurements of positions by a sensor, with noise, quantisation and dropouts.

    Use it to make the measurements of a simulated log, with a seed for repeatable noise. Noise is added before
    quantisation, as in a real encoder. Dropouts remove whole rows.

    Args:
        sensor: The sensor.
        q: True positions (T, n).
        seed: Seed of the noise and the dropouts.

    Returns:
        Measurements (T, n), NaN if a sample is missing. The first row is never dropped, since an observer starts from
        it.

    Raises:
        ValueError: The sensor is invalid, or the number of noise levels or quanta differs from that of positions.

    Example:
        >>> import numpy as np
        >>> from covariant.simulation import PositionSensor, sense
        >>> y = sense(PositionSensor(100.0, noise_std=0.1, dropout=0.5), np.zeros((1000, 1)))
        >>> bool(abs(np.nanstd(y) - 0.1) < 0.02), bool(400 < np.isnan(y).sum() < 600)
        (True, True)
    """
    sensor.check()
    random = np.random.default_rng([seed, 1])
    noise, quantum = (_each(name, getattr(sensor, name), np.shape(q)[1]) for name in ("noise_std", "quantum"))
    # All noise is drawn at once, so a position without noise does not change the noise of the others.
    y = np.asarray(q) + (noise * random.standard_normal(np.shape(q)) if noise.any() else 0.0)
    # Without quantisation the step is replaced by 1 to avoid a division by zero; the result is not used then.
    step = np.where(quantum > 0, quantum, 1.0)
    y = np.where(quantum > 0, np.round(y / step) * step, y)
    lost = random.random(len(y)) < sensor.dropout
    lost[0] = False
    return np.where(lost[:, None], np.nan, y)


def _each(name: str, values: PerPosition, count: int) -> Float[NumpyArray, "n"]:
    array = np.asarray(values, float)
    if array.ndim > 1 or (array.ndim == 1 and len(array) != count):
        raise InputError(f"sensor: {name} has {array.size} numbers for {count} positions; give one, or one for each")
    return np.broadcast_to(array, count)
