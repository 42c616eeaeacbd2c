"""Is a matrix positive definite everywhere in a box? Proved by branch and bound in outward-rounded arithmetic.

On each box the entries are enclosed by natural interval evaluation, by the mean-value form around the centre,
`S(z) ∈ S(c) + S'(box) (z − c)`, and by Taylor's, `S(z) ∈ S(c) + S'(c) (z − c) + ½ S''(box) (z − c)²`, which needs boxes
some ten times fewer a variable; the tightest bounds are taken. The enclosing interval matrix is brought near the
identity by a congruence with floating-point factors, `I − CᵀSC = E`, and is positive definite where the spectral radius
of |E| is below one, by Collatz & Wielandt: `|E| x < x` for some positive x, whose rounding is bounded in turn. Boxes
for which that fails are halved across the variable that widens the enclosure most.

Source: Neumaier 1990, Interval Methods for Systems of Equations, section 2.3; Rump 2010, Verification methods, Acta
Numerica 19, section 10.8.
"""

import concurrent.futures
import itertools
import multiprocessing
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from covariant.lowering import Lowered, enclose, expand, lower, pairs

SLACK = 1e-3
"""By how much |E| x must stay below x, so that another implementation of the test agrees on every box."""
ROUND = 1e-12
"""A bound of the relative rounding of a sum of a few hundred terms, with room to spare."""
TINY = 1e-290
"""More than all underflows of such a sum together."""
CHUNK = 2048
"""Boxes evaluated at once: their intermediate values stay in the cache."""

PATIENCE = 2.0
"""Seconds of work alone before it is shared out over processes."""
PROVED, OPEN = -1, -2


