"""Which change of a sensor's readings makes them those that the positions predict: sign, order, axes, scale, delay.

Readings r and predictions p of a sensor are compared as `r(t) = s M p(t − τ) + b`. M is the identity, a change of
signs, an order of columns, or a rotation; s one scale, or one for each number. The simplest change that explains about
as much as the best one is taken, and its numbers are refined by least squares, with a covariance from sums over blocks
of time. The best rotation is that of Wahba's problem (Markley 1988, by a singular value decomposition).
"""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from covariant.calibration.diagnosis._block_regression import weighted_least_squares
from covariant.calibration.diagnosis._sensor_motion import Pair
from covariant.calibration.diagnosis._suspicion import BLOCKS

EARLIEST, LATEST, EVERY = -0.1, 0.3, 0.01
"""Range and step of the delays [s] that are tried before they are refined."""
RIVAL, FLOOR = 1.5, 0.02
"""Ratio to the least unexplained fraction, and addition to it, up to which a simpler change is taken."""
MARGIN = 4.0
"""Factor by which the unexplained fraction must fall for a change other than a delay."""
ROUNDS = 8
RANK = 0.02
"""Least singular value of what the motion shows of three axes, as a fraction of the largest, that determines a turn."""


class Change(NamedTuple):
    """A change of what a sensor reads.

    Attributes:
        kind: "", "sign", "order" or "axes".
        matrix: Matrix (k, k), orthogonal, with `read = matrix predicted`.
    """

    kind: str
    matrix: Float[np.ndarray, "k k"]


class Verdict(NamedTuple):
    """The change that explains the readings of a sensor, and its numbers.

    Attributes:
        change: The change.
        before: Unexplained fraction of the variance of the readings as they are, without any scale or delay.
        after: The same with the change, its scale and its delay.
        scale: Scales (k,) of the readings; 1 where the motion does not show one.
        scale_std: Their standard errors (k,).
        delay: Delay [s] beyond that of the model file.
        delay_std: Its standard error [s].
        bias: Constant offsets (k,).
        bias_std: Their standard errors (k,).
    """

    change: Change
    before: float
    after: float
    scale: Float[np.ndarray, "k"]
    scale_std: Float[np.ndarray, "k"]
    delay: float
    delay_std: float
    bias: Float[np.ndarray, "k"]
    bias_std: Float[np.ndarray, "k"]


class _Data(NamedTuple):
    """The pair, and how its numbers belong together."""

    pair: Pair
    vector: bool  # whether the numbers are those of one vector
    offset: bool  # whether an offset is free from the first

    @property
    def size(self) -> int:
        return self.pair.read.shape[1]

    def shown(self, change: Change) -> Bool[np.ndarray, "k"]:
        """Which readings (k,) should change clearly with the motion, after a change."""
        return np.abs(change.matrix) @ self.pair.shown > 0.5


def judged(pair: Pair, vector: bool, offset: bool) -> Verdict:
    """Find the change that makes readings those that are predicted."""
    data = _Data(pair, vector, offset)
    delays = np.unique(np.append(np.arange(EARLIEST, LATEST + EVERY / 2, EVERY).round(6), 0.0))
    changes = list(_changes(data))
    zero = int(np.flatnonzero(delays == 0)[0])
    shares = np.array([[_share(data, each, s) for each in changes] for s in (_shift_pair(data, d) for d in delays)]).T
    # A delay beside another change is searched only where nothing else explains the readings.
    at = np.full(len(changes), zero)
    if shares[:, zero].min() > FLOOR:
        at = shares.argmin(axis=1)
        at[shares[:, zero] <= RIVAL * shares.min(axis=1) + FLOOR] = zero
    values = shares[np.arange(len(changes)), at]
    first = int(np.flatnonzero(values <= RIVAL * values.min() + FLOOR)[0])
    if values[0] < MARGIN * values[first]:
        first = 0
    chosen = changes[first]
    fit = _fit_change(data, chosen, float(delays[at[first]]))
    before = _residual_share(data, changes[0], np.ones(data.size), 0.0)
    after = _residual_share(data, chosen, fit[0], fit[2])
    return Verdict(chosen, before, after, *fit)


