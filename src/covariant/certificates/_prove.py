"""Is a matrix positive definite everywhere in a box? Proved by branch and bound in outward-rounded arithmetic.

On each box the entries are enclosed by natural interval evaluation, by the mean-value form around the centre,
`S(z) ∈ S(c) + S'(box) (z − c)`, and by Taylor's, `S(z) ∈ S(c) + S'(c) (z − c) + ½ S''(box) (z − c)²`, which needs boxes
some ten times fewer a variable. The enclosing interval matrix is brought near the identity by a congruence with
floating-point factors, `I − CᵀSC = E`, and is positive definite where the spectral radius of |E| is below one, by
Collatz & Wielandt: `|E| x < x` for some positive x, whose rounding is bounded in turn. The terms of Taylor's form are
brought there as matrices, each with its signs; where there is no such form, at kinks, the tightest bounds of the
entries are taken. Boxes for which that fails are halved across the variable that widens the enclosure most.

A matrix whose making is not defined somewhere, or jumps, is not proved: the conditions are halved over until they hold.

Effort is counted in boxes, so that a verdict does not depend on the machine, nor on what else it does.

Source: Neumaier 1990, Interval Methods for Systems of Equations, section 2.3; Rump 2010, Verification methods, Acta
Numerica 19, section 10.8.
"""

import concurrent.futures
import functools
import itertools
import math
import multiprocessing
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from covariant.certificates._form import Formed, as_form
from covariant.lowering import Conditions, Enclosure, Graph, Lowered, enclose, expand, fulfilled, graft, pairs

SLACK = 1e-3
"""By how much |E| x must stay below x, so that another implementation of the test agrees on every box."""
ROUND = 1e-12
"""A bound of the relative rounding of a sum of a few hundred terms, with room to spare."""
TINY = 1e-290
"""More than all underflows of such a sum together."""
CHUNK = 2048
"""Boxes evaluated at once: their intermediate values stay in the cache."""

