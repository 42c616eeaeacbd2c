"""Checks a saved certificate independently, from the file alone: its claims, and that its statement follows from them.

It shares only the model as JAX functions, and the description of the observer, with the prover. The matrices of claims
are formed here, and shown to be positive definite by Taylor models on boxes of the saved tree, down to its leaves.
"""

import contextlib
import functools
import itertools
import math
import multiprocessing
import pickle
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np

from covariant.certificates.base import (
    DisturbanceClaim,
    Document,
    ReachClaim,
    RemainderClaim,
    Resolved,
    StartClaim,
    check_unique,
    configuration_shape,
    parse,
    select,
    value_graph,
    values,
)
from covariant.certificates.checking import _check_sampled as sampled, _matrices as matrices
from covariant.certificates.checking._saved import observer_from, system_of
from covariant.models import input_count
from scalargraph.errors import InputError
from scalargraph.proofs.checker import ROUND, SavedTree, TaylorEnclosure, show_definite, show_tree

DEPTH, DEEPEST = 24, 200
"""Largest number of halvings of a leaf, and of the box of inputs."""
SHARE, PARTS = 1024, 8
"""Least number of leaves in a job of one process, and largest number of jobs per claim; jobs grow to respect it."""


class Job(NamedTuple):
    """Boxes on which one claim or condition is to be proved.

    Attributes:
        what: index of a claim, or name of another condition.
        low: lower corners (m, d).
        high: upper corners (m, d).
        numbers: numbers (m,) of the boxes in the tree of the claim; None for boxes without a tree.
        leaves: number of leaves of the boxes.
    """

    what: int | str
    low: np.ndarray
    high: np.ndarray
    numbers: np.ndarray | None = None
    leaves: int = 1


class Shown(NamedTuple):
    """Result of showing the claims of a certificate.

    Attributes:
        resolved: its document, with the observer.
        leaves: number of leaves of its claims.
        shown: number of leaves that were shown; it is less than `leaves` only if time ran out.
        seconds: time it took [s].
    """

    resolved: Resolved
    leaves: int
    shown: int
    seconds: float


