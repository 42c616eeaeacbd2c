"""Scoring of velocity estimates, against the truth or against a reference computed from the recorded positions."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from scalargraph.errors import InputError

NumpyArray = np.ndarray

HOLE = 3.0
"""Length of a hole, in steps between stamps of which 5 % are longer."""
SETTLED = 0.5
"""Time [s] after a hole, within which its errors are counted as those of the hole."""
FIRST_ROWS = 10
"""First rows of a log, which are never scored: no observer knows a velocity well from so few readings."""

CHUNK = 1000
"""Number of windows fitted at once: enough for NumPy to be fast, in a few megabytes."""

SAME = 10
"""Decimal digits, in units of half a window, to which the stamps of two windows must agree to count as equal."""

MOST_CONDITION = 1e6
"""Largest condition number of the normal equations of a window; above it the window is fitted by singular values."""

FARTHEST_TURN = 1.5
"""Largest angle [rad] in half a window, up to which a rotation vector is close to a polynomial in time."""


def zero_phase_velocity(
    t: Float[NumpyArray, "T"],
    y: Float[NumpyArray, "T n"],
    at: Float[NumpyArray, "K"],
    half: float = 0.03,
    order: int = 3,
) -> Float[NumpyArray, "K n"]:
    """Velocities from recorded positions, as slopes of local polynomials with tricube weights.

    The windows include later samples, so this is for scoring only.

    Args:
        t: Stamps (T,) [s].
        y: Positions (T, n). Missing ones (NaN) are left out, column by column.
        at: Stamps (K,) [s] at which velocities are computed.
        half: Half width of each window [s].
        order: Degree of the polynomials.

    Returns:
        Velocities (K, n) [unit of the position/s].

    Raises:
        ValueError: There are fewer than `order` + 3 measurements.

    Example:
        >>> import numpy as np
        >>> from covariant.scoring import zero_phase_velocity
        >>> t = np.linspace(0.0, 1.0, 101)
        >>> zero_phase_velocity(t, t[:, None] ** 2, np.array([0.25, 0.5])).round(6).tolist()
        [[0.5], [1.0]]
    """
    return _coefficients(t, y, at, half, order, slice(1, 2))[:, 0]


def local_polynomials(
    t: Float[NumpyArray, "T"],
    y: Float[NumpyArray, "T n"],
    at: Float[NumpyArray, "K"],
    half: float = 0.03,
    order: int = 3,
) -> Float[NumpyArray, "K c n"]:
    """Coefficients of local polynomials fitted to recorded positions, in the time since each stamp.

    Args:
        t: Stamps (T,) [s].
        y: Positions (T, n). Missing ones (NaN) are left out, column by column.
        at: Stamps (K,) [s] at which polynomials are fitted.
        half: Half width of each window [s].
        order: Degree of the polynomials.

    Returns:
        Coefficients (K, order + 1, n); coefficient c is the c-th derivative divided by c!.

    Raises:
        ValueError: There are fewer than `order` + 3 measurements.

    Example:
        >>> import numpy as np
        >>> from covariant.scoring import local_polynomials
        >>> t = np.linspace(0.0, 1.0, 101)
        >>> abs(local_polynomials(t, t[:, None] ** 2, np.array([0.5]), order=2)[0, :, 0]).round(6).tolist()
        [0.25, 1.0, 1.0]
    """
    return _coefficients(t, y, at, half, order, slice(int(order) + 1))


def _coefficients(t, y, at, half, order, wanted: slice):
    """Coefficients `wanted` (K, c, n) of the local polynomials."""
    y = np.asarray(y, float)
    measured = np.isfinite(y)
    result = np.empty((len(at), len(range(int(order) + 1)[wanted]), y.shape[1]))
    together: dict[bytes, list[int]] = {}  # columns that are measured in the same rows have the same windows
    for column, rows in enumerate(measured.T):
        together.setdefault(rows.tobytes(), []).append(column)
    shared = _complete_window_mask(t, measured, at, half, order) if len(together) > 1 else np.zeros(len(at), bool)
    every = list(range(y.shape[1]))
    asked = [(columns, measured[:, columns[0]], ~shared) for columns in together.values()]
    for columns, rows, stamps in [(every, measured.all(axis=1), shared), *asked]:
        if not stamps.any():
            continue
        seen, part = y[rows].T[columns], np.empty((int(stamps.sum()), *result.shape[1:2], len(columns)))
        for fit in _fits(t[rows], at[stamps], half, order):
            weights = fit.weights[fit.same, wanted]
            for k, positions in enumerate(seen):
                # From the first position: the velocity of what stands still is zero, and no rounding error.
                part[fit.at, :, k] = np.einsum("kcw,kw->kc", weights, (positions - positions[0]).take(fit.rows))
                if not wanted.start:
                    part[fit.at, 0, k] += positions[0]
        result[np.ix_(stamps, range(result.shape[1]), columns)] = part
    return result


def _complete_window_mask(t, measured, at, half, order):
    """Mask (K,) of the stamps whose windows are complete and long enough, and so are the same for all columns."""
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
    """Body velocities from recorded rotations or poses, for scoring only.

    As in `zero_phase_velocity`, local polynomials are fitted: to the rotation vectors [rad] of the motion relative to
    the body, and to the positions. A body must turn by less than half a turn in `order` + 3 samples.

    Args:
        t: Stamps (T,) [s].
        g: Rotations (T, d, d), or poses (T, d + 1, d + 1) with the position in the last column. Missing matrices (any
            NaN) are left out.
        at: Stamps (K,) [s] at which velocities are computed.
        half: Half width of each window [s].
        order: Degree of the polynomials.
        space: Dimension d, 2 or 3.

    Returns:
        Angular velocity in the body frame (K, 3) [rad/s], or (K, 1) in the plane; where there is a position, the linear
        velocity in the body frame (K, d) [m/s] comes before it.

    Raises:
        ValueError: There are fewer than `order` + 3 measurements.

    Example:
        >>> import numpy as np
        >>> from covariant.scoring import zero_phase_twist
        >>> t = np.linspace(0.0, 1.0, 101)
        >>> c, s = np.cos(t), np.sin(t)
        >>> g = np.moveaxis(np.array([[c, -s], [s, c]]), 2, 0)
        >>> zero_phase_twist(t, g, np.array([0.5]), space=2).round(6).tolist()
        [[1.0]]
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
    speed = np.linalg.norm(_log(_relative_rotation(rotation[:-1], rotation[1:])), axis=1) / np.diff(t)
    # A quantile, so that a few wrong attitudes do not shorten every window.
    half = min(half, FARTHEST_TURN / max(float(np.quantile(speed, 0.95)), 1e-9))
    attitude, turning = np.empty((len(at), 3, 3)), np.empty((len(at), 3))
    for fit in _fits(t, at, half, order):
        nearest, measured = rotation[fit.nearest], rotation[fit.rows]
        # First around the nearest measurement, then around the smoothed attitude: there the offset is zero.
        attitude[fit.at] = nearest @ _exp(_polynomial(fit, nearest, measured)[0])
        turning[fit.at] = _polynomial(fit, attitude[fit.at], measured)[1]  # at zero offset the slope is the velocity
    return attitude, turning


