"""An independent check of a saved certificate, from the file alone: do its claims hold, and do they say so much?

It shares with the prover the model as JAX functions, and how an observer is written down. The matrices of the claims
are formed here, and shown to be positive definite by Taylor models on each leaf of the saved tree.
"""

import functools
import hashlib
import json
import math
import multiprocessing
import string
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from covariant.certificates._region import subject
from covariant.certificates._saved import observer_from
from covariant.certificates._taylor import ROUND, Enclosure, halves, show_definite
from covariant.models import GroupSystem, Lagrangian, applied_force

ROOM = 2.0**-20
"""Forces may be larger than claimed by this part, so that bounds which they reach are quickly shown."""
DEPTH, DEEPEST, SHARE = 6, 200, 4096
"""How often a leaf is halved, and how often the box of the inputs; leaves given to a process at once."""


class Checked(NamedTuple):
    """What was found right: rate [1/s] and radius of the certificate, by how many leaves, and in how many seconds."""

    rate: float
    radius: float
    leaves: int
    seconds: float


def check(path: str | Path, *, processes: int = 1, progress: Callable[[int, int], None] | None = None) -> Checked:
    """Check a saved certificate. `progress` is told how many leaves are done, and of how many.

    With several `processes` a script needs the `if __name__ == "__main__"` guard. Raises `ValueError` saying what is
    wrong, or what is not shown, and where.
    """
    start = time.monotonic()
    try:
        document = read(path)
        jobs = list(_jobs(str(path), document))
    except (LookupError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} is not a certificate: {error!r}") from error
    done, total = 0, sum(len(low) for *_, low, _ in jobs)
    for count in _results(jobs, processes):
        done += count
        if progress is not None:
            progress(done, total)
    return Checked(document["rate"], document["radius"], total - 1, time.monotonic() - start)


def _need(holds: Any, otherwise: str) -> None:
    if not holds:
        raise ValueError(otherwise)