def _changes(data: _Data) -> Iterator[Change]:
    """Changes to try, the simplest first."""
    k = data.size
    eye, orders = np.eye(k), list(itertools.permutations(range(k))) if k <= 4 else [tuple(range(k))]
    yield Change("", eye)
    if not data.vector:  # a scale of each number includes its sign
        yield from (Change("order", eye[list(order)]) for order in orders[1:])
        return
    signs = [np.array(each) for each in itertools.product((1.0, -1.0), repeat=k)][1:]
    # All signs or one are the usual mistakes; two of three are a half turn, which `axes` says too.
    yield from (Change("sign", np.diag(each)) for each in sorted(signs, key=lambda s: (s.sum() != -k, -s.sum())))
    yield from (Change("order", eye[list(order)]) for order in orders[1:])
    for order in orders:
        for each in signs:
            turned = np.diag(each) @ eye[list(order)]
            if order != orders[0] and np.linalg.det(turned) > 0:
                yield Change("axes", turned)
    yield Change("axes", best_rotation(data.pair, data.offset)[0])


def best_rotation(pair: Pair, offset: bool) -> tuple[Float[np.ndarray, "3 3"], bool]:
    """Rotation that takes predicted vectors to measured ones, and whether the motion determines it."""
    predicted, read = (each[pair.used] for each in (pair.predicted, pair.read))
    if offset:
        predicted, read = predicted - predicted.mean(axis=0), read - read.mean(axis=0)
    u, s, vt = np.linalg.svd(read.T @ predicted)
    if s[1] > RANK * s[0]:
        flip = np.diag([1.0, 1.0, np.linalg.det(u @ vt)])
        return u @ flip @ vt, True
    # One axis: of all rotations that take it to the measured one the least.
    return _least_turn(vt[0], u[:, 0]), False


