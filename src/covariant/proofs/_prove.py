"""Proof by branch and bound that a matrix is positive definite everywhere in a box, with outward rounding.

The matrix is enclosed on a box, and the enclosure tested for positive definiteness; boxes on which the test fails are
halved. A matrix is not proved where its computation is undefined somewhere or jumps: the conditions for this are shown
first, also by halving.

Effort is counted in boxes, so that a verdict depends neither on the machine nor on its load.
"""

import concurrent.futures
import functools
import itertools
import math
import multiprocessing
import time
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from covariant._typing import Arithmetic
from covariant.lowering import TRUTHS, Lowered, expand
from covariant.proofs._box import Box, check_box
from covariant.proofs._conditions import show_conditions
from covariant.proofs._enclosure import Expansions
from covariant.proofs._form import Formed, as_form
from covariant.proofs._judge import judge, look_around
from covariant.proofs._tree import CHUNK, OPEN, Tree, open_boxes

PATIENCE = 4 * CHUNK
"""Number of boxes that are evaluated by one process before the work is shared out."""
ROUND_OF_LOTS = 4
"""Number of lots of boxes that are evaluated before any of them is halved further, whichever process does it."""
MOST_BOXES = 200_000
"""Default limit of the number of boxes of a proof."""


class Proof(NamedTuple):
    """Result of branch and bound.

    - `verdict`: "holds", "fails" (then `counterexample` is a box in which the matrix is nowhere positive definite) or
      "undecided" (then `open` are the remaining boxes).
    - `box`: the domain.
    - `levels`: the boxes as a binary tree, from the whole box down, with one array of integers for each level: the
      variable across whose middle a box is halved, lower half first; −1 where the matrix is proved positive definite;
      −2 where it is open.
    - `boxes`: number of boxes evaluated; `seconds`: time it took.
    - `reason`: where the matrix may be undefined or jump, which alone leaves everything undecided.
    """

    verdict: Literal["holds", "fails", "undecided"]
    box: Box
    levels: list[np.ndarray]
    counterexample: Float[np.ndarray, "2 d"] | None
    open: Float[np.ndarray, "k 2 d"]
    boxes: int
    seconds: float
    reason: str = ""

    @classmethod
    def stated(cls, domain: Box, levels: list[np.ndarray]) -> "Proof":
        """The proof stated by a tree that was read from a file; the time it took is not known (NaN).

        Raises `ValueError` where the levels are not a tree over the domain.
        """
        left = [np.zeros((0, 2, len(domain.low)))]
        if any((codes == OPEN).any() for codes in levels):
            left.append(open_boxes(domain, levels))
        verdict = "undecided" if len(left) > 1 else "holds"
        return cls(verdict, domain, levels, None, np.concatenate(left), sum(map(len, levels)), math.nan)

    @property
    def open_share(self) -> float:
        """Fraction of the domain in open boxes."""
        return float(sum((codes == OPEN).sum() * 0.5**depth for depth, codes in enumerate(self.levels)))


def prove(
    matrix: Callable[[Array], Array],
    domain: Box,
    *,
    boxes: int = MOST_BOXES,
    seconds: float | None = None,
    processes: int = 1,
    progress: Callable[[float, int], None] | None = None,
    engine: Arithmetic = "auto",
) -> Proof:
    """Prove that a symmetric matrix is positive definite for every z in the domain.

    - `matrix`: `z (d,) -> (n, n)`, a JAX function or a form. Everything that it computes must also be defined and
      without jumps on the domain; kinks are allowed.
    - `boxes`: the proof stops after about this many boxes, with the verdict "undecided".
    - `seconds`: optional limit of time, counted from when the matrix has been written as a graph.
    - `processes`: above 1 they share the boxes (a script then needs the `if __name__ == "__main__"` guard); the tree
      found does not depend on their number.
    - `progress`: called now and then with the decided fraction of the domain and the number of boxes evaluated.
    - `engine`: "numpy" and "c" leave no choice to `lowering.enclose`; tree and verdict are the same.

    Raises `LoweringError` where the matrix has no graph of scalars, `ValueError` where it is not square.
    """
    check_box(domain)
    formed = as_form(matrix).graph(jnp.asarray(domain.low))
    expansions = Expansions.of(formed.entries, domain, engine)
    return _decide(expansions, domain, _Effort.of(boxes, seconds), processes, progress, _reason(formed, domain))


