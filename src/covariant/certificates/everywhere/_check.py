"""Checks a saved certificate of convergence from all first errors independently, from the file and the model alone.

It shares with the prover the model as JAX functions, and the formulas of `_document` for what follows from the numbers.
The coupling is bounded anew by Taylor models of JAX's own derivatives, on the boxes of the saved tree; the channels are
those of the observer's code, `correct` after `predict` on a unit mass, differentiated by JAX.
"""

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from covariant.certificates.base import (
    Hypothesis,
    friction_of,
    need_doubles,
    need_joint_friction,
    need_known,
    need_steady_friction,
)
from covariant.certificates.checking import Checked
from covariant.certificates.everywhere._document import GlobalDocument, read_document, statement_of
from covariant.models import Lagrangian, MechanicalSystem, from_recipe
from covariant.observers import MeasuredCoefficients
from scalargraph.errors import InputError
from scalargraph.proofs.checker import ROUND, TaylorEnclosure, halves, jacobian, leaves, show_definite

CHUNK, DEEPEST = 256, 12
"""Boxes evaluated at once, and how often a leaf may be halved."""
CELLS = 2048


def check_globally(
    path: str | Path,
    content: bytes | None = None,
    *,
    model: object = None,
    progress: Callable[[int, int], None] | None = None,
) -> Checked | None:
    """Check a saved certificate of convergence from all first errors: that its numbers prove its statement.

    Args:
        path: the file, from `GlobalCertificate.document.save`.
        content: its bytes, if it has been read.
        model: for a model that is not part of this library, as for `check`.
        progress: called with the number of leaves done and of all leaves.

    Returns:
        The statement as verified; its radius is that of the errors that remain. None for a certificate of another kind.

    Raises:
        ValueError: the file is no certificate, or its proof is wrong; the message says where.

    Example:
        >>> from covariant import models
        >>> from covariant.certificates import certify_globally, check_globally
        >>> recipe = models.recipe("pendulum_chain")
        >>> made = certify_globally(models.from_recipe(recipe), velocity=1.0, interval=(0.001, 0.001), recipe=recipe)
        >>> check_globally(made.document.save("arm.json")).statement.proved
        True
    """
    start, document = time.monotonic(), read_document(path, content)
    if document is None:
        return None
    need_doubles("a check")
    try:
        system: Any = from_recipe(document.recipe or {}, model)
        need_known(system)
        if len(system.coordinates) != len(document.low):
            raise InputError(f"recipe: its model has {len(system.coordinates)} coordinates, not {len(document.low)}")
        need_steady_friction(system)
        need_joint_friction(system)
        count = _show(document, system, progress)
    except Exception as error:  # the model of a user may fail in any way while it is traced
        kind = "" if isinstance(error, InputError) else f"the model fails: {type(error).__name__}: "
        raise InputError(f"{path}: {kind}{next(iter(str(error).splitlines()), '')}") from error
    shown = (
        Hypothesis(f"the coupling, on {count} leaves", "proved"),
        Hypothesis("the gains of the channels of the observer's code, at all times between samples", "proved"),
        Hypothesis("the bounds of friction, and of turns of circles between samples", "proved"),
    )
    statement = statement_of(document, system, shown, True)
    spent = time.monotonic() - start
    return Checked(statement, 2 * document.rate, document.radius(), count, spent, model is not None)


def _show(document: GlobalDocument, system: MechanicalSystem, progress: Callable[[int, int], None] | None) -> int:
    """Show everything, and return the number of leaves."""
    circles = list(system.circles)
    turn = 2 * (document.velocity * document.ages[-1, 1] + document.noise) * (1 + ROUND)
    if not (turn[circles] < math.pi * (1 - 1e-9)).all():
        raise InputError("velocity: circles must turn by less than half a turn between samples")
    _show_friction(document, system)
    unit = Lagrangian(lambda q: jnp.eye(1), coordinates=("q",), inputs=1)
    for alpha, beta, p in zip(document.alpha.tolist(), document.beta.tolist(), document.metrics, strict=True):
        observer = MeasuredCoefficients(unit, alpha, beta)
        for low, high in document.ages[:, :, None]:
            matrix = TaylorEnclosure(_gain_matrix(observer, p, document), low, high, np.zeros(1))
            show_definite(matrix, low[None], high[None], 40, "metrics")
    return _show_coupling(document, system, progress)