class Box(NamedTuple):
    """Bounds of named variables; one with equal bounds is held fixed.

    - `names`, `units`: of the variables, for people.
    - `low`, `high`: (d,).
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    low: Float[np.ndarray, "d"]
    high: Float[np.ndarray, "d"]

    @property
    def free(self) -> "Box":
        """The variables that are not held fixed."""
        kept = np.flatnonzero(self.high > self.low)
        names, units = (tuple(words[i] for i in kept) for words in (self.names, self.units))
        return Box(names, units, self.low[kept], self.high[kept])

    def __str__(self) -> str:
        parts = zip(self.names, self.units, self.low, self.high, strict=True)
        return ", ".join(f"{low:.4g} ≤ {name} ≤ {high:.4g} {unit}".rstrip() for name, unit, low, high in parts)


def box(**bounds: tuple[float, float] | tuple[float, float, str]) -> Box:
    """A box from `name=(low, high)` or `name=(low, high, unit)`.

    Raises `ValueError` naming a variable whose bounds are not finite numbers in order.
    """
    units = tuple(str(b[2]) if len(b) == 3 else "" for b in bounds.values())
    low = np.array([float(b[0]) for b in bounds.values()])
    high = np.array([float(b[1]) for b in bounds.values()])
    return check_box(Box(tuple(bounds), units, low, high))


def check_box(given: Box) -> Box:
    """The box itself. Raises `ValueError` naming a variable whose bounds are not finite numbers in order."""
    for name, low, high in zip(given.names, given.low, given.high, strict=True):
        if not (np.isfinite(low) and np.isfinite(high) and low <= high):
            raise ValueError(f"bounds of {name} must be finite, the lower one first; got {low:g} to {high:g}")
    return given


class Proof(NamedTuple):
    """What branch and bound found.

    - `verdict`: "holds", "fails" (then `counterexample` is a box in which the matrix is nowhere positive definite) or
      "undecided" (then `open` are the boxes that remain).
    - `levels`: the boxes as a binary tree, one array of integers a level from the whole box down: the variable across
      whose middle a box is halved, lower half first, −1 where the matrix is proved positive definite, −2 if it is open.
    - `boxes`: how many were evaluated, in `seconds`.
    """

    verdict: Literal["holds", "fails", "undecided"]
    box: Box
    levels: list[np.ndarray]
    counterexample: Float[np.ndarray, "2 d"] | None
    open: Float[np.ndarray, "k 2 d"]
    boxes: int
    seconds: float


def prove(
    matrix: Callable[[Array], Array],
    domain: Box,
    *,
    seconds: float = 60.0,
    processes: int = 1,
    progress: Callable[[float, int], None] | None = None,
) -> Proof:
    """Is `matrix`: `z (d,) -> (n, n)`, a symmetric JAX function, positive definite for every z in the domain?

    Stops after `seconds`, then "undecided". `processes` above 1 shares the boxes out (a script that asks for it needs
    the `if __name__ == "__main__"` guard); the tree found does not depend on it. `progress` is told the share of the
    domain that is decided and the number of boxes evaluated, now and then.

    Raises `LoweringError` where the matrix has no graph of scalars, `ValueError` where it is not square.
    """
    start = time.monotonic()
    check_box(domain)
    return _decide(_task(matrix, domain), domain, start, start + seconds, processes, progress)


def prove_at_corners(
    matrix: Callable[[Array], Array],
    domain: Box,
    affine: Sequence[str],
    *,
    seconds: float = 60.0,
    progress: Callable[[float, int], None] | None = None,
) -> list[Proof]:
    """The same where the matrix is affine in some of the variables, taken together: one proof for each corner of them.

    The smallest eigenvalue is then a concave function of those variables, least at a corner of their box; so they need
    not be halved, and 2^k proofs over the others take the place of one over all. Stops at the first that does not hold.

    Raises `ValueError` where the matrix is not affine in them, as its second derivatives show, or one is not known.
    """
    start = time.monotonic()
    check_box(domain)
    unknown = set(affine) - set(domain.names)
    if unknown:
        raise ValueError(f"prove_at_corners: no variable {sorted(unknown)[0]!r}; the box has {', '.join(domain.names)}")
    z = jnp.asarray(domain.low)
    kept = np.array([domain.names.index(name) for name in affine], int)
    bent = expand(lower(lambda z: matrix(z).ravel(), z), kept.tolist(), 2)
    count = jax.eval_shape(matrix, z).size
    entries = np.array([_moves(bent.graph.nodes[i]) for i in bent.outputs]).reshape(-1, count)
    moves = [bool(row.any()) for row in entries]
    if any(moves[1 + len(kept) :]):
        raise ValueError(f"prove_at_corners: the matrix is not affine in {', '.join(affine)} together")
    ends = [(domain.low[i], domain.high[i])[: 1 + enters] for i, enters in zip(kept, moves[1:], strict=False)]
    task, found = None, []
    for corner in itertools.product(*ends):
        low, high = domain.low.copy(), domain.high.copy()
        low[kept] = high[kept] = corner
        at = domain._replace(low=low, high=high)
        task = _task(matrix, at) if task is None else task
        found.append(_decide(task, at, time.monotonic(), start + seconds, 1, progress))
        if found[-1].verdict != "holds":
            break
    return found


def _moves(node) -> bool:
    """Whether a node is anything but the constant 0."""
    return node.op != "constant" or node.value != 0


def _decide(task: "_Task", domain: Box, start: float, until: float, processes: int, progress) -> Proof:
    wrong = _look_around(task, domain)
    if wrong is not None:
        leaf = [np.array([OPEN])]
        return Proof("fails", domain, leaf, wrong, np.zeros((0, 2, len(domain.low))), 1, time.monotonic() - start)
    tree = _Tree(domain)
    # Most proofs are over before worker processes have started.
    wrong = _search(task, tree, min(until, time.monotonic() + PATIENCE) if processes > 1 else until, progress)
    if processes > 1 and wrong is None and tree.waiting and time.monotonic() < until:
        context = multiprocessing.get_context("spawn")
        with concurrent.futures.ProcessPoolExecutor(processes, context, initializer=_take, initargs=(task,)) as pool:
            wrong = _share_out(pool, tree, 2 * processes, until, progress)
    levels, remaining = tree.levels()
    verdict = "fails" if wrong is not None else "undecided" if len(remaining) else "holds"
    return Proof(verdict, domain, levels, wrong, remaining, tree.evaluated, time.monotonic() - start)


def blocks(matrix: Callable[[Array], Array], domain: Box) -> list[Int[np.ndarray, "k"]]:
    """Indices of the diagonal blocks that a symmetric `z -> (n, n)` falls into, after a permutation, for every z.

    It is positive definite where each of them is, and each depends on fewer variables. Entries count as zero where
    their graph is the constant 0.
    """
    z = jnp.asarray(domain.low)
    n = jax.eval_shape(matrix, z).shape[0]
    lowered = lower(lambda z: (matrix(z) + matrix(z).T).ravel(), z)
    nodes = [lowered.graph.nodes[i] for i in lowered.outputs]
    reached = np.array([_moves(node) for node in nodes]).reshape(n, n) | np.eye(n, dtype=bool)
    for _ in range(n.bit_length()):
        reached = reached @ reached
    return [np.flatnonzero(row) for row in np.unique(reached, axis=0)]


def leaves(domain: Box, levels: list[np.ndarray]) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """The leaves of a tree, level by level: their codes (m,), low (m, d) and high (m, d).

    Raises `ValueError` where the levels are not a tree over the domain.
    """
    low, high = domain.low[None], domain.high[None]
    for codes in itertools.chain(levels, [np.zeros(0, int)]):
        if len(codes) != len(low):
            raise ValueError(f"a level of the tree of boxes must hold {len(low)} boxes; it holds {len(codes)}")
        end = codes < 0
        yield codes[end], low[end], high[end]
        low, high = halves(low[~end], high[~end], codes[~end])


def halves(low, high, axes) -> tuple[np.ndarray, np.ndarray]:
    """Both halves of boxes (k, d), lower before upper: (2k, d). The middle belongs to both, so that nothing is lost."""
    rows = np.arange(len(low))
    middle = _middle(low[rows, axes], high[rows, axes])
    low, high = np.repeat(low, 2, axis=0), np.repeat(high, 2, axis=0)
    high[2 * rows, axes] = middle
    low[2 * rows + 1, axes] = middle
    return low, high


def _middle(low, high):
    return low / 2 + high / 2


class _Task(NamedTuple):
    """What a worker needs: the entries below the diagonal (K,), alone, with first and with second derivatives."""

    value: Lowered
    first: Lowered
    second: Lowered
    size: int
    free: Int[np.ndarray, "f"]
    width: Float[np.ndarray, "d"]


class _Enclosed(NamedTuple):
    """Matrices `middle ± radius` (B, n, n), and the share (B, f, n, n) of the radius that each free variable brings."""

    middle: np.ndarray
    radius: np.ndarray
    shares: np.ndarray
    smooth: Bool[np.ndarray, "B"]


def _task(matrix: Callable[[Array], Array], domain: Box) -> _Task:
    z = jnp.asarray(domain.low)
    shape = jax.eval_shape(matrix, z).shape
    if len(shape) != 2 or shape[0] != shape[1] or not shape[0]:
        raise ValueError(f"the matrix must be square; it has shape {shape}")
    rows, columns = np.tril_indices(shape[0])
    free = np.flatnonzero(domain.high > domain.low)
    inputs = free.tolist()

    def entries(z):
        full = matrix(z)
        return ((full + full.T) / 2)[rows, columns]

    value = lower(entries, z)
    return _Task(value, expand(value, inputs, 1), expand(value, inputs, 2), shape[0], free, domain.high - domain.low)


def _full(entries: np.ndarray, n: int) -> np.ndarray:
    """Symmetric matrices (..., n, n) from their entries below the diagonal (..., K)."""
    rows, columns = np.tril_indices(n)
    full = np.empty((*entries.shape[:-1], n, n))
    full[..., rows, columns] = entries
    full[..., columns, rows] = entries
    return full


def _enclosed(task: _Task, low: np.ndarray, high: np.ndarray) -> _Enclosed:
    centre = _middle(low, high)
    at = enclose(task.first, centre, centre)
    on = enclose(task.second, low, high)
    boxes, f, k = len(low), len(task.free), task.size * (task.size + 1) // 2
    half = np.maximum(high - centre, centre - low)[:, task.free] * (1 + ROUND)
    size = np.maximum(np.abs(on.low), np.abs(on.high))
    slopes = np.maximum(np.abs(at.low), np.abs(at.high))[:, k:].reshape(boxes, f, k)
    here = _shares(slopes, size[:, k + f * k :], half)
    anywhere = size[:, k : k + f * k].reshape(boxes, f, k) * half[:, :, None]
    # A form with derivatives holds where these exist everywhere in the box. One that is not a number says nothing, and
    # the other enclosures may still be numbers.
    shares = np.where(on.smooth[:, None, None], np.fmin(here, anywhere), np.inf)
    spread = [np.where(on.smooth[:, None], form.sum(axis=1) * (1 + ROUND), np.inf) for form in (here, anywhere)]
    radius = np.fmin(*spread)
    lower_bound = np.fmax(_outward(at.low[:, :k] - radius, -1), on.low[:, :k])
    upper_bound = np.fmin(_outward(at.high[:, :k] + radius, 1), on.high[:, :k])
    with np.errstate(invalid="ignore"):  # bounds of both signs that are infinite have no middle
        middle = _middle(lower_bound, upper_bound)
        radius = np.maximum(upper_bound - middle, middle - lower_bound) * (1 + ROUND) + TINY
    n = task.size
    return _Enclosed(_full(middle, n), _full(radius, n), _full(shares, n), on.smooth)


def _shares(slopes: np.ndarray, bend: np.ndarray, half: np.ndarray) -> np.ndarray:
    """What each variable adds (B, f, K) to a change over ± half (B, f), by slopes (B, f, K) and second derivatives."""
    boxes, f, k = slopes.shape
    found = slopes * half[:, :, None]
    bend = bend.reshape(boxes, -1, k)
    for number, (i, j) in enumerate(pairs(f)):
        part = bend[:, number] * (half[:, i] * half[:, j] / 2)[:, None]
        found[:, i] += part
        if i != j:
            found[:, j] += part
    return found


def _outward(x: np.ndarray, sign: int) -> np.ndarray:
    return x + sign * (np.abs(x) * ROUND + TINY)


def _factors(middle: np.ndarray) -> tuple[np.ndarray, Bool[np.ndarray, "B"]]:
    """C (B, n, n) with `Cᵀ middle C` near the identity, whatever the units of the entries; and whether there is one."""
    n = middle.shape[1]
    diagonal = np.abs(np.diagonal(middle, axis1=1, axis2=2))
    units = 1 / np.sqrt(np.where(np.isfinite(diagonal) & (diagonal > TINY), diagonal, 1.0))
    with np.errstate(all="ignore"):
        scaled = middle * units[:, :, None] * units[:, None, :]
    finite = np.asarray(np.isfinite(scaled).all(axis=(1, 2)))
    values, vectors = np.linalg.eigh(np.where(finite[:, None, None], scaled, np.eye(n)))
    sizes = np.maximum(np.abs(values), np.abs(values).max(axis=1, keepdims=True) * 1e-12 + TINY)
    return units[:, :, None] * vectors / np.sqrt(sizes)[:, None, :], finite & (values[:, 0] > 0)


def definite(middle: np.ndarray, radius: np.ndarray) -> tuple[Bool[np.ndarray, "B"], np.ndarray]:
    """Are all symmetric matrices within `middle ± radius` (B, n, n) positive definite? Also the factors C used."""
    c, positive = _factors(middle)
    ct, n = np.swapaxes(c, 1, 2), middle.shape[1]
    with np.errstate(all="ignore"):
        error = np.abs(np.eye(n) - ct @ middle @ c)
        size = np.abs(ct) @ (radius + ROUND * np.abs(middle)) @ np.abs(c)
        e = (error + size) * (1 + ROUND) + ROUND
        x = np.ones((len(e), n, 1))
        for _ in range(4):
            x = e @ x + 1e-6
            x = x / x.max(axis=1, keepdims=True)
        below = (e @ x * (1 + ROUND) + TINY <= (1 - SLACK) * x).all(axis=(1, 2))
    return below & positive, c


def indefinite(middle: np.ndarray, radius: np.ndarray) -> Bool[np.ndarray, "B"]:
    """Is no symmetric matrix within `middle ± radius` (B, n, n) positive definite? Some x with xᵀSx < 0 shows it."""
    finite = np.asarray((np.isfinite(middle) & np.isfinite(radius)).all(axis=(1, 2)))
    safe = np.where(finite[:, None, None], middle, 0.0)
    x = np.linalg.eigh(safe)[1][:, :, :1]
    xt = np.swapaxes(x, 1, 2)
    with np.errstate(all="ignore"):
        most = xt @ safe @ x + np.abs(xt) @ (radius + ROUND * np.abs(safe)) @ np.abs(x) * (1 + ROUND) + TINY
    return finite & (most[:, 0, 0] < 0)


def _look_around(task: _Task, domain: Box, count: int = 4096) -> np.ndarray | None:
    """A point of the domain, as a box (2, d), at which the matrix is seen not to be positive definite."""
    rng = np.random.default_rng(0)
    inside = rng.uniform(size=(count, len(domain.low)))
    inside[::2] = np.round(inside[::2])  # corners, where the worst often is
    points = np.clip(domain.low + inside * (domain.high - domain.low), domain.low, domain.high)
    return _counterexample(task, points)


def _counterexample(task: _Task, points: np.ndarray) -> np.ndarray | None:
    at = enclose(task.value, points, points)
    middle = _middle(at.low, at.high)
    radius = np.maximum(at.high - middle, middle - at.low) * (1 + ROUND) + TINY
    wrong = np.flatnonzero(indefinite(_full(middle, task.size), _full(radius, task.size)))
    return np.stack([points[wrong[0]]] * 2) if len(wrong) else None


def _judge(task: _Task, low: np.ndarray, high: np.ndarray) -> tuple[Int[np.ndarray, "B"], np.ndarray | None]:
    """The code of each box: proved, the variable to halve, or open where it cannot be halved; a counter-example."""
    enclosed = _enclosed(task, low, high)
    proved, c = definite(enclosed.middle, enclosed.radius)
    codes = np.full(len(low), PROVED)
    rest = np.flatnonzero(~proved)
    if not len(rest):
        return codes, None
    wrong = _counterexample(task, _middle(low[rest], high[rest]))
    if wrong is not None:
        return codes, wrong
    weight = _weight(c[rest], enclosed.shares[rest])
    blind = np.flatnonzero(~(np.isfinite(weight).all(axis=1) & enclosed.smooth[rest]))
    if len(blind):
        weight[blind] = _weight_at_centre(task, low[rest][blind], high[rest][blind])
    relative = ((high - low)[rest] / np.where(task.width > 0, task.width, 1.0))[:, task.free]
    lost = ~np.isfinite(weight).all(axis=1)
    weight[lost] = relative[lost]
    # Where every variable seems harmless, or cannot be halved any more, the widest one is.
    middle = _middle(low[rest], high[rest])[:, task.free]
    possible = (middle > low[rest][:, task.free]) & (middle < high[rest][:, task.free])
    weight = np.where(possible, weight + 1e-9 * relative * weight.max(axis=1, keepdims=True, initial=0.0), -1.0)
    codes[rest] = np.where(possible.any(axis=1), task.free[weight.argmax(axis=1)] if len(task.free) else OPEN, OPEN)
    return codes, None


def _weight(c: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """How much each variable (B, f) widens the enclosures, seen where the matrix is near the identity."""
    size = np.abs(c)[:, None]
    with np.errstate(all="ignore"):
        return (np.swapaxes(size, 2, 3) @ shares @ size).sum(axis=(2, 3))


def _weight_at_centre(task: _Task, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The same from derivatives at the centre alone, for boxes over which nothing is bounded."""
    centre = _middle(low, high)
    at = enclose(task.second, centre, centre)
    f, k = len(task.free), task.size * (task.size + 1) // 2
    size = np.maximum(np.abs(at.low), np.abs(at.high))
    half = (high - low)[:, task.free] / 2
    shares = _shares(size[:, k : k + f * k].reshape(len(low), f, k), size[:, k + f * k :], half)
    return _weight(_factors(_full(_middle(at.low, at.high)[:, :k], task.size))[0], _full(shares, task.size))