def prove_at_corners(
    matrix: Callable[[Array], Array],
    domain: Box,
    affine: Sequence[str],
    *,
    boxes: int = MOST_BOXES,
    seconds: float | None = None,
    progress: Callable[[float, int], None] | None = None,
) -> list[Proof]:
    """Prove that a matrix is positive definite where it is affine in some variables jointly: one proof for each corner.

    - `affine`: names of these variables.
    - `boxes`, `seconds`: effort of all proofs together; `matrix`, `domain`, `progress`: as for `prove`.

    The smallest eigenvalue is a concave function of these variables, so it is least at a corner of their box. They need
    not be halved: 2^k proofs over the other variables replace one over all. It stops at the first that does not hold.

    Raises `ValueError` where the matrix is not affine in them, as its second derivatives and its kinks show, or a name
    is not known.
    """
    check_box(domain)
    unknown = set(affine) - set(domain.names)
    if unknown:
        raise ValueError(f"prove_at_corners: no variable {sorted(unknown)[0]!r}; the box has {', '.join(domain.names)}")
    formed = as_form(matrix).graph(jnp.asarray(domain.low))
    kept = np.array([domain.names.index(name) for name in affine], int)
    kink = _kink(formed.entries, kept.tolist())
    if kink is not None:
        # Its second derivatives vanish on either side of the kink, so they do not show that it is not affine.
        raise ValueError(f"prove_at_corners: the matrix is not affine in {', '.join(affine)}: it has a kink, by {kink}")
    bent = expand(formed.entries, kept.tolist(), 2)
    entries = np.array([not bent.graph.is_zero(i) for i in bent.outputs]).reshape(-1, len(formed.entries.outputs))
    moves = [bool(row.any()) for row in entries]
    if any(moves[1 + len(kept) :]):
        raise ValueError(f"prove_at_corners: the matrix is not affine in {', '.join(affine)} together")
    ends = [(domain.low[i], domain.high[i])[: 1 + enters] for i, enters in zip(kept, moves[1:], strict=False)]
    # The conditions are not affine: they are proved over the whole domain.
    reason, effort = _reason(formed, domain), _Effort.of(boxes, seconds)
    corners = []
    for corner in itertools.product(*ends):
        low, high = domain.low.copy(), domain.high.copy()
        low[kept] = high[kept] = corner
        corners.append(domain._replace(low=low, high=high))
    expansions = Expansions.of(formed.entries, corners[0])
    if reason:
        return [_decide(expansions, corners[0], effort, 1, progress, reason)]
    failed = []
    for k, at in enumerate(corners):
        wrong = look_around(expansions, at)
        if wrong is not None:
            failed, corners = [_failed_at_once(at, wrong, effort, reason)], corners[:k]
            break
    trees = [Tree(at) for at in corners]
    while (wrong := _search_together(expansions, trees, effort, progress)) is not None:
        at = wrong[0][kept]
        k = next(k for k, tree in enumerate(trees) if np.array_equal(tree.domain.low[kept], at))
        failed, trees = [_concluded(trees[k], effort, reason, wrong)], trees[:k]
    found = [_concluded(tree, effort, reason) for tree in trees] + failed
    holding = next((k for k, proof in enumerate(found) if proof.verdict != "holds"), len(found))
    return found[: holding + 1]


KINKS = {"abs", "sign", "floor", "ceil", "round", "min", "max", "select", "either", "cbrt", *TRUTHS}
"""Operations whose second derivatives, as graphs of them say, vanish on either side of a place where they bend."""


def _kink(entries: Lowered, variables: Sequence[int]) -> str | None:
    """The first operation with a kink that depends on one of the inputs, or None."""
    depends: list[bool] = []
    graph, _ = entries.graph.pruned(entries.outputs)
    for node in graph.nodes:
        moves = node.value in variables if node.op == "input" else any(depends[k] for k in node.arguments)
        if moves and node.op in KINKS:
            return node.op
        depends.append(moves)
    return None


def blocks(matrix: Callable[[Array], Array], domain: Box) -> list[Int[np.ndarray, "k"]]:
    """Indices of the diagonal blocks of a symmetric `z -> (n, n)`, after a permutation, for every z.

    A matrix is positive definite where each block is, and each block depends on fewer variables. An entry counts as
    zero where its graph is the constant 0.
    """
    formed = as_form(matrix).then(lambda m: m + m.T).graph(jnp.asarray(domain.low))
    nodes = formed.entries.nodes()
    reached = ~np.vectorize(formed.entries.graph.is_zero, otypes=[bool])(nodes) | np.eye(len(nodes), dtype=bool)
    for _ in range(len(nodes).bit_length()):
        reached = reached @ reached
    return [np.flatnonzero(row) for row in np.unique(reached, axis=0)]