def _gain_matrix(observer: MeasuredCoefficients, p: np.ndarray, document: GlobalDocument) -> Callable[[Array], Array]:
    """Half of `e^(−2μτ)P − …`, as a quadratic form of (ωe, ζ, d/ω), of the step that the observer makes."""
    omega = jnp.sqrt(observer.beta)
    scale = jnp.stack([1 / omega, jnp.ones(()), omega])

    def moved(x, tau):
        """(ωe, ζ) after a sample of a unit mass that rests at 0, by (ωe, ζ, d/ω) before it."""
        e, v, d = scale * x
        state = observer.init(jnp.zeros(1))._replace(q=e[None], v=v[None])
        after = observer.correct(observer.predict(state, d[None], tau), d[None], jnp.zeros(1))[0]
        return jnp.concatenate([omega * after.q, after.v])

    def matrix(z):
        step = jacobian(lambda x: moved(x, z[0]), jnp.zeros(3))
        supply = z[0] * jnp.diag(jnp.array([0.0, -1.0, document.square]))
        old = jnp.exp(-2 * document.rate * z[0]) * jnp.zeros((3, 3)).at[:2, :2].set(p)
        return (old + supply - step.T @ p @ step) / 2

    return matrix


def _show_friction(document: GlobalDocument, system: MechanicalSystem) -> None:
    """Show that slopes of the friction stay so near to −F that the rest of it differs by no more than is stated."""
    n = len(document.low)

    def excess(v):
        slopes = jnp.diagonal(jacobian(lambda w: friction_of(system, jnp.zeros(n), w), v))
        return slopes + document.viscous

    low, high = -document.velocity, document.velocity
    # Cells are small near rest, where dry friction is steep.
    ends = np.linspace(-1, 1, CELLS + 1)[:, None] ** 3 * high
    found = TaylorEnclosure(excess, low, high, np.zeros(n))(ends[:-1], ends[1:])
    total = np.array([((abs(x.middle) + x.away) * np.diff(ends[:, i])).sum() for i, x in enumerate(found)])
    smooth = TaylorEnclosure(lambda v: friction_of(system, jnp.zeros(n), v), low, high, np.zeros(n), "smooth")
    show_definite(smooth, low[None], high[None], 40, "friction")
    total = np.where(total < 1e-290, 0.0, total)  # the radius of an exact 0 covers underflows, of which it has none
    if not (total * (1 + ROUND) <= document.dry).all():
        raise InputError(f"dry: friction beside F differs by {total.tolist()}; stated are {document.dry.tolist()}")


def _show_coupling(
    document: GlobalDocument, system: MechanicalSystem, progress: Callable[[int, int], None] | None
) -> int:
    n = len(document.low)

    def parts(q):
        """M, and `Γ_l,jk` of the first kind, one after the other."""
        slope = jacobian(system.space, q)  # ∂_c M_ab as (a, b, c)
        first = (slope + jnp.swapaxes(slope, 1, 2) - jnp.moveaxis(slope, 2, 0)) / 2
        return jnp.concatenate([system.space(q).ravel(), first.ravel()])

    enclosure = TaylorEnclosure(parts, document.low, document.high, np.zeros(n))
    defined = TaylorEnclosure(system.space, document.low, document.high, np.zeros(n), "smooth")
    show_definite(defined, document.low[None], document.high[None], 40, "the metric")
    low, high = leaves(document.low, document.high, document.levels, "levels")
    total, done = len(low), 0
    left = np.zeros(total, int)
    while len(low):
        (low, a), (high, b), (left, depth) = ((x[:-CHUNK], x[-CHUNK:]) for x in (low, high, left))
        good, axes = _bounded(document, enclosure(a, b), b - a)
        if (depth[~good] >= DEEPEST).any():
            k = np.flatnonzero(~good)[depth[~good].argmax()]
            raise InputError(
                f"coupling: it is not shown to be below {document.coupling:.6g} at {((a + b) / 2)[k].tolist()}"
            )
        lower, upper = halves(a[~good], b[~good], axes[~good])
        low, high = np.concatenate([low, lower]), np.concatenate([high, upper])
        left = np.concatenate([left, np.repeat(depth[~good] + 1, 2)])
        done += int((good & (depth == 0)).sum())
        if progress is not None:
            progress(done, total)
    return total


