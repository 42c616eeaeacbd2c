"""Interpolates a metric between its values at the points of a grid.

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
from scalargraph.errors import InputError


class Interpolated(eqx.Module):
    """A metric interpolated between the points of a uniform grid: a function `x (n,) -> (n, n)`.

    The interpolated quantities are the factors of `P = L D Lᵀ`, with logarithms of D. So every interpolated value is
    positive definite, which interpolating the entries of P would not ensure. Interpolation is cubic, of third order in
    the spacing, with continuous derivatives, so that Christoffel symbols and geodesics exist. There is no
    extrapolation: the value is NaN outside the grid, and within two spacings of a grid point without a metric.

    Attributes:
        low: lower ends (n,) of the axes, in the units of the coordinates.
        high: upper ends (n,) of the axes.
        spacing: distance (n,) of neighbouring points along each axis.
        factors: the interpolated quantities (c_1 + 2, …, c_n + 2, n(n + 1)/2), with a border of one point around the
            grid.

    Example:
        A metric exp(x) of one coordinate, known at five points:

        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> from covariant.geometry import Interpolated
        >>> axis = np.linspace(0.0, 1.0, 5)
        >>> metric = Interpolated((axis,), np.exp(axis)[:, None, None])
        >>> x = jnp.array([0.3])
        >>> bool(jnp.isclose(metric(x)[0, 0], jnp.exp(0.3))), bool(metric.contains(x + 1.0))
        (True, False)
    """

    low: Vector
    high: Vector
    spacing: Vector
    factors: Float[Array, "*grid k"]

    def __init__(self, axes: tuple[Float[np.ndarray, "_"], ...], values: Float[np.ndarray, "..."]):
        """Interpolate values on a grid.

        Args:
            axes: coordinates (c_i,) of the points along each of the n axes, equally spaced, four at least.
            values: P at the points, (c_1, …, c_n, n, n); an unknown value has entries that are not finite.

        Raises:
            ValueError: axes and values do not fit, an axis is not uniform or has fewer than four points, or a value is
                not symmetric positive definite.
        """
        axes, values = tuple(np.asarray(axis) for axis in axes), np.asarray(values)
        n = len(axes)
        _check_axes(axes, values)
        _check_symmetry(axes, values)
        # Unknown values are replaced by a valid matrix, so that a failing factorisation means a wrong value.
        known = _metric_mask(values)[..., None, None]
        filled = np.where(known, values, np.eye(n, dtype=values.dtype))
        # L and log D may have any entries, so every interpolation of them gives a positive definite matrix.
        factors = np.asarray(_to_factors(jnp.asarray(filled.reshape(-1, n, n))))
        factors = factors.reshape(*values.shape[:n], -1)
        _check_definite(axes, values, factors)
        self.low, self.high = (jnp.array([axis[end] for axis in axes], values.dtype) for end in (0, -1))
        self.spacing = jnp.array([(axis[-1] - axis[0]) / (len(axis) - 1) for axis in axes], values.dtype)
        self.factors = jnp.asarray(_with_border(np.where(known[..., 0], factors, np.nan), n))

    def __call__(self, x: Vector) -> Matrix:
        """The metric's matrix (n, n) at x (n,); NaN outside the grid and close to unknown points."""
        n = self.low.shape[0]
        if x.shape != (n,):
            raise InputError(f"the metric is a function of {n} coordinates; x has shape {x.shape}")
        position = (x - self.low.astype(x.dtype)) / self.spacing.astype(x.dtype)
        # A cell needs four neighbours; because of the border, the first of them has the same index as the cell.
        last = jnp.array(self.factors.shape[:n], jnp.int32) - 4
        # For NaN, and for coordinates outside, some cell of the grid is used; the last line makes the value NaN.
        cell = jnp.clip(jnp.floor(jnp.nan_to_num(position)).astype(jnp.int32), jnp.zeros_like(last), last)
        start = (*cell, jnp.zeros((), cell.dtype))
        corner = jax.lax.dynamic_slice(self.factors, start, (*(4,) * n, self.factors.shape[-1])).astype(x.dtype)
        for weights in _keys(position - cell.astype(x.dtype)):
            corner = jnp.sum(weights.reshape(4, *(1,) * (corner.ndim - 1)) * corner, axis=0)
        return jnp.where(self.contains(x), _from_factors(corner, n), jnp.nan)

    def contains(self, x: Vector) -> Flag:
        """Whether x (n,) is inside the grid or on its border."""
        return jnp.all((x >= self.low.astype(x.dtype)) & (x <= self.high.astype(x.dtype)))


def _keys(s: Vector) -> Float[Array, "n 4"]:
    """Weights of four neighbours along each axis, at the fraction s of the cell between the two middle ones."""
    inner_distance, outer_distance = jnp.stack([s, 1 - s]), jnp.stack([1 + s, 2 - s])
    # Keys' kernel with a = −1/2, for which interpolation is of third order.
    inner = (1.5 * inner_distance - 2.5) * inner_distance * inner_distance + 1.0
    outer = ((-0.5 * outer_distance + 2.5) * outer_distance - 4.0) * outer_distance + 2.0
    return jnp.stack([outer[0], inner[0], inner[1], outer[1]], axis=1)


