"""Simulated position sensors: sampling, jitter, noise, quantisation, dropouts; repeatable by a seed."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

NumpyArray = np.ndarray


class Sensor(NamedTuple):
    """A position sensor.

    - `rate`: samples per second [Hz].
    - `noise_std`, `quantum`: standard deviation of the noise, and quantisation step, in units of the position.
    - `jitter`: standard deviation of a sampling instant [s], limited so that stamps keep their order.
    - `dropout`: probability that a sample is missing (NaN).
    """

    rate: float
    noise_std: float = 0.0
    quantum: float = 0.0
    jitter: float = 0.0
    dropout: float = 0.0

    def check(self) -> "Sensor":
        """Return the sensor, or raise `ValueError` naming the first invalid field."""
        if not 0 < self.rate < np.inf:
            raise ValueError(f"sensor: rate must be positive [Hz]; got {self.rate}")
        for name in ("noise_std", "quantum", "jitter"):
            if not 0 <= getattr(self, name) < np.inf:
                raise ValueError(f"sensor: {name} must be a number ≥ 0; got {getattr(self, name)}")
        if not 0 <= self.dropout < 1:
            raise ValueError(f"sensor: dropout is a probability below 1; got {self.dropout}")
        return self


def stamps(sensor: Sensor, duration: float, seed: int = 0) -> Float[NumpyArray, "T"]:
    """Sampling instants from 0 to `duration` [s], strictly increasing, the first at 0."""
    sensor.check()
    steps = duration * sensor.rate + 1e-9  # 0.29 s hold 29 steps at 100 Hz, although 0.29 * 100 rounds to less
    if not 1 <= steps < np.inf:
        raise ValueError(f"sensor: {duration} s at {sensor.rate} Hz do not hold two samples or more")
    count = int(steps) + 1
    late = np.random.default_rng([seed, 0]).normal(0, sensor.jitter, count) if sensor.jitter else np.zeros(count)
    late[0] = 0.0
    return np.arange(count) / sensor.rate + np.clip(late, -0.45 / sensor.rate, 0.45 / sensor.rate)


def sense(sensor: Sensor, q: Float[NumpyArray, "T n"], seed: int = 0) -> Float[NumpyArray, "T n"]:
    """Measurements of the positions q (T, n); the first row is never dropped, since an observer starts from it."""
    sensor.check()
    random = np.random.default_rng([seed, 1])
    y = np.asarray(q) + (random.normal(0, sensor.noise_std, np.shape(q)) if sensor.noise_std else 0.0)
    if sensor.quantum:
        y = np.round(y / sensor.quantum) * sensor.quantum
    lost = random.random(len(y)) < sensor.dropout
    lost[0] = False
    return np.where(lost[:, None], np.nan, y)