def _bounded(document: GlobalDocument, found: np.ndarray, width: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Boxes on which the coupling is as stated, and the coordinate to halve on others."""
    n, boxes = len(document.low), len(width)
    keys = sorted({m for entry in found for part in entry.terms for m in part})
    terms, radius = np.zeros((len(keys), len(found), boxes)), np.zeros((len(found), boxes))
    for j, entry in enumerate(found):
        radius[j] = entry.radius
        for part in entry.terms:
            for m, t in part.items():
                terms[keys.index(m), j] = t
    terms, radius = np.moveaxis(terms, 2, 1), radius.T + ROUND * np.abs(terms).sum(0).T
    shape = (boxes, n, n)
    metric, spread = terms[..., : n * n].reshape(len(keys), *shape), radius[:, : n * n].reshape(shape)
    # Columns of the right side: the symbols, then the identity, so that T = M⁻¹ times it is Γ and M⁻¹.
    right = np.concatenate([terms[..., n * n :].reshape(len(keys), boxes, n, n * n), 0 * metric], axis=3)
    right[keys.index(()), :, :, n * n :] = np.eye(n)
    loose = np.concatenate([radius[:, n * n :].reshape(boxes, n, n * n), 0 * spread], axis=2)
    centre = keys.index(())
    others = [k for k in range(len(keys)) if k != centre]
    with np.errstate(all="ignore"):
        guess = np.linalg.inv(np.where(np.isfinite(metric[centre]), metric[centre], np.eye(n)))
        size = np.abs(guess)
        e, g = -(guess @ metric), guess @ right
        e[centre] += np.eye(n)
        slack = size @ spread + ROUND * (size @ np.abs(metric).sum(0) + np.eye(n))
        wander = np.abs(g[others]).sum(0) + size @ loose + ROUND * (size @ np.abs(right).sum(0))
        whole = np.abs(e).sum(0) + slack
        # T = G + E G + E²T: the terms of G and E·G₀ are added before absolute values are taken.
        turned = g + e @ g[centre]
        total = np.abs(turned).sum(0) + size @ loose + slack @ np.abs(g[centre]) + whole @ wander
        total = total * (1 + ROUND) + ROUND * (size @ np.abs(right).sum(0)) + 1e-200
        again = whole @ whole * (1 + ROUND)
        # Iterated from above: x ≥ total + again·x with x > 0 bounds |T|.
        x = total
        for _ in range(60):
            x = total + again @ x
        x = x * (1 + 1e-6)
        sound = (total + again @ x <= x * (1 - ROUND)).all((1, 2)) & np.isfinite(x).all((1, 2))
        gamma, inverse = x[:, :, : n * n].reshape(boxes, n, n, n), x[:, :, n * n :]
        omega, w = document.omega, document.weights
        coupling = (2 * gamma * document.velocity).sum(3) + inverse * document.viscous
        scaled = coupling * (w / (w * omega)[:, None]) * (1 + ROUND)
        # A norm is below R if Bx ≤ R y and Bᵀy ≤ R x for positive x and y.
        x, limit = np.ones((boxes, n)), document.coupling
        for _ in range(20):
            x = np.einsum("bij,bik,bk->bj", scaled, scaled, x)
            x = x / (x.max(1, keepdims=True) + 1e-200) + 1e-3
        y = np.einsum("bij,bj->bi", scaled, x) * (1 + ROUND) / limit
        good = sound & (np.einsum("bij,bi->bj", scaled, y) * (1 + ROUND) <= limit * x).all(1)
        pushed = inverse @ (document.dry + document.disturbance) * (1 + ROUND)
        good &= (pushed <= document.acceleration).all(1)
        share = np.abs(turned).sum((2, 3)) + np.abs(e).sum((2, 3)) * np.abs(g[centre]).sum((1, 2))
    weight = np.zeros(width.shape)
    for k in others:
        for i in keys[k]:
            weight[:, i] += np.nan_to_num(share[k])
    return good, np.where(weight.max(1) > 0, weight.argmax(1), width.argmax(1))