def _least_turn(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    axis, cosine = np.cross(a, b), float(a @ b)
    if cosine < -1 + 1e-9:
        across = np.linalg.svd(a[None])[2][1]
        return 2 * np.outer(across, across) - np.eye(3)
    hat = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + hat + hat @ hat / (1 + cosine)


class _Shifted(NamedTuple):
    """Predictions τ earlier, their slopes in time, the readings, and at which points all are known."""

    predicted: np.ndarray
    slope: np.ndarray
    read: np.ndarray
    rows: np.ndarray


def _shift_pair(data: _Data, delay: float) -> _Shifted:
    pair = data.pair
    step, size = float(pair.t[1] - pair.t[0]), len(pair.t)
    x = np.arange(size) - delay / step
    i = np.clip(np.floor(x).astype(int), 1, size - 3)
    f = (x - i)[:, None]
    p = [pair.predicted[i + j] for j in (-1, 0, 1, 2)]
    # The cubic through four points of the grid, whose windows overlap by nine tenths.
    weights = (-f * (f - 1) * (f - 2) / 6, (f**2 - 1) * (f - 2) / 2, -f * (f + 1) * (f - 2) / 2, f * (f**2 - 1) / 6)
    slopes = (-(3 * f**2 - 6 * f + 2) / 6, (3 * f**2 - 4 * f - 1) / 2, -(3 * f**2 - 2 * f - 2) / 2, (3 * f**2 - 1) / 6)
    moved, slope = (sum(w * each for w, each in zip(ws, p, strict=True)) for ws in (weights, slopes))
    known = pair.used & pair.used[i] & pair.used[i + 1] & (x >= 0) & (x <= size - 1)
    rows = np.flatnonzero(known)
    return _Shifted(moved[rows], slope[rows] / step, pair.read[rows], rows)  # pyright: ignore[reportIndexIssue,reportOperatorIssue]


def _readings_and_predictions(data: _Data, change: Change, shifted: _Shifted) -> tuple[np.ndarray, np.ndarray]:
    """Readings and what a change makes of their predictions, less their means where an offset is free."""
    read, predicted = shifted.read, shifted.predicted @ change.matrix.T
    return (read - read.mean(axis=0), predicted - predicted.mean(axis=0)) if data.offset else (read, predicted)


def _share(data: _Data, change: Change, shifted: _Shifted) -> float:
    """Unexplained fraction of the readings with the best scale of a change."""
    if len(shifted.read) < 2 * BLOCKS:
        return 1.0
    read, predicted = _readings_and_predictions(data, change, shifted)
    product, squares, total = (read * predicted).sum(axis=0), (predicted**2).sum(axis=0), (read**2).sum(axis=0)
    if data.vector:  # one scale, and its sign is among the changes
        return float(1 - max(product.sum(), 0.0) ** 2 / max(squares.sum() * total.sum(), 1e-300))
    # Noise alone explains nothing of a number that should move; of one that should not and does not nothing is left.
    counted = data.pair.moving | data.shown(change)
    return float(np.mean(np.where(counted, 1 - product**2 / np.maximum(squares * total, 1e-300), 0.0)))


def _residual_share(data: _Data, change: Change, scale: np.ndarray, delay: float) -> float:
    """Unexplained fraction of the readings with a change, its scales and its delay."""
    read, predicted = _readings_and_predictions(data, change, _shift_pair(data, delay))
    left, total = ((read - scale * predicted) ** 2).sum(axis=0), (read**2).sum(axis=0)
    if data.vector:
        return float(left.sum() / max(total.sum(), 1e-300))
    shown = data.shown(change)
    return float(np.mean((left / np.maximum(total, 1e-300))[shown])) if shown.any() else 0.0


def _fit_change(
    data: _Data, change: Change, delay: float
) -> tuple[np.ndarray, np.ndarray, float, float, np.ndarray, np.ndarray]:
    """Scales, delay and offsets by Gauss–Newton steps, each with its standard error."""
    k = data.size
    # Columns of scales: one for the vector, or one for each number that the motion shows.
    groups = np.ones((1, k)) if data.vector else np.eye(k)[data.shown(change)]
    scale, cov, bias = _first_scale(data, change, delay, groups), np.zeros((1, 1)), np.zeros(k)
    for _ in range(ROUNDS):
        shifted = _shift_pair(data, delay)
        predicted, slope = (each @ change.matrix.T for each in (shifted.predicted, shifted.slope))
        columns = [-scale * slope, *(group * predicted for group in groups)]
        if data.offset:
            columns += [np.broadcast_to(row, predicted.shape) for row in np.eye(k)]
        j = np.stack(columns, axis=2)
        left = shifted.read - scale * predicted - bias
        weight = np.diag(1 / np.maximum(np.var(left, axis=0), data.pair.read_noise**2 + 1e-24))
        step, cov = weighted_least_squares(left, j, weight)
        delay += float(np.clip(step[0], -EVERY, EVERY))
        scale = scale + step[1 : 1 + len(groups)] @ groups
        if data.offset:
            bias = bias + step[1 + len(groups) :]
        if abs(step[0]) < 1e-6:
            break
    std = np.sqrt(np.maximum(np.diag(cov), 0.0))
    scale_std = std[1 : 1 + len(groups)] @ groups
    if data.offset:
        return scale, scale_std, delay, float(std[0]), bias, std[1 + len(groups) :]
    # What feels gravity has its offset found with the scale as it should be: a constant hides either.
    left = _shift_pair(data, delay)
    left = left.read - left.predicted @ change.matrix.T
    means = np.array([part.mean(axis=0) for part in np.array_split(left, BLOCKS)])
    return scale, scale_std, delay, float(std[0]), left.mean(axis=0), means.std(axis=0) / np.sqrt(BLOCKS)


def _first_scale(data: _Data, change: Change, delay: float, groups: np.ndarray) -> np.ndarray:
    """Scales (k,) by least squares at a delay."""
    read, predicted = _readings_and_predictions(data, change, _shift_pair(data, delay))
    scale = np.ones(data.size)
    for group in groups:
        product, squares = ((group * each * predicted).sum() for each in (read, predicted))
        scale = np.where(group > 0, product / max(squares, 1e-300), scale)
    return scale