def show(
    source: str | Path | Document,
    *,
    model: object = None,
    processes: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Shown:
    """Show that the claims of a file hold; the arguments are those of `check`."""
    start = time.monotonic()
    document = source if isinstance(source, Document) else parse(source)
    opened = [k for k, claim in enumerate(document.claims) if claim.open]
    _need(not opened, f"{document.file}: claims{opened} must have no open leaves; nothing is claimed to hold")
    resolved = follows(document, model)
    jobs = list(_jobs(document))
    done, total = 0, sum(job.leaves for job in jobs)
    for count in _results(resolved, jobs, processes, model):
        done += count
        if progress is not None:
            progress(done, total)
    return Shown(resolved, _leaves(jobs), _leaves(jobs), time.monotonic() - start)


def show_found(resolved: Resolved, seconds: float) -> Shown:
    """Show within a limited time that claims proved in this process hold."""
    start = time.monotonic()
    _complete(resolved)
    jobs, judge, shown = list(_jobs(resolved.document)), Judge(resolved, start + seconds), []
    with contextlib.suppress(TimeoutError):
        for job in jobs:
            judge(job)
            shown.append(job)
    return Shown(resolved, _leaves(jobs), _leaves(shown), time.monotonic() - start)


def _leaves(jobs: list[Job]) -> int:
    """The number of leaves of the claims."""
    return sum(job.leaves for job in jobs if isinstance(job.what, int))


def _need(holds: object, otherwise: str) -> None:
    if not holds:
        raise InputError(otherwise)


def follows(document: Document, model: object = None) -> Resolved:
    """Resolve a document, and check that its statement follows from its claims."""
    try:
        with np.errstate(all="ignore"):
            observer, q = observer_from(document, model)
            resolved = Resolved(document, observer, system_of(observer, q, document.sampling, document.joint_friction))
            _complete(resolved)
            # The slowest comparison comes last.
            expected = value_graph(resolved.about)
            _need(document.graph == expected, "graph: it must be the one that the observer has")
            return resolved
    except Exception as error:  # the model of a user may fail in any way while it is traced
        kind = "" if isinstance(error, InputError) else f"recipe: the model fails: {type(error).__name__}: "
        raise InputError(f"{document.file}: {kind}{_first_line(error)}") from error


def _first_line(error: Exception) -> str:
    return next(iter(str(error).strip().splitlines()), "")


def _complete(resolved: Resolved) -> None:
    """Raise `ValueError` unless claims, region and radius fit the model and each other."""
    (document, observer, system), n = resolved, len(resolved.document.velocity)
    model, low, high, claims = observer.model, document.low, document.high, document.claims
    _need(len(system.names) == len(low), f"box: the model has {len(system.names)} variables; the box bounds {len(low)}")
    names = system.names
    # The following checks are about positions, velocities, errors and forces; further forces and the age come later.
    part = sampled.need_sampled_box(document, model.manifold.commuting)
    driven, given = list(system.driven), document.given
    _need(list(document.driven) == driven, f"driven: the friction of the model depends on the signals {driven}")
    names, low, high = names[part], low[part], high[part]
    m, places = input_count(model, n), math.prod(configuration_shape(model, n))
    for key, expected in (("positions", places), ("inputs", m)):
        columns = getattr(document.given, key).shape[1]
        _need(columns == expected, f"given.{key}: the model has {expected}; bounds are there of {columns}")
    # Here the numbers of bounds are known, so that each signal has some.
    signals = np.concatenate([given.times[:, None], given.inputs], axis=1)[:, driven]
    first = len(document.low) - len(driven)
    held = (document.low[first:] <= signals[0]) & (signals[1] <= document.high[first:])
    outside = [system.names[first + k] for k in np.flatnonzero(~held)]
    _need(not outside, f"box: it must hold all given values of {', '.join(outside)}, on which the friction depends")
    check_unique(observer, np.maximum(high, -low)[-2 * n : -n])
    noise, disturbance = document.given.noise, select(claims, DisturbanceClaim)
    sloped = noise.any() and document.sampling is None
    _need(sloped or not document.given.slopes.any(), "given.slopes: they must be 0 where there is no noise")
    started = bool(select(claims, StartClaim))
    _need(model.manifold.commuting or not started, "claims: one about a start is for coordinates")

    # By assumption solutions are in `truth`; a curve of length `radius` leads no farther than `away` from them.
    if document.open:
        return
    speed, radius = document.velocity, document.radius
    acts = matrices.sizes(document).any() if document.sampling is None else document.given.disturbance.any()
    _need(bool(disturbance) == bool(acts), "claims: one about a disturbance must be there, if there is any")
    # The region bounds the error from the measured position, which exceeds the error from the true one by the noise.
    start = document.given.positions[:, : places * model.manifold.commuting]
    truth = [np.concatenate([p, v, b]) for p, v, b in zip(start, (-speed, speed), (-noise, noise), strict=True)]
    reaches = select(claims, ReachClaim)
    widths = [radius * math.sqrt(claim.square) * (1 + ROUND) for claim in reaches]
    # Widths in the order of the box. With a fixed measurement position and error move together: the first n rows.
    reach = [*widths[: len(start[0])], *widths[n:], *widths[:n]]
    for name, a, b, c, d, r in zip(names[:-n], low[:-n], high[:-n], *truth, reach, strict=True):
        # `fsum` rounds the exact sum once, which keeps its sign.
        fits = c <= d and math.fsum([a, r, -c]) <= 0 and math.fsum([d, r, -b]) <= 0
        excess = f"{name} may be {r:.6g} outside of {c:.6g} to {d:.6g}"
        _need(fits, f"box: {excess}, which its box {a:.6g} to {b:.6g} does not hold")
    slack = np.minimum(high[:-n] - truth[1], truth[0] - low[:-n])
    limits = [*slack[-n:], *slack[-2 * n : -n]]
    for row, (claim, r, available) in enumerate(zip(reaches, widths, limits, strict=True)):
        what = f"claims[{row + 1}].limit: row {row} reaches {r:.6g}, may reach {claim.limit:.6g}"
        _need(r <= claim.limit <= available, f"{what}, and has {available:.6g} of room")
    if remainders := select(claims, RemainderClaim):
        _need(not disturbance, "given: noise and disturbance are not covered for the exact observer")
        lost = matrices.remainder_rate(document, [math.sqrt(claim.square) for claim in remainders])
        left = f"{lost:.6g} 1/s, and the rate falls from {document.rate / 2:.6g} to {document.decay:.6g} 1/s"
        _need(0 < document.decay <= document.rate / 2 - lost, f"radius: the exact observer may lose {left}")
    if document.sampling is not None:
        sampled.need_sampled_rate_and_radius(document)
    elif disturbance:
        count = np.count_nonzero(matrices.sizes(document))
        # The steady distance 2D/λ: scaled errors lie in a ball of radius √count, so D² = count · square.
        steady = 2 * math.sqrt(count * disturbance[0].square) / document.rate * (1 + ROUND)
        _need(steady < radius, f"radius: noise alone leads {steady:.6g} away, and the radius is {radius:.6g}")


def _jobs(document: Document) -> Iterator[Job]:
    """List all boxes on which something is to be shown: bounds of the force, definedness, and leaves of the claims."""
    region, n = _force_box(document), len(document.velocity)
    if document.sampling is None:
        for what in ("the bound of the force", "the definedness of the force"):
            yield Job(what, *region[:, None])
    if document.given.noise.any() and document.sampling is None:
        pinned = np.concatenate([region, np.zeros((2, n))], axis=1)
        for what in ("the bound of the force's slopes", "the smoothness of the force"):
            yield Job(what, *pinned[:, None])
    # Fixed zeros for time and state, which are inputs of every claim, see `everything`.
    pins = np.zeros((2, 2 * n + 1))
    pinned = np.concatenate([[document.low, document.high], pins], axis=1)
    yield Job("the definedness of the observer, without jumps,", *pinned[:, None])
    if document.joint_friction:
        yield from itertools.starmap(Job, sampled.friction_jobs(document))
    yield from itertools.starmap(Job, sampled.sampled_jobs(document, pins))
    for index, claim in enumerate(document.claims):
        tree, (low, high) = _read_tree(document, index), document.bounds(claim)
        numbers, lows, highs = tree.boxes(np.zeros(1, int), low[None], high[None], SHARE)
        ends = np.cumsum(tree.leaves[numbers])
        part = (ends - 1) // max(SHARE, -(-int(ends[-1]) // PARTS))
        for chosen in (part == k for k in np.unique(part)):
            yield Job(index, lows[chosen], highs[chosen], numbers[chosen], int(tree.leaves[numbers[chosen]].sum()))


def _read_tree(document: Document, index: int) -> SavedTree:
    """Read the tree of boxes of a claim."""
    claim = document.claims[index]
    return SavedTree.read(len(document.bounds(claim)[0]), claim.levels, f"claim {index}")


def _force_box(document: Document) -> np.ndarray:
    """Least and largest time, measured position and input: (2, 1 + places + m). On a group `positions` are measured."""
    given, positions = document.given, document.given.positions
    if document.observer["frame"] == "coordinates":
        # The force is evaluated at the measured position, which exceeds the region of the true one by the noise.
        positions = positions + np.outer([-1, 1], given.noise)
    return np.concatenate([given.times[:, None], positions, given.inputs], axis=1)


def _matrix(resolved: Resolved, what: int | str) -> TaylorEnclosure:
    """The matrix to be shown positive definite, for a claim by its index or for a further condition by its name."""
    (document, _, system), model = resolved, resolved.observer.model
    low, high, n, region = document.low, document.high, len(document.velocity), _force_box(document)
    shape = configuration_shape(model, n)
    if isinstance(what, int):
        claim = document.claims[what]
        matrix = matrices.MATRICES[claim.kind](resolved, claim)
        return TaylorEnclosure(matrix, *document.bounds(claim), matrices.claim_slack(document, claim))
    if what in sampled.FRICTION_JOBS:
        return sampled.friction_matrix(document, model, what)
    if what == sampled.PREDICTED:
        return sampled.predicted_values(document, resolved.observer)
    if document.sampling is not None and what != "the definedness of the observer, without jumps,":
        return sampled.sampled_matrix(document, system, model, what)
    unmoved = np.concatenate([region, np.zeros((2, n))], axis=1)
    pinned = np.concatenate([[low, high], np.zeros((2, 2 * n + 1))], axis=1)
    force, slopes = matrices.force(model, shape), matrices.slopes(model, shape, n)
    # Forces are shown to keep the box plus half the slack, and claims hold for all of it: the rest covers rounding.
    force_at, unknown, steep = document.forces, document.given.disturbance, document.given.slopes.ravel()
    slack, allowed = matrices.slack_of(low, high)[force_at] / 2, steep * (1 + matrices.SLACK) + 1e-200
    claimed = low[force_at] + unknown - slack, high[force_at] - unknown + slack
    function, box, watch = {
        "the bound of the force": (matrices.within(force, *claimed), region, ""),
        "the definedness of the force": (force, region, "defined"),
        "the bound of the force's slopes": (matrices.within(slopes, -allowed, allowed), unmoved, ""),
        "the smoothness of the force": (matrices.stepped(model, shape, n), unmoved, "smooth"),
        "the definedness of the observer, without jumps,": (matrices.everything(system, values), pinned, "smooth"),
    }[what]
    least, largest = box
    return TaylorEnclosure(function, least, largest, np.zeros(len(least)), watch)


class Judge:
    """Shows that leaves of a certificate are right; builds each matrix only once."""

    def __init__(self, resolved: Resolved, until: float = math.inf):
        """Prepare to check the jobs of one document."""
        self.until = until
        self.file, self.matrix = resolved.document.file, functools.cache(functools.partial(_matrix, resolved))
        # Only the last tree is cached, since trees are large and the jobs of a claim come one after another.
        self.tree = functools.lru_cache(1)(functools.partial(_read_tree, resolved.document))

    def __call__(self, job: Job) -> int:
        """Show that the leaves of one job are right."""
        index, low, high, numbers, count = job
        what, depth = (f"claims[{index}]", DEPTH) if isinstance(index, int) else (index, DEEPEST)
        try:
            if isinstance(index, int) and numbers is not None:
                show_tree(self.matrix(index), self.tree(index), numbers, low, high, depth, what, self.until)
            else:
                show_definite(self.matrix(index), low, high, depth, what, self.until)
        except (ValueError, TypeError, LookupError, ArithmeticError, AttributeError) as error:
            raise InputError(f"{self.file}: {_first_line(error)}") from error
        return count


_worker: list[Judge] = []
"""The `Judge` of this worker process."""


def _begin(document: Document, model: object) -> None:
    _worker[:] = [Judge(follows(document, model))]


def _work(job: Job) -> int:
    return _worker[0](job)


def _results(resolved: Resolved, jobs: list[Job], processes: int, model: object) -> Iterator[int]:
    # Each worker first imports and traces, which takes longer than the leaves of a single job.
    if processes == 1 or _leaves(jobs) <= SHARE:
        yield from map(Judge(resolved), jobs)
        return
    try:
        pickle.dumps(model)
    except Exception as error:
        raise InputError("a model that is shared with processes is given as 'module:attribute'") from error
    arguments, context = (resolved.document, model), multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, context, initializer=_begin, initargs=arguments) as pool:
        yield from pool.map(_work, jobs)