class _Tree:
    """Boxes by number: what became of each, and its children."""

    def __init__(self, domain: Box):
        self.domain = domain
        self.code = np.full(1, OPEN)
        self.child = np.zeros(1, int)
        self.count, self.evaluated, self.decided = 1, 0, 0.0
        self.waiting: list[tuple[np.ndarray, ...]] = [
            (np.zeros(1, int), domain.low[None], domain.high[None], np.zeros(1, int))
        ]

    def next(self) -> tuple | None:
        """Some boxes to evaluate: numbers, low, high and depths; small lots are put together."""
        if not self.waiting:
            return None
        lots, count = [], 0
        while self.waiting and count < CHUNK:
            lots.append(self.waiting.pop())
            count += len(lots[-1][0])
        whole = tuple(np.concatenate(part) for part in zip(*lots, strict=True))
        if count > CHUNK:
            self.waiting.append(tuple(part[CHUNK:] for part in whole))
        return tuple(part[:CHUNK] for part in whole)

    def take(self, lot: tuple, codes: Int[np.ndarray, "B"]) -> None:
        """Enter what became of a lot."""
        numbers, low, high, depth = lot
        self.evaluated += len(numbers)
        self.decided += float((2.0 ** -depth[codes == PROVED]).sum())
        split = codes >= 0
        new = 2 * int(split.sum())
        first = self.count
        self.count += new
        while self.count > len(self.code):
            self.code = np.concatenate([self.code, np.full(len(self.code), OPEN)])
            self.child = np.concatenate([self.child, np.zeros(len(self.child), int)])
        self.code[numbers] = codes
        self.child[numbers[split]] = np.arange(first, first + new, 2)
        if new:
            children = halves(low[split], high[split], codes[split])
            self.waiting.append((np.arange(first, first + new), *children, np.repeat(depth[split] + 1, 2)))

    def levels(self) -> tuple[list[np.ndarray], Float[np.ndarray, "k 2 d"]]:
        """The tree, and its open boxes."""
        found, numbers = [], np.zeros(1, int)
        while len(numbers):
            found.append(self.code[numbers])
            split = numbers[self.code[numbers] >= 0]
            numbers = (self.child[split][:, None] + np.arange(2)).ravel()
        remaining = [np.stack([low, high], 1)[codes == OPEN] for codes, low, high in leaves(self.domain, found)]
        return found, np.concatenate(remaining)