class _Effort(NamedTuple):
    """Number of boxes that may be evaluated, and the times [s] at which the work began and must end."""

    boxes: int
    start: float
    until: float

    @classmethod
    def of(cls, boxes: int, seconds: float | None) -> "_Effort":
        now = time.monotonic()
        return cls(boxes, now, now + (math.inf if seconds is None else seconds))

    @property
    def spent(self) -> float:
        """Time since the work began [s]."""
        return time.monotonic() - self.start


def _decide(matrix: "Expansions", domain: Box, effort: _Effort, processes: int, progress, reason: str) -> Proof:
    wrong = look_around(matrix, domain)
    if wrong is not None:
        return _failed_at_once(domain, wrong, effort, reason)
    if reason:
        whole = np.stack([domain.low, domain.high])[None]
        return Proof("undecided", domain, [np.array([OPEN])], None, whole, 1, effort.spent, reason)
    tree = Tree(domain)
    # Most proofs are finished before worker processes have started.
    alone = effort if processes == 1 else effort._replace(boxes=min(effort.boxes, PATIENCE))
    wrong = _search(functools.partial(map, functools.partial(judge, matrix)), tree, alone, progress)
    if processes > 1 and wrong is None and tree.waiting and tree.evaluated < effort.boxes:
        context = multiprocessing.get_context("spawn")
        with concurrent.futures.ProcessPoolExecutor(processes, context, initializer=_take, initargs=(matrix,)) as pool:
            wrong = _search(functools.partial(pool.map, _judge_here), tree, effort, progress)
    return _concluded(tree, effort, reason, wrong)


def _failed_at_once(domain: Box, wrong: np.ndarray, effort: _Effort, reason: str) -> Proof:
    none = np.zeros((0, 2, len(domain.low)))
    return Proof("fails", domain, [np.array([OPEN])], wrong, none, 1, effort.spent, reason)


def _concluded(tree: Tree, effort: _Effort, reason: str, wrong: np.ndarray | None = None) -> Proof:
    """What a tree of boxes shows, and the counter-example that was found."""
    levels, remaining = tree.levels()
    verdict = "fails" if wrong is not None else "undecided" if len(remaining) else "holds"
    return Proof(verdict, tree.domain, levels, wrong, remaining, tree.evaluated, effort.spent, reason)


def _reason(formed: Formed, domain: Box) -> str:
    """Why the conditions are not shown to hold over the domain; "" where they are."""
    return show_conditions(formed.conditions, domain.with_fixed(formed.pins))


_matrix: Expansions | None = None
"""The matrix of this worker process."""


def _take(matrix: Expansions) -> None:
    global _matrix
    _matrix = matrix


def _judge_here(low: np.ndarray, high: np.ndarray) -> tuple[Int[np.ndarray, "B"], np.ndarray | None]:
    assert _matrix is not None
    return judge(_matrix, low, high)


def _search(judge: Callable, tree: Tree, effort: _Effort, progress) -> np.ndarray | None:
    """Evaluate boxes until none is left, the effort is used up, or a counter-example is found.

    `judge` maps boxes (low, high) to their codes, in this or in other processes.
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


def _search_together(matrix: Expansions, trees: Sequence[Tree], effort: _Effort, progress) -> np.ndarray | None:
    """As `_search`, for several trees of one matrix: their boxes are evaluated side by side."""
    while sum(tree.evaluated for tree in trees) < effort.boxes and time.monotonic() < effort.until:
        lots = [(tree, lot) for tree in trees if (lot := tree.next()) is not None]
        if not lots:
            return None
        low, high = (np.concatenate([lot[side] for _, lot in lots]) for side in (1, 2))
        codes = []
        for begin in range(0, len(low), CHUNK):
            some, wrong = judge(matrix, low[begin : begin + CHUNK], high[begin : begin + CHUNK])
            if wrong is not None:
                for tree, lot in lots:
                    tree.waiting.append(lot)
                return wrong
            codes.append(some)
        ends = np.cumsum([len(lot[0]) for _, lot in lots])[:-1]
        for (tree, lot), own in zip(lots, np.split(np.concatenate(codes), ends), strict=True):
            tree.take(lot, own)
        if progress is not None:
            progress(float(np.mean([tree.decided for tree in trees])), sum(tree.evaluated for tree in trees))
    return None
