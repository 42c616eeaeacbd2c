"""Checks a saved certificate of convergence from all first errors independently, from the file and the model alone.

It shares with the prover the model as JAX functions, the elimination of `_linalg`, and the formulas of `_document` for
what follows from the numbers. The coupling is bounded anew by Taylor models of JAX's own derivatives, on the leaves of
the saved tree, or joint by joint from energies, which JAX differentiates twice. The channels are those of the
observer's code, `correct` after `predict` on a unit mass, differentiated by JAX.
"""

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from covariant._linalg import solve
from covariant.certificates.base import Hypothesis, friction_of, need_doubles
from covariant.certificates.checking import Checked
from covariant.certificates.everywhere._chain import InertiaBounds
from covariant.certificates.everywhere._document import GlobalDocument, need_covered, read_document, statement_of
from covariant.models import Lagrangian, MechanicalSystem, from_recipe
from covariant.models.robots import KinematicTree, RobotSpace
from covariant.observers import MeasuredCoefficients
from scalargraph.errors import InputError
from scalargraph.proofs.checker import ROUND, TaylorEnclosure, halves, jacobian, leaves, show_definite

CHUNK, DEEPEST = 1024, 12
"""Boxes evaluated at once, and how often a leaf may be halved."""
CELLS = 2048
"""Parts of the velocities on which friction is bounded."""


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
        need_covered(system)
        if len(system.coordinates) != len(document.low):
            raise InputError(f"recipe: its model has {len(system.coordinates)} coordinates, not {len(document.low)}")
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
    return _show_inertia(document, system) if len(document.inertia) else _show_coupling(document, system, progress)


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
    """Show that friction differs between velocities by no more than F times their distance, and what is stated."""
    low, high, none = -document.velocity, document.velocity, np.zeros(len(document.velocity))

    def friction(v):
        return friction_of(system, jnp.zeros(len(v)), v)

    smooth = TaylorEnclosure(friction, low, high, none, "smooth")
    show_definite(smooth, low[None], high[None], 40, "friction")
    # Cells are small near rest, where dry friction is steep.
    ends = np.linspace(-1, 1, CELLS + 1)[:, None] ** 3 * high
    slopes = TaylorEnclosure(lambda v: jnp.diagonal(jacobian(friction, v)), low, high, none)(ends[:-1], ends[1:])
    excess = [np.maximum(abs(x.middle) + x.away - f, 0.0) for x, f in zip(slopes, document.viscous, strict=True)]
    total = np.array([(e * width).sum() for e, width in zip(excess, np.diff(ends, axis=0).T, strict=True)])
    total = np.where(total < 1e-290, 0.0, total)  # the radius of an exact 0 covers underflows, of which it has none
    if not (total * (1 + ROUND) <= document.dry).all():
        raise InputError(f"dry: friction beside F differs by {total.tolist()}; stated are {document.dry.tolist()}")


def _show_inertia(document: GlobalDocument, system: MechanicalSystem) -> int:
    """Show bounds of the inertia joint by joint, and what follows; returns the number of inequalities."""
    space, n = system.space, len(document.low)
    if type(space) is not RobotSpace or space.floating or not np.array_equal(space.tree.coordinates, np.eye(n)):
        raise InputError("inertia: the model is no arm on a fixed base whose joints move by themselves")
    tree, known = space.tree, InertiaBounds.of(document.inertia)
    least, floors, ceilings, shared = known
    on_base, children = np.array(tree.parents) < 0, [np.flatnonzero(np.array(tree.parents) == i) for i in range(n)]
    turns = np.linalg.norm(tree.turn, axis=1)

    def energy(i, v, w, carried):
        """Twice the energy of body i with a twist, and of what it carries."""
        spin = jnp.cross(w, jnp.eye(3))  # rows ω × e_j, so that its transpose is ω ×
        own = tree.mass[i] * v @ v + 2 * v @ jnp.cross(w, tree.first[i]) + jnp.trace(spin.T @ tree.second[i] @ spin)
        twist = jnp.concatenate([v, w])
        return own + sum(twist @ carried[c] @ twist for c in children[i])

    def behind(i, z, v, w, rate):
        """The twist of body i at its joint's position z, for that of its carrier and a rate."""
        joints = space.joints(jnp.zeros(n).at[i].set(z[0]))
        back = (0.0 if on_base[i] else 1.0) * joints.rotation[i].T
        v, w = back @ (v + jnp.cross(w, joints.place[i])), back @ w
        return v + tree.slide[i] * rate, w + tree.turn[i] * rate

    def above(i, z, y):
        kept = (tree.armature[i] - least[i]) * y[6] ** 2 - y[:6] @ floors[i] @ y[:6]
        return energy(i, *behind(i, z, y[:3], y[3:6], y[6]), floors) + kept

    def below(i, z, y):
        return y @ ceilings[i] @ y - energy(i, *behind(i, z, y[:3], y[3:], 0.0), ceilings)

    for i in range(n):
        low, high = document.low[i : i + 1], document.high[i : i + 1]
        for form, count in ((above, 7), (below, 6)):

            def matrix(z, i=i, form=form, count=count):
                return jacobian(lambda y: jacobian(lambda x: form(i, z, x), y), jnp.zeros(count))

            show_definite(TaylorEnclosure(matrix, low, high, np.zeros(1)), low[None], high[None], 40, "inertia")
    _show_masses(tree, children, shared)
    up = 1 + ROUND
    moments = [float(energy(i, tree.slide[i], tree.turn[i], ceilings)) * up for i in range(n)]
    reach, roots, carried = np.zeros(n), np.sqrt(least) / up, tree.carried()
    for i, k in zip(*np.nonzero(carried), strict=True):  # i carries k
        size = turns[i] * math.sqrt(moments[k]) * up
        reach[k] += 2 * document.velocity[i] * size
        reach[i] += 2 * document.velocity[k] * size * (i != k)
    weights, force = document.weights, document.dry + document.disturbance
    norm = np.linalg.norm(reach * weights) + (document.viscous * weights / roots).max()
    norm = norm * (1 / (document.omega * weights * roots)).max() * up
    pushed = np.linalg.norm(force / roots) / roots * up
    if not (norm <= document.coupling and (pushed <= document.acceleration).all()):
        raise InputError(f"coupling: it is shown to be below {norm:.6g}, and accelerations below {pushed.tolist()}")
    return 2 * n