def _polynomial(fit, base, measured):
    """Offset and slope (2, k, 3) of the rotation vectors from `base` to the measured rotations."""
    return np.einsum("kcw,kwi->cki", fit.weights[fit.same, :2], _log(_relative_rotation(base[:, None], measured)))


class _Fit(NamedTuple):
    """Local polynomials at a slice `at` of the stamps.

    - `rows` (k, w): indices of the measurements in each window.
    - `nearest` (k,): index of the measurement nearest to each stamp.
    - `weights` (j, order + 1, w): weights with which the measurements sum up to the coefficients, for the j windows
      that differ.
    - `same` (k,): index among these j of the window of each stamp.
    """

    at: slice
    rows: Int[NumpyArray, "k w"]
    nearest: Int[NumpyArray, "k"]
    weights: Float[NumpyArray, "j c w"]
    same: Int[NumpyArray, "k"]


def _fits(t, at, half, order) -> Iterator[_Fit]:
    order = int(order)
    if len(t) < order + 3:
        raise InputError(f"a reference of order {order} needs {order + 3} measurements; there are {len(t)}")
    reach = half * (1 + 1e-9)  # so that no rounding decides on the samples at the ends of a window
    first, last = np.searchsorted(t, at - reach), np.searchsorted(t, at + reach, side="right")
    # order + 1 coefficients, and two samples more, so that noise is averaged and not interpolated.
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

    A window whose stamps are not evenly spaced gets a row of its own.
    """
    spacing = np.round(np.diff(t) / half, SAME)
    changes = np.concatenate([[0], np.cumsum(spacing[1:] != spacing[:-1])])
    # Rows first … last − 1 have the steps first … last − 2; these are equal where no step changed in between.
    even = changes[first] == changes[last - 2]
    offset = np.round((t[first] - at) / half, SAME)
    unique = np.column_stack([np.full(len(at), -1.0), np.arange(len(at)), np.zeros(len(at))])
    return np.where(even[:, None], np.column_stack([spacing[first], offset, last - first]), unique)


def _weights(t, at, rows, last, half, order):
    """Weights (j, order + 1, w) of the polynomials at the stamps `at` (j,), fitted to the measurements in `rows`."""
    inside = rows < last[:, None]
    s = np.where(inside, t[np.minimum(rows, len(t) - 1)] - at[:, None], 0.0)
    # A window that was widened for lack of samples is scaled by its width, so that |s| ≤ 1, as the kernel needs it.
    half_width = np.maximum(half, np.abs(s).max(axis=1))[:, None]
    s = s / half_width
    base = np.maximum(1 - np.abs(s) * s * s, 0.0)
    # The weights multiply residuals that are squared, so this is the root of the tricube kernel (1 − |s|³)³. The small
    # constant keeps the fit solvable where samples lie at the ends of the window.
    weight = inside * (base * np.sqrt(base) + 1e-6)
    square = weight * weight
    moments = [square]
    for _ in range(2 * order):
        moments.append(moments[-1] * s)
    powers = np.arange(order + 1)
    # The normal matrix of powers is a Hankel matrix: entry (i, j) is the moment i + j.
    sums = np.stack([moment.sum(axis=1) for moment in moments], axis=1)
    solved = _inverses(sums[:, powers[:, None] + powers]) @ np.stack(moments[: order + 1], axis=1)
    ill = ~np.isfinite(solved[:, 0, 0])
    if ill.any():
        basis = s[ill, :, None] ** powers * weight[ill, :, None]
        # The relative threshold of NumPy's `matrix_rank`: singular values below it are rounding errors.
        rcond = max(basis.shape[1:]) * np.finfo(float).eps
        solved[ill] = np.linalg.pinv(basis, rcond=rcond) * weight[ill, None]
    # The fit is in the scaled time s, so a derivative of order p has the factor half_width⁻ᵖ.
    return solved / half_width[..., None] ** powers[:, None]


def _inverses(matrices):
    """The inverses of matrices (j, c, c); NaN where half of the digits or more would be lost."""
    try:
        inverse = np.linalg.inv(matrices)
    except np.linalg.LinAlgError:
        return np.full(matrices.shape, np.nan)
    # Condition number in the 1-norm; above `MOST_CONDITION` the caller solves by singular values instead.
    condition = np.prod([np.abs(each).sum(axis=1).max(axis=1) for each in (matrices, inverse)], axis=0)
    return np.where((condition < MOST_CONDITION)[:, None, None], inverse, np.nan)


def _relative_rotation(a, b):
    return np.einsum("...ji,...jk->...ik", a, b)


def _log(rotation):
    """Rotation vectors (..., 3) of rotations by less than half a turn."""
    skew = np.stack([rotation[..., i, j] - rotation[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=-1) / 2
    sine = np.linalg.norm(skew, axis=-1)
    # arctan2 is accurate at small angles, where the arc cosine of the trace loses half of the digits.
    angle = np.arctan2(sine, (np.trace(rotation, axis1=-2, axis2=-1) - 1) / 2)
    return skew * np.where(sine > 0, angle / np.where(sine > 0, sine, 1.0), 1.0)[..., None]


def _exp(vector):
    """Rotations (..., 3, 3) of rotation vectors, by Rodrigues' formula."""
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(vector, -1, 0)
    none = np.zeros_like(x)
    hat = np.moveaxis(np.array(((none, -z, y), (z, none, -x), (-y, x, none))), (0, 1), (-2, -1))
    # sin(a)/a and (1 − cos a)/a² = ½ sinc²(a/2), without division by zero; `np.sinc(x)` is sin(πx)/(πx).
    return np.eye(3) + np.sinc(angle / np.pi) * hat + np.sinc(angle / (2 * np.pi)) ** 2 / 2 * hat @ hat


