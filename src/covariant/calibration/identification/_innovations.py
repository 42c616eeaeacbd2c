"""Innovations of prediction errors: the part that a filter which follows the errors does not predict.

An unmodelled acceleration is integrated twice: within a window errors grow, and neighbours are alike, so that the last
ones of each window would decide, by the chance of a few. The innovations of a filter of the right bandwidth
are nearly white, and the parameters with the least of them nearly the likeliest.

Source: Ljung 1999, System Identification, sections 3.2 and 7.4, for filtered prediction errors and the likelihood.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from covariant._typing import Scalar
from covariant.calibration._least_squares import STD_OF_MEDIAN
from covariant.calibration.identification._windows import Windows
from covariant.observers import PLL
from covariant.signals import AnyArray

FINEST = 1e-6
"""Least scale of the errors, as a fraction of the motion of the positions in a window: below it is rounding."""
FREQUENCIES = 12
"""Bandwidths that are compared, from one in a window to one in a sample."""
NONE = 0.01
"""Bandwidth that stands for no filter, times the length of a window: it follows only that fraction of an error."""

NumpyArray = np.ndarray


class Weighing(NamedTuple):
    """Weights of the errors: innovations of a filter, in units of their scale.

    Attributes:
        frequency: Natural frequency [rad/s] of the filter, an undisturbed double integrator with damping √½.
        scale: Robust standard deviation (M, n) of its innovations for each machine [units of the frame].
    """

    frequency: Float[AnyArray, ""]
    scale: Float[AnyArray, "M n"]


def innovations(
    errors: Float[Array, "L1 n"], seen: Bool[Array, "L1 n"], t: Float[Array, "L1"], frequency: Scalar
) -> Float[Array, "L1 n"]:
    """Innovations along one window of a filter that follows the prediction errors and expects none at first."""
    follower, steps = PLL(frequency), jnp.diff(t)

    def step(state, sample):
        state, info = follower.advance(state, jnp.zeros(0), *sample)
        return state, info.innovation

    # The first row has no step before it and gets that of the second.
    rows = jnp.where(seen, errors, jnp.nan), jnp.concatenate([steps[:1], steps])
    return jax.lax.scan(step, follower.init(jnp.zeros_like(errors[0])), rows)[1]


def frequencies(windows: Windows) -> Float[NumpyArray, "f"]:
    """Filter bandwidths to choose from."""
    t = np.asarray(windows.t)
    steps, length = np.diff(t, axis=1), float(np.max(t[:, -1] - t[:, 0]))
    bandwidths = np.geomspace(1 / length, 1 / np.median(steps[steps > 0]), FREQUENCIES)
    return np.concatenate([[NONE / length], bandwidths])


def weighing(
    windows: Windows,
    errors: Float[NumpyArray, "W L1 n"],
    seen: Bool[NumpyArray, "W L1 n"],
    among: Float[NumpyArray, "f"],
    machines: int,
) -> Weighing:
    """Choose the filter frequency with the least innovations over all coordinates."""
    # One frequency after the other, so that one program serves any number of them.
    data = windows, jnp.asarray(errors), jnp.asarray(seen)
    scales = np.stack([np.asarray(_scale(*data, jnp.asarray(frequency), machines)) for frequency in among])
    best = int(np.argmin(np.sum(np.log(scales), axis=(1, 2))))  # the first where none is finite
    return Weighing(np.asarray(among[best]), scales[best])


@eqx.filter_jit
def _scale(windows: Windows, errors: Array, seen: Array, frequency: Scalar, machines: int) -> Float[Array, "M n"]:
    t, v = jnp.asarray(windows.t), jnp.asarray(windows.v)
    motion = jnp.sqrt(jnp.mean((v * (t - t[:, :1])[..., None]) ** 2, axis=(0, 1)))

    new = jax.vmap(innovations, (0, 0, 0, None))(errors, seen, t, frequency)
    sizes = jnp.where(seen, jnp.abs(new), jnp.nan)
    whose = jnp.asarray(windows.machine)[:, None, None]
    # The median of the sizes is that of noise even where some errors are outliers.
    medians = [jnp.nanmedian(jnp.where(whose == m, sizes, jnp.nan), axis=(0, 1)) for m in range(machines)]
    # A machine without a window weighs none.
    scale = STD_OF_MEDIAN * jnp.stack([jnp.where((whose == m).any(), each, 1.0) for m, each in enumerate(medians)])
    # The floor keeps the logarithms above finite where a model predicts a noise-free log exactly.
    return jnp.maximum(scale, (FINEST * motion + 1e-300)[None])
