"""What is new in the errors of predictions: what a filter that follows them did not expect.

Whatever a model leaves unexplained is integrated twice: within a window errors grow, and neighbours are alike, so that
the last ones of each window would decide, by the chance of a few. The innovations of a filter of the right bandwidth
are nearly white, and the numbers with the least of them nearly the likeliest.

Source: Ljung 1999, System Identification, sections 3.2 and 7.4, for filtered prediction errors and the likelihood.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from covariant._typing import Scalar
from covariant.calibration._windows import Windows
from covariant.observers import PLL
from covariant.signals import AnyArray

FINEST = 1e-6
"""Least scale of the errors, as a fraction of how far the positions move in a window: below it is rounding."""
FREQUENCIES = 12
"""Bandwidths that are compared, from one in a window to one in a sample."""
NONE = 0.01
"""A bandwidth that is none: the filter moves by so small a part of an error within a window."""

NumpyArray = np.ndarray


class Weighing(NamedTuple):
    """How errors are weighed: by the innovations of a filter, in units of their scale.

    - `frequency` [rad/s]: of the filter, an undisturbed double integrator with damping √½.
    - `scale` (n,): robust standard deviation of its innovations [units of the frame].
    """

    frequency: Float[AnyArray, ""]
    scale: Float[AnyArray, "n"]


def innovations(
    errors: Float[Array, "L1 n"], seen: Bool[Array, "L1 n"], t: Float[Array, "L1"], frequency: Scalar
) -> Float[Array, "L1 n"]:
    """Along a window with stamps t [s]; 0 where nothing is seen. The filter expects no error at first."""
    follower, steps = PLL(frequency), jnp.diff(t)

    def step(state, now):
        state, info = follower.advance(state, jnp.zeros(0), *now)
        return state, info.innovation

    rows = jnp.where(seen, errors, jnp.nan), jnp.concatenate([steps[:1], steps])
    return jax.lax.scan(step, follower.init(jnp.zeros_like(errors[0])), rows)[1]


def frequencies(windows: Windows) -> Float[NumpyArray, "f"]:
    """Bandwidths [rad/s] to choose from; the first is none, so that errors are their own innovations."""
    t = np.asarray(windows.t)
    steps, length = np.diff(t, axis=1), float(np.max(t[:, -1] - t[:, 0]))
    rest = np.geomspace(1 / length, 1 / np.median(steps[steps > 0]), FREQUENCIES)
    return np.concatenate([[NONE / length], rest])


def weighing(
    windows: Windows,
    errors: Float[NumpyArray, "W L1 n"],
    seen: Bool[NumpyArray, "W L1 n"],
    among: Float[NumpyArray, "f"],
) -> Weighing:
    """The frequency of the least innovations `among` some, over all coordinates, and their scale."""
    scales = np.asarray(_scales(windows, jnp.asarray(errors), jnp.asarray(seen), jnp.asarray(among)))
    best = int(np.argmin(np.sum(np.log(scales), axis=1)))  # the first where none is finite
    return Weighing(np.asarray(among[best]), scales[best])


@eqx.filter_jit
def _scales(windows: Windows, errors: Array, seen: Array, among: Float[Array, "f"]) -> Float[Array, "f n"]:
    t, v = jnp.asarray(windows.t), jnp.asarray(windows.v)
    moved = jnp.sqrt(jnp.mean((v * (t - t[:, :1])[..., None]) ** 2, axis=(0, 1)))

    def scale(frequency):
        new = jax.vmap(innovations, (0, 0, 0, None))(errors, seen, t, frequency)
        # The median of the sizes is that of noise even where some errors are outliers.
        return 1.4826 * jnp.nanmedian(jnp.where(seen, jnp.abs(new), jnp.nan), axis=(0, 1))

    return jnp.maximum(jax.lax.map(scale, among), (FINEST * moved + 1e-300)[None])
