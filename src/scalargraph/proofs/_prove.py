"""Proof by branch and bound that a matrix is positive definite everywhere in a box, with outward rounding.

The matrix is enclosed on a box, and the enclosure is tested for positive definiteness; boxes on which the test fails
are halved. The matrix must also be defined everywhere in the box, without jumps; the conditions for this are shown
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

from scalargraph import Lowered, expand
from scalargraph.errors import InputError
from scalargraph.graph import TRUTHS
from scalargraph.proofs._box import Box, check_box
from scalargraph.proofs._conditions import show_conditions
from scalargraph.proofs._entries import Entries
from scalargraph.proofs._form import Formed, as_form
from scalargraph.proofs._judge import judge, look_around
from scalargraph.proofs._tree import CHUNK, OPEN, Tree, open_boxes

PATIENCE = 4 * CHUNK
"""Number of boxes that one process evaluates before the work is distributed to several."""
ROUND_OF_LOTS = 4
"""Number of lots of boxes that are evaluated before their halves are; it does not depend on the number of processes."""
MOST_BOXES = 200_000
"""Default limit of the number of boxes of a proof."""


class Proof(NamedTuple):
    """Result of branch and bound on one matrix and one box.

    Read `verdict` first. With "fails" the `counterexample` shows where to look, and with "undecided" the boxes in
    `open` show which part of the domain needs more effort or has too small a margin. `reason` names a part of the
    function that may be undefined.

    Attributes:
        verdict: "holds"; "fails", if the matrix is not positive definite at `counterexample`; or "undecided", if the
            boxes `open` remain.
        box: The domain.
        levels: The boxes as a binary tree, from the whole box down: one array of integers for each level. Each integer
            is the index of the variable across whose middle a box is halved (lower half first), −1 (`PROVED`) if the
            matrix is proved positive definite, or −2 (`OPEN`) if that is open.
        counterexample: Corners (2, d) of a box in which the matrix is nowhere positive definite, or None.
        open: Corners (k, 2, d) of the k undecided boxes.
        boxes: Number of boxes evaluated.
        seconds: Time taken [s]; NaN for a proof read from a file.
        reason: Why the matrix may be undefined or jump, which leaves the whole domain undecided; "" if it does not.

    Example:
        >>> import jax.numpy as jnp
        >>> from scalargraph.proofs import box, prove
        >>> proof = prove(lambda z: jnp.array([[2.0 + z[0], 1.0], [1.0, 2.0]]), box(a=(-2.0, 1.0)))
        >>> proof.verdict, proof.counterexample.tolist()
        ('fails', [[-2.0], [-2.0]])
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
        """The proof stated by a tree that was read from a file.

        Args:
            domain: The box of the proof.
            levels: Its tree, as in the field of this name.

        Returns:
            A proof that "holds" if every leaf is proved, else "undecided". Nothing is proved again; its time is NaN.

        Raises:
            ValueError: The levels are not a tree over the domain.
        """
        left = [np.zeros((0, 2, len(domain.low)))]
        if any((codes == OPEN).any() for codes in levels):
            left.append(open_boxes(domain, levels))
        verdict = "undecided" if len(left) > 1 else "holds"
        return cls(verdict, domain, levels, None, np.concatenate(left), sum(map(len, levels)), math.nan)

    @property
    def open_share(self) -> float:
        """Fraction of the volume of the domain that open boxes have, from 0 to 1."""
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
    """Prove that a symmetric matrix is positive definite for every z in a box.

    The proof is by branch and bound in outward-rounded arithmetic. Effort is counted in boxes, so that the verdict
    depends neither on the machine nor on its load, unless `seconds` ends the proof.

    Args:
        matrix: JAX function `z (d,) -> (n, n)`, or a `Form`. All its operations must be defined and without jumps on
            the domain; kinks are allowed.
        domain: Bounds of z.
        boxes: Approximate number of boxes after which the proof stops, with the verdict "undecided".
        seconds: Optional time limit [s], counted from when the matrix has been written as a graph.
        processes: Number of processes that share the boxes. Above 1, a script needs the `if __name__ == "__main__"`
            guard. The tree does not depend on their number.
        progress: Called now and then with the decided fraction of the domain and the number of boxes evaluated.

    Returns:
        The proof with its verdict and its tree of boxes.

    Raises:
        LoweringError: The matrix has no graph of scalars.
        ValueError: The matrix is not square, or the bounds of a variable are not finite and in order.

    Example:
        >>> import jax.numpy as jnp
        >>> from scalargraph.proofs import box, prove, to_letters
        >>> proof = prove(lambda z: jnp.array([[1.001 + jnp.sin(z[0])]]), box(a=(-3.0, 3.0)))
        >>> proof.verdict, proof.boxes, to_letters(proof.levels)
        ('holds', 3, ['a', '..'])
    """
    check_box(domain)
    formed = as_form(matrix).graph(jnp.asarray(domain.low))
    entries = Entries.of(formed.entries, domain)
    return _decide(entries, domain, _Effort.of(boxes, seconds), processes, progress, _reason(formed, domain))