def unwrap(
    y: Float[NumpyArray, "T n"], circles: tuple[int, ...], periods: Sequence[float] | NumpyArray = ()
) -> Float[NumpyArray, "T n"]:
    """Remove the jumps of a period from columns: of 2π from angles on a circle, and of others where they are stated.

    Args:
        y: Positions (T, n); NaN stays.
        circles: Indices of the columns that are angles [rad].
        periods: Period (n,) of each column [its unit] where it is another one, as of an encoder behind a gear; 0 for
            none. Empty (default) for none at all.

    Returns:
        A copy of the positions, continuous in these columns.

    Example:
        >>> import numpy as np
        >>> from covariant.scoring import unwrap
        >>> unwrap(np.array([[3.0], [-3.0]]), (0,)).round(3).tolist()
        [[3.0], [3.283]]
        >>> unwrap(np.array([[0.9], [0.1]]), (), (1.0,)).tolist()
        [[0.9], [1.1]]
    """
    y = np.array(y, float)
    wraps = dict.fromkeys(circles, 2 * np.pi) | {i: float(p) for i, p in enumerate(periods) if p > 0}
    for column, period in wraps.items():
        present = np.isfinite(y[:, column])
        y[present, column] = np.unwrap(y[present, column], period=period)
    return y


def scored_window(t: Float[NumpyArray, "T"], skip: float = 1.0, tail: float = 0.2) -> np.ndarray:
    """Stamps at which estimates are scored, without the transient at the start and the end of the log.

    Args:
        t: Stamps (T,) [s].
        skip: Initial part [s] that is left out, in which the observer settles, at least `FIRST_ROWS` rows.
        tail: Final part [s] that is left out, where the windows of the reference end.

    Returns:
        Mask (T,); where fewer than ten stamps remain, the second half of the log.

    Example:
        >>> import numpy as np
        >>> from covariant.scoring import scored_window
        >>> int(scored_window(np.linspace(0.0, 2.0, 201)).sum())
        79
    """
    mask = (t > t[0] + skip) & (t < t[-1] - tail) & (np.arange(len(t)) >= FIRST_ROWS)
    return mask if mask.sum() >= 10 else t >= (t[0] + t[-1]) / 2


