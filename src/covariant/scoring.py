"""Scoring of velocity estimates, against the truth or against a reference computed from the recorded positions."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

NumpyArray = np.ndarray

CHUNK = 1000
"""Number of windows fitted at once: enough for NumPy to be quick, in a few megabytes."""

SAME = 10
"""Decimal digits, in units of half a window, to which the stamps of two windows must agree to be taken as equal."""

MOST_CONDITION = 1e6
"""Largest condition of the normal equations of a window; a worse one is fitted by its singular values."""

FARTHEST_TURN = 1.5
"""A rotation vector is close to a polynomial in time up to this angle [rad]; a fast body gets a shorter window."""


def zero_phase_velocity(
    t: Float[NumpyArray, "T"],
    y: Float[NumpyArray, "T n"],
    at: Float[NumpyArray, "K"],
    half: float = 0.03,
    order: int = 3,
) -> Float[NumpyArray, "K n"]:
    """Slopes (K, n) at the stamps `at` [s] of local polynomials fitted to the positions, with tricube weights.

    - `t` (T,) [s], `y` (T, n): stamps and positions. Missing positions (NaN) are left out, column by column.
    - `half` [s], `order`: half width of each window, and degree of the polynomials.

    The windows include later samples, so this is for scoring only.
    """
    return _coefficients(t, y, at, half, order, slice(1, 2))[:, 0]


def local_polynomials(
    t: Float[NumpyArray, "T"],
    y: Float[NumpyArray, "T n"],
    at: Float[NumpyArray, "K"],
    half: float = 0.03,
    order: int = 3,
) -> Float[NumpyArray, "K c n"]:
    """The coefficients (K, order + 1, n) of the polynomials of `zero_phase_velocity`, in the time from each stamp `at`.

    Coefficient c is the c-th derivative divided by c!.
    """
    return _coefficients(t, y, at, half, order, slice(int(order) + 1))


def _coefficients(t, y, at, half, order, wanted: slice):
    """The `wanted` coefficients (K, c, n) of the local polynomials."""
    y = np.asarray(y, float)
    measured = np.isfinite(y)
    found = np.empty((len(at), len(range(int(order) + 1)[wanted]), y.shape[1]))
    together: dict[bytes, list[int]] = {}  # columns that are measured in the same rows share their windows
    for column, rows in enumerate(measured.T):
        together.setdefault(rows.tobytes(), []).append(column)
    shared = _shared(t, measured, at, half, order) if len(together) > 1 else np.zeros(len(at), bool)
    every = list(range(y.shape[1]))
    asked = [(columns, measured[:, columns[0]], ~shared) for columns in together.values()]
    for columns, rows, stamps in [(every, measured.all(axis=1), shared), *asked]:
        if not stamps.any():
            continue
        seen, part = y[rows].T[columns], np.empty((int(stamps.sum()), *found.shape[1:2], len(columns)))
        for fit in _fits(t[rows], at[stamps], half, order):
            weights = fit.weights[fit.same, wanted]
            for k, positions in enumerate(seen):
                part[fit.at, :, k] = np.einsum("kcw,kw->kc", weights, positions.take(fit.rows))
        found[np.ix_(stamps, range(found.shape[1]), columns)] = part
    return found


def _shared(t, measured, at, half, order):
    """The stamps (K,) whose windows are long enough and lack no measurement, and so are the same for all columns."""
    reach = half * (1 + 1e-9)
    whole = measured.all(axis=1)
    inside, broken = (
        np.searchsorted(each, at + reach, side="right") - np.searchsorted(each, at - reach)
        for each in (t[whole], t[~whole])
    )
    return (broken == 0) & (inside >= int(order) + 3)


def zero_phase_twist(
    t: Float[NumpyArray, "T"],
    g: Float[NumpyArray, "T N N"],
    at: Float[NumpyArray, "K"],
    half: float = 0.03,
    order: int = 3,
    space: int = 3,
) -> Float[NumpyArray, "K n"]:
    """Body velocities (K, n) at the stamps `at` [s] of recorded rotations (d, d) or poses (d + 1, d + 1), d = `space`.

    As in `zero_phase_velocity`, local polynomials are fitted over ±`half` [s]: to the rotation vectors [rad] of the
    motion relative to the body, and to the positions. The result is the angular velocity in the body frame; where there
    is a position, the linear velocity, also in the body frame, comes before it. Missing matrices (any NaN) are left
    out. A body must turn by less than half a turn in `order` + 3 samples.
    """
    present = np.isfinite(g).all(axis=(1, 2))
    t, g = t[present], np.asarray(g, float)[present]
    attitude, turning = _turning(t, g[:, :space, :space], at, half, order)
    if g.shape[1] == space:
        return turning
    slopes = zero_phase_velocity(t, g[:, :space, space], at, half, order)
    return np.concatenate([np.einsum("kij,ki->kj", attitude, slopes), turning], axis=1)


def _turning(t, rotation, at, half, order):
    """Attitudes (K, d, d) and angular velocities in the body frame (K, 3), or (K, 1) in the plane."""
    if rotation.shape[1] == 2:
        angle = np.unwrap(np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]))
        smooth, rate = np.empty(len(at)), np.empty(len(at))
        for fit in _fits(t, at, half, order):
            smooth[fit.at], rate[fit.at] = np.einsum("kcw,kw->ck", fit.weights[fit.same, :2], angle[fit.rows])
        c, s = np.cos(smooth), np.sin(smooth)
        return np.moveaxis(np.array(((c, -s), (s, c))), 2, 0), rate[:, None]
    speed = np.linalg.norm(_log(_between(rotation[:-1], rotation[1:])), axis=1) / np.diff(t)
    half = min(half, FARTHEST_TURN / max(float(np.quantile(speed, 0.95)), 1e-9))
    attitude, turning = np.empty((len(at), 3, 3)), np.empty((len(at), 3))
    for fit in _fits(t, at, half, order):
        near, measured = rotation[fit.nearest], rotation[fit.rows]
        attitude[fit.at] = near @ _exp(_polynomial(fit, near, measured)[0])
        turning[fit.at] = _polynomial(fit, attitude[fit.at], measured)[1]  # at zero offset the slope is the velocity
    return attitude, turning


def _polynomial(fit, base, measured):
    """Offset and slope (2, k, 3) of the rotation vectors from `base` to the measured rotations."""
    return np.einsum("kcw,kwi->cki", fit.weights[fit.same, :2], _log(_between(base[:, None], measured)))


class _Fit(NamedTuple):
    """Local polynomials at a slice `at` of the stamps.

    - `rows` (k, w): indices of the measurements in each window.
    - `nearest` (k,): index of the measurement nearest to each stamp.
    - `weights` (j, order + 1, w): weights with which the measurements sum up to the coefficients, for the j windows
      that differ; `same` (k,): which of these each window is equal to.
    """

    at: slice
    rows: Int[NumpyArray, "k w"]
    nearest: Int[NumpyArray, "k"]
    weights: Float[NumpyArray, "j c w"]
    same: Int[NumpyArray, "k"]


def _fits(t, at, half, order) -> Iterator[_Fit]:
    order = int(order)
    if len(t) < order + 3:
        raise ValueError(f"a reference of order {order} needs {order + 3} measurements; there are {len(t)}")
    reach = half * (1 + 1e-9)  # so that no rounding decides on the samples at the ends of a window
    first, last = np.searchsorted(t, at - reach), np.searchsorted(t, at + reach, side="right")
    few = last - first < order + 3
    first = np.where(few, np.maximum(0, first - order - 3), first)
    last = np.where(few, np.minimum(len(t), last + order + 3), last)
    before = np.clip(np.searchsorted(t, at), 1, len(t) - 1)
    nearest = np.where(at - t[before - 1] < t[before] - at, before - 1, before)
    kind = _kinds(t, at, first, last, half)
    for start in range(0, len(at), CHUNK):
        part = slice(start, start + CHUNK)
        rows = first[part, None] + np.arange((last - first)[part].max())
        # Windows of a log with evenly spaced stamps are equal up to the rounding of the stamps, and are fitted once.
        _, new, same = np.unique(kind[part], axis=0, return_index=True, return_inverse=True)
        weights = _weights(t, at[part][new], rows[new], last[part][new], half, order)
        yield _Fit(part, np.minimum(rows, len(t) - 1), nearest[part], weights, same.reshape(-1))


def _kinds(t, at, first, last, half):
    """Rows (K, 3) that are equal where windows are: spacing of the stamps, offset of the first, and their number.

    A window whose stamps are not evenly spaced is of a kind of its own.
    """
    spacing = np.round(np.diff(t) / half, SAME)
    changes = np.concatenate([[0], np.cumsum(spacing[1:] != spacing[:-1])])
    even = changes[first] == changes[last - 2]
    offset = np.round((t[first] - at) / half, SAME)
    own = np.column_stack([np.full(len(at), -1.0), np.arange(len(at)), np.zeros(len(at))])
    return np.where(even[:, None], np.column_stack([spacing[first], offset, last - first]), own)


def _weights(t, at, rows, last, half, order):
    """Weights (j, order + 1, w) of the polynomials at the stamps `at` (j,), fitted to the measurements in `rows`."""
    inside = rows < last[:, None]
    s = np.where(inside, t[np.minimum(rows, len(t) - 1)] - at[:, None], 0.0)
    half_width = np.maximum(half, np.abs(s).max(axis=1))[:, None]
    s = s / half_width
    near = np.maximum(1 - np.abs(s) * s * s, 0.0)
    weight = inside * (near * np.sqrt(near) + 1e-6)
    square = weight * weight
    moments = [square]
    for _ in range(2 * order):
        moments.append(moments[-1] * s)
    powers = np.arange(order + 1)
    sums = np.stack([moment.sum(axis=1) for moment in moments], axis=1)
    solved = _inverses(sums[:, powers[:, None] + powers]) @ np.stack(moments[: order + 1], axis=1)
    ill = ~np.isfinite(solved[:, 0, 0])
    if ill.any():
        basis = s[ill, :, None] ** powers * weight[ill, :, None]
        rcond = max(basis.shape[1:]) * np.finfo(float).eps
        solved[ill] = np.linalg.pinv(basis, rcond=rcond) * weight[ill, None]
    return solved / half_width[..., None] ** powers[:, None]


def _inverses(matrices):
    """The inverses of matrices (j, c, c); NaN where half of the digits or more would be lost."""
    try:
        found = np.linalg.inv(matrices)
    except np.linalg.LinAlgError:
        return np.full(matrices.shape, np.nan)
    condition = np.prod([np.abs(each).sum(axis=1).max(axis=1) for each in (matrices, found)], axis=0)
    return np.where((condition < MOST_CONDITION)[:, None, None], found, np.nan)


def _between(a, b):
    return np.einsum("...ji,...jk->...ik", a, b)


def _log(rotation):
    """Rotation vectors (..., 3) of rotations by less than half a turn."""
    skew = np.stack([rotation[..., i, j] - rotation[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=-1) / 2
    sine = np.linalg.norm(skew, axis=-1)
    angle = np.arctan2(sine, (np.trace(rotation, axis1=-2, axis2=-1) - 1) / 2)
    return skew * np.where(sine > 0, angle / np.where(sine > 0, sine, 1.0), 1.0)[..., None]


def _exp(vector):
    """Rotations (..., 3, 3) of rotation vectors, by Rodrigues' formula."""
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(vector, -1, 0)
    none = np.zeros_like(x)
    hat = np.moveaxis(np.array(((none, -z, y), (z, none, -x), (-y, x, none))), (0, 1), (-2, -1))
    return np.eye(3) + np.sinc(angle / np.pi) * hat + np.sinc(angle / (2 * np.pi)) ** 2 / 2 * hat @ hat


def unwrap(y: Float[NumpyArray, "T n"], circles: tuple[int, ...]) -> Float[NumpyArray, "T n"]:
    """The positions without the jumps of 2π in the columns that are angles on a circle; NaN stays."""
    y = np.array(y, float)
    for column in circles:
        present = np.isfinite(y[:, column])
        y[present, column] = np.unwrap(y[present, column])
    return y


def scored_window(t: Float[NumpyArray, "T"], skip: float = 1.0, tail: float = 0.2) -> np.ndarray:
    """Mask (T,) of the stamps that are scored: without the first `skip` [s], in which the observer settles, and without
    the last `tail` [s], where the reference ends.

    A log too short for that is scored over its second half.
    """
    mask = (t > t[0] + skip) & (t < t[-1] - tail)
    return mask if mask.sum() >= 10 else t >= (t[0] + t[-1]) / 2


def rmse(estimate: Float[NumpyArray, "K n"], reference: Float[NumpyArray, "K n"]) -> Float[NumpyArray, "n"]:
    """Root mean square error of each coordinate."""
    return np.sqrt(np.mean((np.asarray(estimate) - np.asarray(reference)) ** 2, axis=0))