def read(path: str | Path, digest: str = "") -> dict[str, Any]:
    document = json.loads(Path(path).read_text(encoding="utf-8"))
    rest = {key: value for key, value in document.items() if key != "digest"}
    text = json.dumps(rest, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    found = hashlib.sha256(text.encode("utf-8")).hexdigest()
    _need(found == document["digest"] and digest in ("", found), f"{path} was changed: its digest is {found}")
    return document


def _jobs(path: str, document: dict[str, Any]) -> Iterator[tuple]:
    """The claims and their leaves, if the statement follows from them: path, digest, claim, and corners of boxes."""
    claims, rate, radius = document["claims"], document["rate"], document["radius"]
    _need(document["format"] == "covariant certificate 1", f"the format {document['format']!r} is not known")
    _need(document["verdict"] == "holds", f"nothing is claimed to hold: the verdict is {document['verdict']!r}")
    _need(0 < rate < math.inf and 0 < radius < math.inf, f"rate {rate} and radius {radius} must be positive")
    observer, q = observer_from(document)
    about = subject(observer, q)
    _need(q.shape == (2, 2) and q[0, 1] == q[1, 0], f"Q must be a symmetric matrix; it is {q.tolist()}")
    for key, found in (("variables", about.names), ("units", about.units)):
        _need(document[key] == list(found), f"the {key} must be {list(found)}; they are {document[key]}")
    low, high = (np.array(claims[0][side], float) for side in ("low", "high"))
    n = jax.eval_shape(lambda z: about.at(z).x, jnp.zeros(len(about.names))).shape[0] // 2
    _need(low.shape == high.shape == (len(about.names),), f"the box must bound {len(about.names)} variables")
    _need(np.isfinite([low, high]).all() and (low <= high).all(), "the box must have finite bounds, the lower first")
    kinds = [(claim["kind"], claim.get("row")) for claim in claims]
    wanted = [("contraction", None), *(("reach", row) for row in range(2 * n))]
    _need(kinds == wanted, f"the claims must be contraction, and reach of rows 0 to {2 * n - 1}; they are {kinds}")
    same = all(claim["low"] == low.tolist() and claim["high"] == high.tolist() for claim in claims)
    _need(same, "the claims must be about the same box")

    # By hypothesis solutions are in `truth`; a curve of length `radius` leads no farther than `away` from there.
    speed, given, model = np.array(document["velocity"], float), _given(document), observer.model
    m, places = n if model.inputs is None else model.inputs, math.prod(_shape(model, n))
    _need(speed.shape == (n,) and given.shape == (2, 1 + places + m), f"{n} velocities, {places} positions, {m} inputs")
    _need(np.isfinite(given).all() and (given[0] <= given[1]).all(), "the inputs must have finite bounds in order")
    start = given[:, 1 : 1 + places * isinstance(model, Lagrangian)]
    truth = [np.concatenate([p, v, np.zeros(n)]) for p, v in zip(start, (-speed, speed), strict=True)]
    reach = [radius * math.sqrt(claim["square"]) * (1 + ROUND) for claim in claims[1:]]
    away = [*reach[: len(start[0])], *reach[n:], *reach[:n]]
    for name, a, b, c, d, r in zip(about.names[:-n], low[:-n], high[:-n], *truth, away, strict=True):
        fits = c <= d and math.fsum([a, r, -c]) <= 0 and math.fsum([d, r, -b]) <= 0
        _need(
            fits, f"{name} may be {r:.6g} outside of {c:.6g} to {d:.6g}, which its box {a:.6g} to {b:.6g} does not hold"
        )
    room = np.minimum(high[:-n] - truth[1], truth[0] - low[:-n])
    for row, (claim, r, most) in enumerate(zip(claims[1:], reach, [*room[-n:], *room[-2 * n : -n]], strict=True)):
        allowed = r <= claim["limit"] <= most
        _need(allowed, f"row {row} reaches {r:.6g}, may reach {claim['limit']:.6g}, and has {most:.6g} of room")

    yield path, document["digest"], None, *given[:, None]
    for index, claim in enumerate(claims):
        boxes = leaves(low, high, claim["levels"], f"claim {index}")
        for k in range(0, len(boxes[0]), SHARE):
            yield path, document["digest"], index, *(side[k : k + SHARE] for side in boxes)


def _shape(model: Lagrangian | GroupSystem, n: int) -> tuple[int, ...]:
    return (n,) if isinstance(model, Lagrangian) else (model.group.order, model.group.order)


def _given(document: dict[str, Any]) -> np.ndarray:
    """Least and largest time, position and input: (2, 1 + places + m)."""
    given, times = document["inputs"], document["inputs"]["times"]
    low, high = ([times[k], *given["positions"][side], *given[side]] for k, side in enumerate(("low", "high")))
    _need(len(low) == len(high) and len(times) == 2, "times, positions and inputs must have two bounds each")
    return np.array([low, high], float)


def leaves(low: np.ndarray, high: np.ndarray, levels: list[str], what: str) -> tuple[np.ndarray, np.ndarray]:
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


@functools.cache
def _statement(path: str, digest: str, index: int | None) -> Enclosure:
    """The matrix that is positive definite, says a claim; or the room that the force has within its bounds."""
    document = read(path, digest)
    observer, q = observer_from(document)
    about, claim = subject(observer, q), document["claims"][index or 0]
    low, high = np.array(claim["low"], float), np.array(claim["high"], float)
    n = len(document["velocity"])
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
        return -(push + push.T + change) - document["rate"] * gram

    def reach(z):
        point = about.at(z)
        row = point.reach[claim["row"]]
        return claim["square"] * point.metric.gram(jnp.zeros(()), point.x) - jnp.outer(row, row)

    if index is None:
        return Enclosure(force, given[0], given[1], np.zeros(given.shape[1]))
    return Enclosure(contraction if claim["kind"] == "contraction" else reach, low, high, room)


def _results(jobs: list[tuple], processes: int) -> Iterator[int]:
    if processes == 1:
        yield from map(_judge, jobs)
        return
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
        yield from pool.map(_judge, jobs)


def _judge(job: tuple) -> int:
    path, digest, index, low, high = job
    what, depth = ("the bound of the force", DEEPEST) if index is None else (f"claim {index}", DEPTH)
    show_definite(_statement(path, digest, index), low, high, depth, what)
    return len(low)