def longest_step(t: Float[NumpyArray, "T"]) -> float:
    """Longest step [s] between stamps that is no hole.

    Args:
        t: Rising stamps (T,) [s].

    Returns:
        `HOLE` times the step that 5 % of the steps exceed, so that stamps that jitter make no holes.

    Example:
        >>> import numpy as np
        >>> from covariant.scoring import longest_step
        >>> round(longest_step(np.arange(0.0, 1.0, 0.01)), 6)
        0.03
    """
    return HOLE * float(np.quantile(np.diff(t), 0.95))


def find_holes(t: Float[NumpyArray, "T"], present: Bool[NumpyArray, "T"]) -> Float[NumpyArray, "H 2"]:
    """Holes of a log: where nothing is present for longer than `longest_step`, as cells or whole rows are missing.

    Args:
        t: Rising stamps (T,) [s].
        present: In which rows (T,) there is something.

    Returns:
        The last stamp before each hole, and the first one after it.

    Example:
        >>> import numpy as np
        >>> from covariant.scoring import find_holes
        >>> t = np.delete(np.arange(0.0, 1.0, 0.01), slice(20, 40))
        >>> find_holes(t, t != 0.5).round(2).tolist()
        [[0.19, 0.4]]
    """
    stamps = t[present]
    if len(stamps) < 2:
        return np.zeros((0, 2))
    wide = np.flatnonzero(np.diff(stamps) > longest_step(stamps))
    return np.stack([stamps[wide], stamps[wide + 1]], axis=1)


def near_holes(t: Float[NumpyArray, "T"], holes: Float[NumpyArray, "H 2"]) -> Bool[NumpyArray, "T"]:
    """Rows in the holes of a log, or within `SETTLED` after one, whose errors are counted as those of the hole.

    Args:
        t: Rising stamps (T,) [s].
        holes: From `find_holes`.

    Returns:
        Whether each row (T,) is such a row.

    Example:
        >>> import numpy as np
        >>> from covariant.scoring import near_holes
        >>> near_holes(np.array([0.0, 1.0, 1.4, 2.0]), np.array([[0.2, 1.0]])).tolist()
        [False, True, True, False]
    """
    near = np.zeros(len(t), bool)
    for begin, end in holes:
        near |= (t > begin) & (t <= end + SETTLED)
    return near


def rmse(estimate: Float[NumpyArray, "K n"], reference: Float[NumpyArray, "K n"]) -> Float[NumpyArray, "n"]:
    """Root mean square error of each coordinate.

    Args:
        estimate: Estimates (K, n).
        reference: True or reference values (K, n).

    Returns:
        Errors (n,), in the units of the coordinates.

    Example:
        >>> import numpy as np
        >>> from covariant.scoring import rmse
        >>> rmse(np.array([[3.0, 0.0], [3.0, 1.0]]), np.zeros((2, 2))).round(3).tolist()
        [3.0, 0.707]
    """
    return np.sqrt(np.mean((np.asarray(estimate) - np.asarray(reference)) ** 2, axis=0))
