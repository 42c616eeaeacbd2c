"""A metric known at the points of a grid.

Source: Keys 1981, Cubic convolution interpolation for digital image processing, IEEE Trans. ASSP 29.
"""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._linalg import ldl
from covariant._typing import Flag, Matrix, Vector


class Interpolated(eqx.Module):
    """A metric interpolated between the points of a uniform grid: a function `x (n,) -> (n, n)`.

    What is interpolated are the factors of `P = L D Lᵀ`, with the logarithms of D, so that every value in between is
    positive definite; entries of P would not do. Cubic, of third order in the spacing, with continuous derivatives, so
    that Christoffel symbols and geodesics exist. Outside the grid, and beside grid points without a metric, it is NaN:
    it never extrapolates.
    """

    low: Vector
    spacing: Vector
    factors: Float[Array, "*grid k"]

    def __init__(self, axes: tuple[Float[np.ndarray, "_"], ...], values: Float[np.ndarray, "..."]):
        """From the axes (c_i,) of the grid and P at its points (c_1, …, c_n, n, n); NaN where there is none.

        Raises `ValueError` where axes and values do not fit, an axis is not uniform or has fewer than four points, or
        a value is not symmetric positive definite.
        """
        axes, values = tuple(np.asarray(axis) for axis in axes), np.asarray(values)
        n = len(axes)
        _check(axes, values)
        self.low = jnp.array([axis[0] for axis in axes], values.dtype)
        self.spacing = jnp.array([(axis[-1] - axis[0]) / (len(axis) - 1) for axis in axes], values.dtype)
        factors = np.asarray(jax.jit(jax.vmap(_to_factors))(jnp.asarray(values.reshape(-1, n, n))))
        self.factors = jnp.asarray(_with_border(factors.reshape(*values.shape[:n], -1), n))

    def __call__(self, x: Vector) -> Matrix:
        n = x.shape[0]
        place = (x - self.low.astype(x.dtype)) / self.spacing.astype(x.dtype)
        cells = jnp.array(self.factors.shape[:n]) - 3
        cell = jnp.clip(jnp.floor(jnp.nan_to_num(place)).astype(jnp.int32), 0, cells - 1)
        corner = jax.lax.dynamic_slice(self.factors, (*cell, 0), (*(4,) * n, self.factors.shape[-1]))
        for weights in _keys(place - cell.astype(x.dtype)):
            corner = jnp.tensordot(weights, corner.astype(x.dtype), axes=1)
        return jnp.where(self.contains(x), _from_factors(corner, n), jnp.nan)

    def contains(self, x: Vector) -> Flag:
        """Whether x is inside the grid."""
        high = self.low + self.spacing * (jnp.array(self.factors.shape[: x.shape[0]]) - 3).astype(self.low.dtype)
        return jnp.all((x >= self.low.astype(x.dtype)) & (x <= high.astype(x.dtype)))


def _keys(s: Vector) -> Float[Array, "n 4"]:
    """Weights of the four neighbours along each axis, at the fraction s of the cell between the middle two."""
    near, far = jnp.stack([s, 1 - s]), jnp.stack([1 + s, 2 - s])
    inner = (1.5 * near - 2.5) * near * near + 1.0
    outer = ((-0.5 * far + 2.5) * far - 4.0) * far + 2.0
    return jnp.stack([outer[0], inner[0], inner[1], outer[1]], axis=1)


def _with_border(factors: np.ndarray, n: int) -> np.ndarray:
    """One more layer around the grid, continued as a parabola, for the cells at its border."""
    for axis in range(n):
        a = np.moveaxis(factors, axis, 0)
        before, after = (3 * (e[0] - e[1]) + e[2] for e in (a, a[::-1]))
        factors = np.moveaxis(np.concatenate([before[None], a, after[None]]), 0, axis)
    return factors


def _to_factors(p: Matrix) -> Vector:
    """Strictly lower entries of L by columns, then log D."""
    columns, d = ldl(p)
    return jnp.concatenate([*(column[1:] for column in columns), jnp.log(d)])


def _from_factors(factors: Vector, n: int) -> Matrix:
    entries, d = factors[:-n], jnp.exp(factors[-n:])
    starts = itertools.accumulate(range(n - 1, 0, -1), initial=0)
    columns = [
        jnp.concatenate([jnp.zeros(k, entries.dtype), jnp.ones(1, entries.dtype), entries[start : start + n - 1 - k]])
        for k, start in enumerate(starts)
    ]
    lower = jnp.stack(columns, axis=1)
    return (lower * d) @ lower.T


def _check(axes: tuple[np.ndarray, ...], values: np.ndarray) -> None:
    n, counts = len(axes), tuple(len(axis) for axis in axes)
    if values.shape != (*counts, n, n):
        raise ValueError(f"values must have shape {(*counts, n, n)} on this grid of {n} axes; got {values.shape}")
    for k, axis in enumerate(axes):
        steps = np.diff(axis)
        if len(axis) < 4 or steps.min() <= 0 or np.ptp(steps) > 1e-6 * steps.mean():
            raise ValueError(f"axis {k + 1} must be at least four points with equal steps upward; it has {len(axis)}")
    known = np.isfinite(values).all(axis=(-2, -1))
    least: np.ndarray = np.linalg.eigvalsh(np.where(known[..., None, None], values, np.eye(n)))[..., 0]
    asymmetry = np.abs(values - np.swapaxes(values, -1, -2)).max(axis=(-2, -1))
    wrong = known & ((least <= 0) | (asymmetry > 1e-6 * np.abs(values).max(axis=(-2, -1))))
    if not known.any():
        raise ValueError("there is no metric at any point of the grid")
    if wrong.any():
        where = np.unravel_index(int(wrong.argmax()), counts)
        point = ", ".join(f"{axis[i]:.4g}" for axis, i in zip(axes, where, strict=True))
        raise ValueError(
            f"the metric at ({point}) is not symmetric positive definite: eigenvalue {float(least[where]):.3g}"
        )