PATIENCE = 4 * CHUNK
"""Boxes of work alone before it is shared out over processes."""
ROUND_OF_LOTS = 4
"""Lots of boxes that are evaluated before any of them is halved further, whoever does it."""
MOST_BOXES = 200_000
"""Boxes that a proof may take unless told otherwise."""
MOST_CONDITIONS, DEEPEST = 4096, 40
"""Boxes, and halvings of one, over which conditions may be decided: what is true mostly is so after three."""
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
    - `reason`: where the matrix may not be defined, or jumps, which alone leaves everything undecided.
    """

    verdict: Literal["holds", "fails", "undecided"]
    box: Box
    levels: list[np.ndarray]
    counterexample: Float[np.ndarray, "2 d"] | None
    open: Float[np.ndarray, "k 2 d"]
    boxes: int
    seconds: float
    reason: str = ""


def prove(
    matrix: Callable[[Array], Array],
    domain: Box,
    *,
    boxes: int = MOST_BOXES,
    seconds: float | None = None,
    processes: int = 1,
    progress: Callable[[float, int], None] | None = None,
) -> Proof:
    """Is `matrix`: `z (d,) -> (n, n)`, a symmetric JAX function or a form, positive definite for every z in the domain?

    Everything that the function computes must be defined and without jumps there, as well; kinks may be. Stops after
    that many `boxes`, a few more or less, then "undecided"; after `seconds` too, where given, counted from when the
    matrix has been written as a graph. `processes` above 1 shares the boxes out (a script that asks for it needs
    the `if __name__ == "__main__"` guard); the tree found does not depend on it. `progress` is told the share of the
    domain that is decided and the number of boxes evaluated, now and then.

    Raises `LoweringError` where the matrix has no graph of scalars, `ValueError` where it is not square.
    """
    check_box(domain)
    formed = as_form(matrix).graph(jnp.asarray(domain.low))
    task = _task(formed.entries, domain)
    return _decide(task, domain, _Effort.of(boxes, seconds), processes, progress, _reason(formed, domain))


def prove_at_corners(
    matrix: Callable[[Array], Array],
    domain: Box,
    affine: Sequence[str],
    *,
    boxes: int = MOST_BOXES,
    seconds: float | None = None,
    progress: Callable[[float, int], None] | None = None,
) -> list[Proof]:
    """The same where the matrix is affine in some of the variables, taken together: one proof for each corner of them.

    The smallest eigenvalue is then a concave function of those variables, least at a corner of their box; so they need
    not be halved, and 2^k proofs over the others take the place of one over all. Stops at the first that does not hold.
    `boxes` and `seconds` are for all of them.

    Raises `ValueError` where the matrix is not affine in them, as its second derivatives show, or one is not known.
    """
    check_box(domain)
    unknown = set(affine) - set(domain.names)
    if unknown:
        raise ValueError(f"prove_at_corners: no variable {sorted(unknown)[0]!r}; the box has {', '.join(domain.names)}")
    formed = as_form(matrix).graph(jnp.asarray(domain.low))
    kept = np.array([domain.names.index(name) for name in affine], int)
    bent = expand(formed.entries, kept.tolist(), 2)
    entries = np.array([not bent.graph.is_zero(i) for i in bent.outputs]).reshape(-1, len(formed.entries.outputs))
    moves = [bool(row.any()) for row in entries]
    if any(moves[1 + len(kept) :]):
        raise ValueError(f"prove_at_corners: the matrix is not affine in {', '.join(affine)} together")
    ends = [(domain.low[i], domain.high[i])[: 1 + enters] for i, enters in zip(kept, moves[1:], strict=False)]
    # The conditions are no affine functions: they are asked for over the whole domain.
    reason, effort = _reason(formed, domain), _Effort.of(boxes, seconds)
    task, found = None, []
    for corner in itertools.product(*ends):
        low, high = domain.low.copy(), domain.high.copy()
        low[kept] = high[kept] = corner
        at = domain._replace(low=low, high=high)
        task = _task(formed.entries, at) if task is None else task
        found.append(_decide(task, at, effort, 1, progress, reason))
        effort = effort._replace(boxes=max(effort.boxes - found[-1].boxes, 0))
        if found[-1].verdict != "holds":
            break
    return found


class _Effort(NamedTuple):
    """Boxes that may be evaluated, and the instant [s] at which the work began and has to end."""

    boxes: int
    start: float
    until: float

    @classmethod
    def of(cls, boxes: int, seconds: float | None) -> "_Effort":
        now = time.monotonic()
        return cls(boxes, now, now + (math.inf if seconds is None else seconds))


def _decide(task: "_Task", domain: Box, effort: _Effort, processes: int, progress, reason: str) -> Proof:
    def proof(verdict, levels, wrong, remaining, count) -> Proof:
        return Proof(verdict, domain, levels, wrong, remaining, count, time.monotonic() - effort.start, reason)

    leaf, none = [np.array([OPEN])], np.zeros((0, 2, len(domain.low)))
    wrong = _look_around(task, domain)
    if wrong is not None:
        return proof("fails", leaf, wrong, none, 1)
    if reason:
        return proof("undecided", leaf, None, np.stack([domain.low, domain.high])[None], 1)
    tree = _Tree(domain)
    # Most proofs are over before worker processes have started.
    alone = effort if processes == 1 else effort._replace(boxes=min(effort.boxes, PATIENCE))
    wrong = _search(functools.partial(map, functools.partial(_judge, task)), tree, alone, progress)
    if processes > 1 and wrong is None and tree.waiting and tree.evaluated < effort.boxes:
        context = multiprocessing.get_context("spawn")
        with concurrent.futures.ProcessPoolExecutor(processes, context, initializer=_take, initargs=(task,)) as pool:
            wrong = _search(functools.partial(pool.map, _judge_here), tree, effort, progress)
    levels, remaining = tree.levels()
    verdict = "fails" if wrong is not None else "undecided" if len(remaining) else "holds"
    return proof(verdict, levels, wrong, remaining, tree.evaluated)


def _reason(formed: Formed, domain: Box) -> str:
    """Why conditions are not shown to hold over the domain; nothing where they are."""
    pins = formed.pins
    names, units = (*domain.names, *("",) * len(pins)), (*domain.units, *("",) * len(pins))
    low, high = (np.concatenate([ends, pins]) for ends in (domain.low, domain.high))
    return show_conditions(formed.conditions, Box(names, units, low, high))


def show_conditions(conditions: Conditions, domain: Box) -> str:
    """Show by halving that all conditions hold over a domain: nothing, or which one is open, and where.

    Once a condition holds on a box it does on its parts.
    """
    count, width = len(conditions.conditions), domain.high - domain.low
    low, high, owed = domain.low[None], domain.high[None], np.ones((1, count), bool)
    if not count:
        return ""
    reads = _reads(conditions)
    for depth in itertools.count():
        owed &= ~fulfilled(conditions, low, high)
        left = owed.any(axis=1)
        if not left.any():
            return ""
        low, high, owed = low[left], high[left], owed[left]
        relative = (high - low) / np.where(width > 0, width, 1.0) * (owed @ reads > 0)
        middle = _middle(low, high)
        relative = np.where((middle > low) & (middle < high), relative, 0.0)
        stuck = np.flatnonzero(relative.max(axis=1) <= 0)
        if len(stuck) or depth >= DEEPEST or 2 * len(low) > MOST_CONDITIONS:
            k = int(stuck[0]) if len(stuck) else 0
            condition = conditions.conditions[int(owed[k].argmax())]
            where = [i for i in np.flatnonzero(reads[owed[k].argmax()]) if domain.names[i]]
            place = ", ".join(f"{domain.names[i]} is {low[k, i]:.6g} to {high[k, i]:.6g}" for i in where)
            what = "is not shown to be defined" if condition.kind == "true" else "may jump"
            return f"{condition.because} {what}" + (f" where {place}" if place else "")
        axes = relative.argmax(axis=1)
        low, high = halves(low, high, axes)
        owed = np.repeat(owed, 2, axis=0)
    raise AssertionError


def _reads(conditions: Conditions) -> np.ndarray:
    """Which inputs each condition depends on: (conditions, inputs)."""
    nodes = conditions.graph.nodes
    read = np.zeros((len(nodes), conditions.inputs), bool)
    for i, node in enumerate(nodes):
        if node.op == "input":
            read[i, int(node.value or 0)] = True
        for a in node.arguments:
            read[i] |= read[a]
    return read[[c.node for c in conditions.conditions]].astype(float)


def blocks(matrix: Callable[[Array], Array], domain: Box) -> list[Int[np.ndarray, "k"]]:
    """Indices of the diagonal blocks that a symmetric `z -> (n, n)` falls into, after a permutation, for every z.

    A matrix is positive definite where each of them is, and each depends on fewer variables. Entries count as zero
    where their graph is the constant 0.
    """
    formed = as_form(matrix).then(lambda m: m + m.T).graph(jnp.asarray(domain.low))
    nodes = formed.entries.nodes()
    reached = ~np.vectorize(formed.entries.graph.is_zero, otypes=[bool])(nodes) | np.eye(len(nodes), dtype=bool)
    for _ in range(len(nodes).bit_length()):
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
    """Symmetric matrices (n, n) on boxes, in two ways.

    - `centre + Σ wₘ terms[m]` within `rest`, |wₘ| ≤ 1, terms (B, f + p, n, n): Taylor's form, one term for each free
      variable and one for each pair of them. `rest` is infinite where the matrix is not `smooth`.
    - `middle` within `radius` (B, n, n): bounds of the entries alone.
    - `shares` (B, f + p, n, n): how much of `rest` each variable, or pair, brings.
    """

    centre: np.ndarray
    terms: np.ndarray
    rest: np.ndarray
    middle: np.ndarray
    radius: np.ndarray
    shares: np.ndarray
    smooth: Bool[np.ndarray, "B"]


def _task(entries: Lowered, domain: Box) -> _Task:
    shape = entries.results[0].shape
    if len(shape) != 2 or shape[0] != shape[1] or not shape[0]:
        raise ValueError(f"the matrix must be square; it has shape {shape}")
    rows, columns = np.tril_indices(shape[0])
    free = np.flatnonzero(domain.high > domain.low)
    graph = Graph.of(entries.graph.nodes)
    lower = graft(graph, lambda full: ((full + full.T) / 2)[rows, columns], entries.nodes())
    value = entries._replace(outputs=tuple(lower.tolist()))._replace(graph=graph)
    first, second = (expand(value, free.tolist(), order) for order in (1, 2))
    small, outputs = graph.pruned(value.outputs)
    value = value._replace(graph=small, outputs=tuple(outputs))
    return _Task(value, first, second, shape[0], free, domain.high - domain.low)


def _full(entries: np.ndarray, n: int) -> np.ndarray:
    """Symmetric matrices (..., n, n) from their entries below the diagonal (..., K)."""
    rows, columns = np.tril_indices(n)
    full = np.empty((*entries.shape[:-1], n, n))
    full[..., rows, columns] = entries
    full[..., columns, rows] = entries
    return full


def _enclosed(task: _Task, low: np.ndarray, high: np.ndarray) -> _Enclosed:
    centre = _middle(low, high)
    at, on = enclose(task.first, centre, centre), enclose(task.second, low, high)
    k, f = task.size * (task.size + 1) // 2, len(task.free)
    half = np.maximum(high - centre, centre - low)[:, task.free] * (1 + ROUND)
    smooth = on.smooth[:, None]
    with np.errstate(invalid="ignore", over="ignore"):  # infinite bounds of both signs have no middle
        value, slopes, terms, shares = _taylor_form(at, on, half, k)
        # A form with derivatives holds where these exist everywhere in the box.
        rest = np.where(smooth, (value.radius + shares.sum(axis=1)) * (1 + ROUND) + TINY, np.inf)
        size = np.maximum(np.abs(on.low), np.abs(on.high))[:, k : k + f * k].reshape(slopes.middle.shape)
        radius = rest + np.abs(terms).sum(axis=1) * (1 + ROUND)
        lower_bound = np.fmax(_outward(value.middle - radius, -1), on.low[:, :k])
        upper_bound = np.fmin(_outward(value.middle + radius, 1), on.high[:, :k])
        # The mean-value form is about the value at the centre, before Taylor's form moved it.
        here = _Ball.of(at.low[:, :k], at.high[:, :k])
        spread = np.where(smooth, here.radius + (size * half[:, :, None]).sum(axis=1) * (1 + ROUND), np.inf)
        lower_bound = np.fmax(lower_bound, _outward(here.middle - spread, -1))
        upper_bound = np.fmin(upper_bound, _outward(here.middle + spread, 1))
        middle = _middle(lower_bound, upper_bound)
        radius = np.maximum(upper_bound - middle, middle - lower_bound) * (1 + ROUND) + TINY
    parts = (value.middle, terms, rest, middle, radius, shares)
    full = [_full(part, task.size) for part in parts]
    return _Enclosed(*full, smooth=on.smooth)


class _Ball(NamedTuple):
    """Numbers within `radius` of `middle`."""

    middle: np.ndarray
    radius: np.ndarray

    @classmethod
    def of(cls, low: np.ndarray, high: np.ndarray) -> "_Ball":
        middle = _middle(low, high)
        return cls(middle, np.maximum(high - middle, middle - low) * (1 + ROUND) + TINY)


def _taylor_form(at: Enclosure, on: Enclosure, half: np.ndarray, k: int) -> tuple[_Ball, _Ball, np.ndarray, np.ndarray]:
    """`S(c) + Σ Sᵢ(c) δᵢ + ½ Σ Sᵢⱼ δᵢδⱼ` over δ within ± half (B, f): the value at the centre, its slopes, all terms.

    As δᵢ² is nowhere negative, half of what it can add moves the value, and is out by no more than the other half.
    """
    boxes, f = half.shape
    value, slopes = _Ball.of(at.low[:, :k], at.high[:, :k]), _Ball.of(at.low[:, k:], at.high[:, k:])
    slopes = _Ball(*(part.reshape(boxes, f, k) for part in slopes))
    bends = _Ball(*(part.reshape(boxes, -1, k) for part in _Ball.of(on.low[:, k + f * k :], on.high[:, k + f * k :])))
    chosen = pairs(f)
    size = np.stack([half[:, i] * half[:, j] / (2 if i == j else 1) for i, j in chosen], axis=1)[:, :, None]
    square = np.array([i == j for i, j in chosen])[:, None]
    bent = bends.middle * size * np.where(square, 0.5, 1.0)
    moved = value.middle + np.where(square, bent, 0.0).sum(axis=1)
    rounding = ROUND * (np.abs(value.middle) + np.abs(bent).sum(axis=1))
    terms = np.concatenate([slopes.middle * half[:, :, None], bent], axis=1)
    shares = np.concatenate([slopes.radius * half[:, :, None], bends.radius * size * (1 + ROUND)], axis=1)
    return _Ball(moved, value.radius + rounding), slopes, terms, shares


def _outward(x: np.ndarray, sign: int) -> np.ndarray:
    return x + sign * (np.abs(x) * ROUND + TINY)


def _factors(middle: np.ndarray) -> tuple[np.ndarray, Bool[np.ndarray, "B"]]:
    """C (B, n, n) with `Cᵀ middle C` near the identity, whatever the units of the entries; and whether there is one.

    Of all such factors the inverse root: it turns no more than it must, and a sum of absolute values grows by turning.
    """
    n = middle.shape[1]
    diagonal = np.abs(np.diagonal(middle, axis1=1, axis2=2))
    units = 1 / np.sqrt(np.where(np.isfinite(diagonal) & (diagonal > TINY), diagonal, 1.0))
    with np.errstate(all="ignore"):
        scaled = middle * units[:, :, None] * units[:, None, :]
    finite = np.asarray(np.isfinite(scaled).all(axis=(1, 2)))
    values, vectors = np.linalg.eigh(np.where(finite[:, None, None], scaled, np.eye(n)))
    sizes = np.maximum(np.abs(values), np.abs(values).max(axis=1, keepdims=True) * 1e-12 + TINY)
    root = (vectors / np.sqrt(sizes)[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    return units[:, :, None] * root, finite & (values[:, 0] > 0)


def definite(
    middle: np.ndarray, radius: np.ndarray, terms: np.ndarray | None = None
) -> tuple[Bool[np.ndarray, "B"], np.ndarray]:
    """Are all symmetric matrices within `middle ± radius` (B, n, n) positive definite? Also the factors C used.

    With `terms` (B, m, n, n) all those within `middle + Σ wₘ terms[m] ± radius`, |wₘ| ≤ 1.
    """
    c, positive = _factors(middle)
    ct, n = np.swapaxes(c, 1, 2), middle.shape[1]
    terms = np.zeros((len(middle), 0, n, n)) if terms is None else terms
    with np.errstate(all="ignore"):
        error = np.abs(np.eye(n) - ct @ middle @ c) + np.abs(ct[:, None] @ terms @ c[:, None]).sum(axis=1)
        rounded = ROUND * (np.abs(middle) + np.abs(terms).sum(axis=1))
        size = np.abs(ct) @ (radius + rounded) @ np.abs(c)
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
    proved, c = definite(enclosed.centre, enclosed.rest, enclosed.terms)
    rest = np.flatnonzero(~proved)
    proved[rest] = definite(enclosed.middle[rest], enclosed.radius[rest])[0]
    codes = np.full(len(low), PROVED)
    rest = np.flatnonzero(~proved)
    if not len(rest):
        return codes, None
    wrong = _counterexample(task, _middle(low[rest], high[rest]))
    if wrong is not None:
        return codes, wrong
    weight = _weight(c[rest], enclosed.terms[rest], enclosed.shares[rest], len(task.free))
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


def _weight(c: np.ndarray, terms: np.ndarray, shares: np.ndarray, f: int) -> np.ndarray:
    """How much each variable (B, f) widens the enclosures, seen where the matrix is near the identity.

    What a pair brings counts for both of its variables.
    """
    c, size = c[:, None], np.abs(c)[:, None]
    with np.errstate(all="ignore"):
        seen = np.abs(np.swapaxes(c, 2, 3) @ terms @ c) + np.swapaxes(size, 2, 3) @ shares @ size
    parts = seen.sum(axis=(2, 3))
    weight = parts[:, :f].copy()
    for number, (i, j) in enumerate(pairs(f), start=f):
        weight[:, i] += parts[:, number]
        if i != j:
            weight[:, j] += parts[:, number]
    return weight


def _weight_at_centre(task: _Task, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The same from derivatives at the centre alone, for boxes over which nothing is bounded."""
    centre = _middle(low, high)
    at, k = enclose(task.second, centre, centre), task.size * (task.size + 1) // 2
    count = k + len(task.free) * k
    near = Enclosure(at.low[:, :count], at.high[:, :count], at.smooth)
    value, _, terms, shares = _taylor_form(near, at, (high - low)[:, task.free] / 2, k)
    factors = _factors(_full(value.middle, task.size))[0]
    return _weight(factors, _full(terms, task.size), _full(shares, task.size), len(task.free))


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


def _search(judge: Callable, tree: _Tree, effort: _Effort, progress) -> np.ndarray | None:
    """Evaluate boxes until none is left, the effort is spent or a counter-example is found.

    `judge` maps boxes (low, high) to what became of them, here or in other processes.
    """
    while tree.evaluated < effort.boxes and time.monotonic() < effort.until:
        lots = [lot for _ in range(ROUND_OF_LOTS) if (lot := tree.next()) is not None]
        if not lots:
            return None
        for lot, (codes, wrong) in zip(lots, judge(*zip(*(lot[1:3] for lot in lots), strict=True)), strict=True):
            if wrong is not None:
                return wrong
            tree.take(lot, codes)
        if progress is not None:
            progress(tree.decided, tree.evaluated)
    return None