def _show_masses(tree: KinematicTree, children: list[np.ndarray], shared: np.ndarray) -> None:
    """Show that no body has a negative mass anywhere, after each has got its share of what moves with two of them."""
    shares = []
    for turn, numbers in zip(np.asarray(tree.turn), shared, strict=True):
        second = np.zeros((3, 3))
        second[np.triu_indices(3)] = numbers
        second = np.outer(turn, turn) * numbers[2] if turn.any() else second + np.triu(second, 1).T
        first, mass = (turn * numbers[1], numbers[0]) if turn.any() else (turn, 0.0)
        shares.append(np.block([[second, first[:, None]], [first[None], np.array([[mass]])]]))
    for i, carried in enumerate(children):
        first = np.asarray(tree.first[i])[:, None]
        moments = np.block([[np.asarray(tree.second[i]), first], [first.T, np.asarray(tree.mass[i])[None, None]]])
        moments = moments + shares[i]
        for c in carried:
            frame = np.block([[np.asarray(tree.rotation[c]), np.asarray(tree.place[c])[:, None]], [np.eye(4)[3:]]])
            moments = moments - frame @ shares[c] @ frame.T
        sizes = np.diag(moments)
        if not (sizes > 0).all() or np.linalg.eigvalsh(moments / np.sqrt(np.outer(sizes, sizes)))[0] < 1e-9:
            raise InputError(f"inertia: body {i} would have negative masses")


def _show_coupling(
    document: GlobalDocument, system: MechanicalSystem, progress: Callable[[int, int], None] | None
) -> int:
    """Show that coupling and accelerations are below their bounds, on the leaves of the tree or on halves of them."""
    n, whole = len(document.low), (document.low, document.high, np.zeros(len(document.low)))

    def entries(q):
        """The symbols and M⁻¹, row by row."""
        slope = jacobian(system.space, q)  # ∂_c M_ab as (a, b, c)
        first = (slope + jnp.swapaxes(slope, 1, 2) - jnp.moveaxis(slope, 2, 0)) / 2
        right = jnp.concatenate([first.reshape(n, n * n), jnp.eye(n)], axis=1)
        return solve(system.space(q)[::-1, ::-1], right[::-1])[::-1]  # eliminates what moves least first

    smooth = TaylorEnclosure(system.space, *whole, "smooth")
    show_definite(smooth, document.low[None], document.high[None], 40, "the metric")
    enclosure, (low, high) = TaylorEnclosure(entries, *whole), leaves(*whole[:2], document.levels, "levels")
    total, left = len(low), np.full(len(low), DEEPEST)
    while len(low):
        (low, a), (high, b), (left, deep) = ((x[:-CHUNK], x[-CHUNK:]) for x in (low, high, left))
        found = enclosure(a, b)
        sizes = np.stack([np.broadcast_to(abs(each.middle) + each.away, len(a)) for each in found.flat], axis=1)
        bad = ~_bounded(document, sizes.reshape(len(a), n, -1))
        if (deep[bad] == 0).any():
            place = ((a + b) / 2)[bad][deep[bad].argmin()].tolist()
            raise InputError(f"the coupling is not shown to be below {document.coupling:.6g} at {place}")
        slopes = [sum(abs(each.terms[1].get((k,), 0.0)) for each in found.flat) + 0.0 * a[:, k] for k in range(n)]
        axes = np.where(np.isfinite(slopes).all(0), np.argmax(slopes, axis=0), (b - a).argmax(1))
        lower, upper = halves(a[bad], b[bad], axes[bad])
        low, high = np.concatenate([low, lower]), np.concatenate([high, upper])
        left = np.concatenate([left, np.repeat(deep[bad] - 1, 2)])
        if progress is not None:
            progress(total - min(len(low), total), total)
    return total


def _bounded(document: GlobalDocument, sizes: np.ndarray) -> np.ndarray:
    """Boxes (B,) on which bounds (B, n, n² + n) of the symbols and of M⁻¹ show what is stated."""
    n = len(document.low)
    symbols, inverse = sizes[:, :, : n * n].reshape(-1, n, n, n), sizes[:, :, n * n :]
    with np.errstate(all="ignore"):
        coupling = 2 * symbols @ document.velocity + inverse * document.viscous
        scaled = coupling * np.outer(1 / (document.weights * document.omega), document.weights) * (1 + ROUND)
        # A norm is below R if Bx ≤ R y and Bᵀy ≤ R x for positive x and y.
        x, limit = np.ones((len(sizes), n, 1)), document.coupling
        for _ in range(20):
            x = scaled.swapaxes(1, 2) @ scaled @ x
            x = x / (x.max(1, keepdims=True) + 1e-200) + 1e-3
        y = scaled @ x * (1 + ROUND) / limit
        good = (scaled.swapaxes(1, 2) @ y * (1 + ROUND) <= limit * x).all((1, 2))
        pushed = inverse @ (document.dry + document.disturbance) * (1 + ROUND)
        return np.asarray(good & (pushed <= document.acceleration).all(1))
