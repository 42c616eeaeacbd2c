"""An independent check of a saved certificate, from the file alone: do its claims hold, and do they say so much?

It shares with the prover the model as JAX functions, and how an observer is written down. The matrices of the claims
are formed here, and shown to be positive definite by Taylor models on each leaf of the saved tree.
"""

import functools
import math
import multiprocessing
import pickle
import string
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from covariant.certificates._document import Document, parse
from covariant.certificates._region import Intrinsics, Subject, subject
from covariant.certificates._saved import observer_from, value_graph
from covariant.certificates._taylor import ROUND, Enclosure, halves, show_definite
from covariant.models import GroupSystem, Lagrangian, applied_force

ROOM = 2.0**-20
"""Forces may be larger than claimed by this part, so that bounds which they reach are quickly shown."""
DEPTH, DEEPEST, SHARE = 6, 200, 4096
"""How often a leaf is halved, and how often the box of the inputs; leaves given to a process at once."""


class Checked(NamedTuple):
    """What was found right: rate [1/s] and radius of the certificate, by how many leaves, and in how many seconds.

    `model_given`: whether whoever checked gave the model, in the place of what the file names.
    """

    rate: float
    radius: float
    leaves: int
    seconds: float
    model_given: bool = False


def check(
    source: str | Path | Document,
    *,
    model: Any = None,
    processes: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Checked:
    """Check a saved certificate, a file or what `parse` made of it.

    `progress` is told how many leaves are done, and of how many.
    `model`: for a certificate about a model of somebody's own, who checks gives it: a model, or a function that makes
    one of the recipe's parameters, or the `module:attribute` of either. With several `processes` a script needs the
    `if __name__ == "__main__"` guard. Raises `ValueError` saying what is wrong, or what is not shown, and where.
    """
    start = time.monotonic()
    document = source if isinstance(source, Document) else parse(source)
    opened = [k for k, claim in enumerate(document.claims) if claim.open]
    _need(not opened, f"{document.file}: claims{opened} must have no open leaves; nothing is claimed to hold")
    statement = follows(document, model)
    jobs = list(_jobs(document))
    done, total = 0, sum(len(low) for *_, low, _ in jobs)
    for count in _results(statement, jobs, processes, model):
        done += count
        if progress is not None:
            progress(done, total)
    return Checked(document.rate, document.radius, total - 1, time.monotonic() - start, model is not None)


def _need(holds: Any, otherwise: str) -> None:
    if not holds:
        raise ValueError(otherwise)


class Statement(NamedTuple):
    """A document, and the observer that it is about."""

    document: Document
    observer: Intrinsics
    about: Subject


def follows(document: Document, model: Any = None) -> Statement:
    """What a certificate is about. Raises `ValueError` unless its statement follows from its claims, if those hold."""
    try:
        with np.errstate(all="ignore"):
            observer, q = observer_from(document, model)
            statement = Statement(document, observer, subject(observer, q))
            _complete(statement)
            return statement
    except Exception as error:  # somebody's model may fail in any way while it is traced
        kind = "" if isinstance(error, ValueError) else f"recipe: the model fails: {type(error).__name__}: "
        raise ValueError(f"{document.file}: {kind}{_first_line(error)}") from error


def _first_line(error: Exception) -> str:
    return next(iter(str(error).strip().splitlines()), "")


def _complete(statement: Statement) -> None:
    """Raise `ValueError` unless claims, region and radius fit the model, and each other."""
    (document, observer, about), n = statement, len(statement.document.velocity)
    model, low, high, claims = observer.model, document.low, document.high, document.claims
    _need(len(about.names) == len(low), f"box: the model has {len(about.names)} variables; the box bounds {len(low)}")
    m, places = n if model.inputs is None else model.inputs, math.prod(_shape(model, n))
    for key, wanted in (("positions", places), ("inputs", m)):
        found = getattr(document.given, key).shape[1]
        _need(found == wanted, f"given.{key}: the model has {wanted}; bounds are there of {found}")
    _need(document.graph == value_graph(observer, document.q), "graph: it must be the one that the observer has")
    pushed = len(claims) > 2 * n + 1 or document.given.noise.any() or document.given.disturbance.any()
    _need(not pushed, "given.noise: no claim about noise, or about a disturbance, is known to the checker")

    # By hypothesis solutions are in `truth`; a curve of length `radius` leads no farther than `away` from there.
    if document.open:
        return
    speed, given, radius = document.velocity, _given(document), document.radius
    start = given[:, 1 : 1 + places * isinstance(model, Lagrangian)]
    truth = [np.concatenate([p, v, np.zeros(n)]) for p, v in zip(start, (-speed, speed), strict=True)]
    reach = [radius * math.sqrt(claim.square) * (1 + ROUND) for claim in claims[1:]]
    away = [*reach[: len(start[0])], *reach[n:], *reach[:n]]
    for name, a, b, c, d, r in zip(about.names[:-n], low[:-n], high[:-n], *truth, away, strict=True):
        fits = c <= d and math.fsum([a, r, -c]) <= 0 and math.fsum([d, r, -b]) <= 0
        far = f"{name} may be {r:.6g} outside of {c:.6g} to {d:.6g}"
        _need(fits, f"box: {far}, which its box {a:.6g} to {b:.6g} does not hold")
    room = np.minimum(high[:-n] - truth[1], truth[0] - low[:-n])
    for row, (claim, r, most) in enumerate(zip(claims[1:], reach, [*room[-n:], *room[-2 * n : -n]], strict=True)):
        what = f"claims[{row + 1}].limit: row {row} reaches {r:.6g}, may reach {claim.limit:.6g}"
        _need(r <= claim.limit <= most, f"{what}, and has {most:.6g} of room")


def _jobs(document: Document) -> Iterator[tuple]:
    """The bound of the force, and the claims with their leaves: number, and corners of boxes."""
    yield None, *_given(document)[:, None]
    for index, claim in enumerate(document.claims):
        boxes = leaves(document.low, document.high, claim.levels, f"claim {index}")
        for k in range(0, len(boxes[0]), SHARE):
            yield index, *(side[k : k + SHARE] for side in boxes)


def _shape(model: Lagrangian | GroupSystem, n: int) -> tuple[int, ...]:
    return (n,) if isinstance(model, Lagrangian) else (model.group.order, model.group.order)


def _given(document: Document) -> np.ndarray:
    """Least and largest time, position and input: (2, 1 + places + m)."""
    given = document.given
    return np.concatenate([given.times[:, None], given.positions, given.inputs], axis=1)


def leaves(low: np.ndarray, high: np.ndarray, levels: Sequence[str], what: str) -> tuple[np.ndarray, np.ndarray]:
    """The leaves of a tree, which cover its box: both halves of a box are there, and hold its middle."""
    lows, highs, found = low[None], high[None], []
    for depth, level in enumerate(levels):
        axes = np.array([(string.ascii_letters[: len(low)] + ".").find(letter) for letter in level], int)
        fits = len(axes) == len(lows) and (axes >= 0).all()
        _need(fits, f"level {depth} of {what} must have {len(lows)} letters or dots; it is {level[:60]!r}")
        end = axes == len(low)
        found.append((lows[end], highs[end]))
        lows, highs = halves(lows[~end], highs[~end], axes[~end])
    _need(not len(lows), f"{what} lacks the last {len(lows)} boxes")
    first, second = zip(*found, strict=True)
    return np.concatenate(first), np.concatenate(second)


def _matrix(statement: Statement, index: int | None) -> Enclosure:
    """The matrix that is positive definite, says a claim; or the room that the force has within its bounds."""
    (document, observer, about), claim = statement, statement.document.claims[index or 0]
    low, high, n = document.low, document.high, len(document.velocity)
    room = np.where(np.arange(len(low)) < len(low) - n, 0.0, ROOM * np.maximum(abs(low), abs(high)) + 1e-200)
    shape, given = _shape(observer.model, n), _given(document)
    m = math.prod(shape)

    def force(y):
        found = applied_force(observer.model, y[0], y[1 : m + 1].reshape(shape), y[m + 1 :])
        return jnp.diag(jnp.concatenate([found - (low - room / 2)[-n:], (high + room / 2)[-n:] - found]))

    def contraction(z):
        point, t = about.at(z), jnp.zeros(())
        frame, x, flow = point.metric.frame(t, point.x), point.x, point.flow(t, point.x)
        along = jax.jvp(
            lambda s: (point.metric.coframe(s, x + s * flow), point.metric.gram(s, x + s * flow)), (t,), (t + 1,)
        )
        (coframe, gram), (turn, change) = along
        push = gram @ (turn + coframe @ jax.jacfwd(lambda y: point.flow(t, y))(x)) @ frame
        return -(push + push.T + change) - document.rate * gram

    def reach(z):
        point = about.at(z)
        row = point.reach[claim.row]
        return claim.square * point.metric.gram(jnp.zeros(()), point.x) - jnp.outer(row, row)

    if index is None:
        return Enclosure(force, given[0], given[1], np.zeros(given.shape[1]))
    return Enclosure(contraction if claim.kind == "contraction" else reach, low, high, room)


class Judge:
    """Shows leaves of one statement to be right; each matrix is formed once."""

    def __init__(self, statement: Statement):
        self.file, self.matrix = statement.document.file, functools.cache(functools.partial(_matrix, statement))

    def __call__(self, job: tuple) -> int:
        index, low, high = job
        what, depth = ("the bound of the force", DEEPEST) if index is None else (f"claims[{index}]", DEPTH)
        try:
            show_definite(self.matrix(index), low, high, depth, what)
        except (ValueError, TypeError, LookupError, ArithmeticError) as error:
            raise ValueError(f"{self.file}: {_first_line(error)}") from error
        return len(low)


_worker: list[Judge] = []
"""The judge of a worker process."""


def _begin(document: Document, model: Any) -> None:
    _worker[:] = [Judge(follows(document, model))]


def _work(job: tuple) -> int:
    return _worker[0](job)


def _results(statement: Statement, jobs: list[tuple], processes: int, model: Any) -> Iterator[int]:
    if processes == 1:
        yield from map(Judge(statement), jobs)
        return
    try:
        pickle.dumps(model)
    except Exception as error:
        raise ValueError("a model that is shared with processes is given as 'module:attribute'") from error
    given, context = (statement.document, model), multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, context, initializer=_begin, initargs=given) as pool:
        yield from pool.map(_work, jobs)