def prove_at_corners(
    matrix: Callable[[Array], Array], domain: Box, affine: Sequence[str], *, boxes: int = MOST_BOXES
) -> list[Proof]:
    """Prove that a matrix is positive definite if it is jointly affine in some variables: one proof for each corner.

    The smallest eigenvalue is a concave function of these variables, so it is least at a corner of their box. They need
    not be halved: 2^k proofs over the other variables replace one over all. The first proof that fails ends the work.

    Args:
        matrix: JAX function `z (d,) -> (n, n)`, or a `Form`, as for `prove`.
        domain: Bounds of z.
        affine: Names of the variables in which the matrix is affine.
        boxes: Number of boxes of all proofs together.

    Returns:
        The proofs in the order of the corners, up to the first that does not hold. A variable that does not enter the
        matrix has one corner only.

    Raises:
        ValueError: The matrix is not jointly affine in these variables, as its second derivatives or kinks show; a
            name is not known; or the matrix is not square.
        LoweringError: The matrix has no graph of scalars.

    Example:
        >>> import jax.numpy as jnp
        >>> from scalargraph.proofs import box, prove_at_corners
        >>> matrix = lambda z: jnp.array([[2.0 + z[0], z[1]], [z[1], 2.0]])
        >>> proofs = prove_at_corners(matrix, box(a=(-0.5, 1.0), b=(-1.0, 1.0)), ["a", "b"])
        >>> [proof.verdict for proof in proofs]
        ['holds', 'holds', 'holds', 'holds']
    """
    check_box(domain)
    unknown = set(affine) - set(domain.names)
    if unknown:
        raise InputError(f"prove_at_corners: no variable {sorted(unknown)[0]!r}; the box has {', '.join(domain.names)}")
    formed = as_form(matrix).graph(jnp.asarray(domain.low))
    indices = np.array([domain.names.index(name) for name in affine], int)
    kink = _kink(formed.entries, indices.tolist())
    if kink is not None:
        # Second derivatives vanish on either side of a kink, so they do not reveal that the matrix is not affine.
        raise InputError(f"prove_at_corners: the matrix is not affine in {', '.join(affine)}: it has a kink, by {kink}")
    # A jointly affine matrix is a convex combination of its values at the corners, and the cone S > 0 is convex.
    derivatives = expand(formed.entries, indices.tolist(), 2)
    entries = np.array([not derivatives.graph.is_zero(i) for i in derivatives.outputs])
    enters_block = [bool(row.any()) for row in entries.reshape(-1, len(formed.entries.outputs))]
    if any(enters_block[1 + len(indices) :]):
        raise InputError(f"prove_at_corners: the matrix is not affine in {', '.join(affine)} together")
    # A variable that does not enter the matrix needs one end only.
    ends = [(domain.low[i], domain.high[i])[: 1 + enters] for i, enters in zip(indices, enters_block[1:], strict=False)]
    # The conditions are not affine: they are proved over the whole domain.
    reason, effort = _reason(formed, domain), _Effort.of(boxes, None)
    corners = []
    for corner in itertools.product(*ends):
        low, high = domain.low.copy(), domain.high.copy()
        # Equal bounds fix the affine variables; the other variables keep their whole range.
        low[indices] = high[indices] = corner
        corners.append(domain._replace(low=low, high=high))
    block, proofs = Entries.of(formed.entries, corners[0]), []
    for at in corners:
        left = effort._replace(boxes=effort.boxes - sum(proof.boxes for proof in proofs))
        proofs.append(_decide(block, at, left, 1, None, reason))
        if proofs[-1].verdict != "holds":
            break
    return proofs


KINKS = {"abs", "sign", "floor", "ceil", "round", "min", "max", "select", "either", "cbrt", *TRUTHS}
"""Operations with a kink; on both sides of it, the graphs of their second derivatives vanish."""


def _kink(entries: Lowered, variables: Sequence[int]) -> str | None:
    """The first operation with a kink that depends on one of the inputs, or None."""
    depends: list[bool] = []
    graph, _ = entries.graph.pruned(entries.outputs)
    for node in graph.nodes:
        dependent = node.value in variables if node.op == "input" else any(depends[k] for k in node.arguments)
        if dependent and node.op in KINKS:
            return node.op
        depends.append(dependent)
    return None


