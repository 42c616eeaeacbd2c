"""Is a matrix positive definite everywhere in a box? Proved by branch and bound in outward-rounded arithmetic.

The matrix is enclosed on a box, and the enclosure tested for being positive definite; boxes for which that fails are
halved. A matrix whose making is not defined somewhere, or jumps, is not proved: the conditions are halved over until
they hold.

Effort is counted in boxes, so that a verdict does not depend on the machine, nor on what else it does.
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

from covariant.lowering import expand
from covariant.proofs._box import Box, check_box
from covariant.proofs._conditions import show_conditions
from covariant.proofs._enclosure import Expansions
from covariant.proofs._form import Formed, as_form
from covariant.proofs._judge import judge, look_around
from covariant.proofs._tree import CHUNK, OPEN, Tree, open_boxes

PATIENCE = 4 * CHUNK
"""Boxes of work alone before it is shared out over processes."""
ROUND_OF_LOTS = 4
"""Lots of boxes that are evaluated before any of them is halved further, whoever does it."""
MOST_BOXES = 200_000
"""Boxes that a proof may take unless told otherwise."""


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

    @classmethod
    def stated(cls, domain: Box, levels: list[np.ndarray]) -> "Proof":
        """What a tree says that was read from a file; how long it took is not known (NaN).

        Raises `ValueError` where the levels are not a tree over the domain.
        """
        left = [np.zeros((0, 2, len(domain.low)))]
        if any((codes == OPEN).any() for codes in levels):
            left.append(open_boxes(domain, levels))
        verdict = "undecided" if len(left) > 1 else "holds"
        return cls(verdict, domain, levels, None, np.concatenate(left), sum(map(len, levels)), math.nan)

    @property
    def open_share(self) -> float:
        """The share of the domain that no box proves."""
        return float(sum((codes == OPEN).sum() * 0.5**depth for depth, codes in enumerate(self.levels)))


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
    expansions = Expansions.of(formed.entries, domain)
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
    expansions, found = None, []
    for corner in itertools.product(*ends):
        low, high = domain.low.copy(), domain.high.copy()
        low[kept] = high[kept] = corner
        at = domain._replace(low=low, high=high)
        expansions = Expansions.of(formed.entries, at) if expansions is None else expansions
        found.append(_decide(expansions, at, effort, 1, progress, reason))
        effort = effort._replace(boxes=max(effort.boxes - found[-1].boxes, 0))
        if found[-1].verdict != "holds":
            break
    return found


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


class _Effort(NamedTuple):
    """Boxes that may be evaluated, and the instant [s] at which the work began and has to end."""

    boxes: int
    start: float
    until: float

    @classmethod
    def of(cls, boxes: int, seconds: float | None) -> "_Effort":
        now = time.monotonic()
        return cls(boxes, now, now + (math.inf if seconds is None else seconds))


def _decide(matrix: "Expansions", domain: Box, effort: _Effort, processes: int, progress, reason: str) -> Proof:
    def proof(verdict, levels, wrong, remaining, count) -> Proof:
        return Proof(verdict, domain, levels, wrong, remaining, count, time.monotonic() - effort.start, reason)

    leaf, none = [np.array([OPEN])], np.zeros((0, 2, len(domain.low)))
    wrong = look_around(matrix, domain)
    if wrong is not None:
        return proof("fails", leaf, wrong, none, 1)
    if reason:
        return proof("undecided", leaf, None, np.stack([domain.low, domain.high])[None], 1)
    tree = Tree(domain)
    # Most proofs are over before worker processes have started.
    alone = effort if processes == 1 else effort._replace(boxes=min(effort.boxes, PATIENCE))
    wrong = _search(functools.partial(map, functools.partial(judge, matrix)), tree, alone, progress)
    if processes > 1 and wrong is None and tree.waiting and tree.evaluated < effort.boxes:
        context = multiprocessing.get_context("spawn")
        with concurrent.futures.ProcessPoolExecutor(processes, context, initializer=_take, initargs=(matrix,)) as pool:
            wrong = _search(functools.partial(pool.map, _judge_here), tree, effort, progress)
    levels, remaining = tree.levels()
    verdict = "fails" if wrong is not None else "undecided" if len(remaining) else "holds"
    return proof(verdict, levels, wrong, remaining, tree.evaluated)


def _reason(formed: Formed, domain: Box) -> str:
    """Why conditions are not shown to hold over the domain; nothing where they are."""
    return show_conditions(formed.conditions, domain.with_fixed(formed.pins))


_matrix: Expansions | None = None
"""What a worker process judges."""


def _take(matrix: Expansions) -> None:
    global _matrix
    _matrix = matrix


def _judge_here(low: np.ndarray, high: np.ndarray) -> tuple[Int[np.ndarray, "B"], np.ndarray | None]:
    assert _matrix is not None
    return judge(_matrix, low, high)


def _search(judge: Callable, tree: Tree, effort: _Effort, progress) -> np.ndarray | None:
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