def _with_border(factors: np.ndarray, n: int) -> np.ndarray:
    """The grid with one more layer of points around it, extrapolated by parabolas, for the cells at its border."""
    for axis in range(n):
        a = np.moveaxis(factors, axis, 0)
        # A vanishing third difference is the parabola through the last three points, Keys' condition at a border.
        before, after = (3 * (e[0] - e[1]) + e[2] for e in (a, a[::-1]))
        factors = np.moveaxis(np.concatenate([before[None], a, after[None]]), 0, axis)
    return factors


@jax.jit
@jax.vmap
def _to_factors(p: Matrix) -> Float[Array, "k"]:
    """Strictly lower entries of L by columns, then log D."""
    steps = ldl(p)
    return jnp.concatenate([*(step.below[:, 0] for step in steps), *(jnp.log(step.d[0]) for step in steps)])


def _from_factors(factors: Float[Array, "k"], n: int) -> Matrix:
    """`L D Lᵀ`, computed as `(L√D)(L√D)ᵀ`, so that it is exactly symmetric."""
    # exp(½ log D) is √D.
    entries, root = factors[:-n], jnp.exp(factors[-n:] / 2)
    starts = itertools.accumulate(range(n - 1, 0, -1), initial=0)
    columns = [
        jnp.concatenate([jnp.zeros(k, entries.dtype), jnp.ones(1, entries.dtype), entries[start : start + n - 1 - k]])
        for k, start in enumerate(starts)
    ]
    half = jnp.stack(columns, axis=1) * root[None, :]
    return jnp.sum(half[:, None, :] * half[None, :, :], axis=-1)


def _metric_mask(values: np.ndarray) -> np.ndarray:
    """Mask of the grid points at which the metric is known."""
    return np.asarray(np.isfinite(values).all(axis=(-2, -1)))


def _check_axes(axes: tuple[np.ndarray, ...], values: np.ndarray) -> None:
    n, counts = len(axes), tuple(axis.size for axis in axes)
    if values.shape != (*counts, n, n):
        raise InputError(f"values must have shape {(*counts, n, n)} on this grid of {n} axes; got {values.shape}")
    for k, axis in enumerate(axes):
        if axis.ndim != 1 or axis.size < 4:
            raise InputError(f"axis {k + 1} needs at least four points to interpolate between; it has {axis.size}")
        steps = np.diff(axis)
        # If a grid is far from 0, its steps differ by the rounding of its coordinates.
        rounding = 4 * np.finfo(axis.dtype).eps * np.abs(axis).max()
        if not (np.isfinite(axis).all() and steps.min() > 0 and np.ptp(steps) <= 1e-6 * steps.mean() + rounding):
            raise InputError(
                f"axis {k + 1} must have equal steps upward; they are {steps.min():.6g} to {steps.max():.6g}"
            )


def _check_symmetry(axes: tuple[np.ndarray, ...], values: np.ndarray) -> None:
    known = _metric_mask(values)
    if not known.any():
        raise InputError("there is no metric at any point of the grid")
    filled = np.where(known[..., None, None], values, 0)
    # The test is relative to the diagonal, so it does not depend on the units of the coordinates.
    size = np.sqrt(np.abs(np.diagonal(filled, axis1=-2, axis2=-1)))
    scale = size[..., :, None] * size[..., None, :]
    # 1e-6 is about eight roundings of single precision, in which a metric may have been stored.
    wrong = np.asarray((np.abs(filled - np.swapaxes(filled, -1, -2)) > 1e-6 * scale).any(axis=(-2, -1)))
    if wrong.any():
        where, point = _first(axes, wrong)
        raise InputError(f"the metric at {point} is not symmetric: {_in_one_line(values[where])}")


def _check_definite(axes: tuple[np.ndarray, ...], values: np.ndarray, factors: np.ndarray) -> None:
    wrong = ~np.asarray(np.isfinite(factors).all(axis=-1))
    if wrong.any():
        where, point = _first(axes, wrong)
        raise InputError(f"the metric at {point} is not positive definite: {_in_one_line(values[where])}")


def _first(axes: tuple[np.ndarray, ...], wrong: np.ndarray) -> tuple[tuple[int, ...], str]:
    """Index of the first wrong point, and its coordinates as text."""
    where = tuple(int(i) for i in np.unravel_index(int(wrong.argmax()), wrong.shape))
    return where, f"({', '.join(f'{axis[i]:.4g}' for axis, i in zip(axes, where, strict=True))})"


def _in_one_line(p: np.ndarray) -> str:
    return "; ".join(" ".join(f"{entry:.4g}" for entry in row) for row in p)