def blocks(matrix: Callable[[Array], Array], domain: Box) -> list[Int[np.ndarray, "k"]]:
    """Indices of the diagonal blocks of a symmetric matrix after a permutation that is the same for every z.

    A matrix is positive definite if each block is, and each block depends on fewer variables. An entry counts as zero
    if its graph is the constant 0.

    Args:
        matrix: JAX function `z (d,) -> (n, n)`, or a `Form`.
        domain: Bounds of z; only the number of variables is used.

    Returns:
        One array of ascending row indices for each block.

    Example:
        >>> import jax.numpy as jnp
        >>> from scalargraph.proofs import blocks, box
        >>> matrix = lambda z: jnp.array([[1.0, 0.0, z[0]], [0.0, 2.0, 0.0], [z[0], 0.0, 1.0]])
        >>> sorted(block.tolist() for block in blocks(matrix, box(a=(0.0, 0.5))))
        [[0, 2], [1]]
    """
    formed = as_form(matrix).then(lambda m: m + m.T).graph(jnp.asarray(domain.low))
    nodes = formed.entries.nodes()
    # An entry with the constant graph 0 is zero for all z; the diagonal is added so that every index reaches itself.
    reached = ~np.vectorize(formed.entries.graph.is_zero, otypes=[bool])(nodes) | np.eye(len(nodes), dtype=bool)
    # Squaring doubles the length of the paths followed, so ⌊log₂ n⌋ + 1 squarings reach whole connected components.
    for _ in range(len(nodes).bit_length()):
        reached = reached @ reached
    return [np.flatnonzero(row) for row in np.unique(reached, axis=0)]


class _Effort(NamedTuple):
    """The number of boxes that may be evaluated, and the times [s] of the start and of the limit."""

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


def _decide(matrix: Entries, domain: Box, effort: _Effort, processes: int, progress, reason: str) -> Proof:
    """Branch and bound on one matrix, after a search for a counter-example at random points."""
    # A point where the matrix is not positive definite refutes the claim, even if conditions are not shown elsewhere.
    counterexample = look_around(matrix, domain)
    if counterexample is not None:
        return _failure_proof(domain, counterexample, effort, reason)
    if reason:
        whole = np.stack([domain.low, domain.high])[None]
        return Proof("undecided", domain, [np.array([OPEN])], None, whole, 1, effort.spent, reason)
    tree = Tree(domain)
    # One process starts alone, since most proofs end before worker processes have started.
    first_effort = effort if processes == 1 else effort._replace(boxes=min(effort.boxes, PATIENCE))
    counterexample = _search(functools.partial(map, functools.partial(judge, matrix)), tree, first_effort, progress)
    if processes > 1 and counterexample is None and tree.waiting and tree.evaluated < effort.boxes:
        # JAX runs threads, and a forked copy of a process with threads may hang, hence "spawn".
        context = multiprocessing.get_context("spawn")
        with concurrent.futures.ProcessPoolExecutor(
            processes, context, initializer=_set_matrix, initargs=(matrix,)
        ) as pool:
            counterexample = _search(functools.partial(pool.map, _judge_here), tree, effort, progress)
    return _conclude(tree, effort, reason, counterexample)


def _failure_proof(domain: Box, counterexample: np.ndarray, effort: _Effort, reason: str) -> Proof:
    none = np.zeros((0, 2, len(domain.low)))
    return Proof("fails", domain, [np.array([OPEN])], counterexample, none, 1, effort.spent, reason)


def _conclude(tree: Tree, effort: _Effort, reason: str, counterexample: np.ndarray | None = None) -> Proof:
    """The proof that a tree of boxes and an optional counter-example establish."""
    levels, remaining = tree.levels()
    verdict = "fails" if counterexample is not None else "undecided" if len(remaining) else "holds"
    return Proof(verdict, tree.domain, levels, counterexample, remaining, tree.evaluated, effort.spent, reason)


def _reason(formed: Formed, domain: Box) -> str:
    """Why the conditions are not shown to hold over the domain; "" if they are shown."""
    return show_conditions(formed.conditions, domain.with_fixed(formed.pins))


_matrix: Entries | None = None
"""The matrix of this worker process."""


def _set_matrix(matrix: Entries) -> None:
    """Store the matrix in a worker process, so that later messages to the process contain boxes only."""
    global _matrix
    _matrix = matrix


def _judge_here(low: np.ndarray, high: np.ndarray) -> tuple[Int[np.ndarray, "B"], np.ndarray | None]:
    assert _matrix is not None
    return judge(_matrix, low, high)


def _search(map_judge: Callable, tree: Tree, effort: _Effort, progress) -> np.ndarray | None:
    """Evaluate boxes by `map_judge` until none is left, the effort is spent, or a counter-example is found."""
    while tree.evaluated < effort.boxes and time.monotonic() < effort.until:
        lots = [lot for _ in range(ROUND_OF_LOTS) if (lot := tree.next()) is not None]
        if not lots:
            return None
        judged = map_judge(*zip(*(lot[1:3] for lot in lots), strict=True))
        for lot, (codes, counterexample) in zip(lots, judged, strict=True):
            if counterexample is not None:
                return counterexample
            tree.take(lot, codes)
        if progress is not None:
            progress(tree.decided, tree.evaluated)
    return None