_TASK: _Task | None = None
"""The task of a worker process."""


def _take(task: _Task) -> None:
    global _TASK
    _TASK = task


def _judge_here(low: np.ndarray, high: np.ndarray) -> tuple[Int[np.ndarray, "B"], np.ndarray | None]:
    assert _TASK is not None
    return _judge(_TASK, low, high)


def _search(task: _Task, tree: _Tree, until: float, progress) -> np.ndarray | None:
    """Evaluate boxes until none is left, the time is over or a counter-example is found."""
    while time.monotonic() < until and (lot := tree.next()) is not None:
        codes, wrong = _judge(task, lot[1], lot[2])
        if wrong is not None:
            return wrong
        tree.take(lot, codes)
        if progress is not None:
            progress(tree.decided, tree.evaluated)
    return None


def _share_out(pool, tree: _Tree, most: int, until: float, progress) -> np.ndarray | None:
    """The same by worker processes, with `most` lots under way."""
    running: dict = {}
    while True:
        while len(running) < most and time.monotonic() < until and (lot := tree.next()) is not None:
            running[pool.submit(_judge_here, lot[1], lot[2])] = lot
        if not running:
            return None
        done, _ = concurrent.futures.wait(running, return_when=concurrent.futures.FIRST_COMPLETED)
        for future in done:
            codes, wrong = future.result()
            if wrong is not None:
                pool.shutdown(cancel_futures=True)
                return wrong
            tree.take(running.pop(future), codes)
        if progress is not None:
            progress(tree.decided, tree.evaluated)
