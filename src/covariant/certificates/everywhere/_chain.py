"""Bounds inertia and coupling of an arm for all its positions at once, joint by joint, without its inverse inertia.

Let joint i turn or slide the bodies behind it about s_i, ν be the twist of its carrier, X_i(q_i) its map to the body of
the joint, I_i the inertia of that body, a_i that of the rotor. If constant matrices B_i, P_i and a diagonal D satisfy

    [X_i s_i]ᵀ(I_i + Σ_c B_c)[X_i s_i] + (a_i − D_i) eeᵀ ≥ [B_i 0; 0 0],   X_iᵀ(I_i + Σ_c P_c) X_i ≤ P_i

for all q_i, c the joints on body i, then by induction from the tips M(q) ≥ D, and what joint k alone moves has at most
the inertia m_k = s_kᵀ(I_k + Σ_c P_c)s_k, at all positions. The configuration embeds the arm in the flat space of its
mass points r, where `∂_i∂_k r = a_i × ∂_k r` for the axis a_i of a joint i that carries k, so that |∂_i∂_k r|² ≤ m_k.
`Γ(w, z)` is the tangential part of `Σ w_i z_k ∂_i∂_k r` (Gauss's principle of least constraint). Therefore

    |Γ(w, z)|_D ≤ |Γ(w, z)|_M ≤ Σ_k r_k |z_k|,   r_k = Σ_i 2V_i √m_l  over |w_i| ≤ 2V_i,

with l the joint of i and k that the other carries, and 0 for joints on other branches, or if the carrier slides.

That |a × v| ≤ |v| needs masses that are not negative. Inertias say so once the parts that joints do not move relative
to their carriers are shared out among the two, which changes no energy.

Source: an addition; Featherstone 2008, chapter 6, for composite bodies; Gauss 1829.
"""

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant.certificates.everywhere._channel import DAMPING
from covariant.certificates.everywhere._coupling import Coupling
from covariant.certificates.everywhere._document import GlobalDocument
from covariant.certificates.theory import is_definite, minimise, rational
from covariant.geometry import AbstractSpace
from covariant.models.robots import KinematicTree, RobotSpace
from scalargraph.proofs import Box, Proof, prove

FIRST, POSITIONS, ROUNDS = 12, 2881, 20
"""At how many positions of each joint the inequalities are solved for first, and then tested, and how often at most."""
SLACK = 3e-3
"""Margin of the inequalities for the solver, as a fraction of the least inertia of a joint."""
MOST = 20_000
"""Boxes for each inequality."""
ROUND = 1e-11
"""Relative margin, larger than the rounding of the sums here."""
UPPER = np.triu_indices(6)
CORNER = np.outer(np.arange(7) == 6, np.arange(7) == 6).astype(float)
"""eeᵀ (7, 7), e the rate of the joint."""


class InertiaBounds(NamedTuple):
    """Proved bounds of the inertia of an arm of n joints, and the matrices that prove them.

    Attributes:
        least: D (n,).
        floors: B (n, 6, 6).
        ceilings: P (n, 6, 6).
        shared: what each joint (n, 6) gives from its carrier to its body: mass, first and second moment on the axis of
            a turning joint, or the entries of the second moments of a sliding one.
    """

    least: Float[np.ndarray, "n"]
    floors: Float[np.ndarray, "n 6 6"]
    ceilings: Float[np.ndarray, "n 6 6"]
    shared: Float[np.ndarray, "n 6"]

    @classmethod
    def of(cls, rows: Float[np.ndarray, "n 49"]) -> "InertiaBounds":
        """The bounds of their numbers, of symmetric matrices the upper triangles."""
        least, floors, ceilings, shared = np.split(rows, [1, 22, 43], axis=1)
        return cls(least[:, 0], symmetric(floors), symmetric(ceilings), shared)

    def rows(self) -> Float[np.ndarray, "n 49"]:
        """Their numbers, for a file."""
        triangles = (each[:, UPPER[0], UPPER[1]] for each in (self.floors, self.ceilings))
        return np.concatenate([self.least[:, None], *triangles, self.shared], axis=1)


class Chain(NamedTuple):
    """The bodies and joints of an arm on a fixed base.

    Attributes:
        space: the configuration space.
        axes: s (n, 6), slides first.
        inertias: I (n, 6, 6) of the bodies about their origins.
        rotors: a (n,).
        carried: the joints c that body i carries itself.
    """

    space: RobotSpace
    axes: Float[np.ndarray, "n 6"]
    inertias: Float[np.ndarray, "n 6 6"]
    rotors: Float[np.ndarray, "n"]
    carried: tuple[tuple[int, ...], ...]

    @classmethod
    def of(cls, space: AbstractSpace) -> "Chain | None":
        """The chain of a space; None for other machines, or where joints follow others."""
        if type(space) is not RobotSpace or space.floating or space.tree.balls:
            return None
        tree, n = space.tree, len(space.tree.parents)
        if not np.array_equal(tree.coordinates, np.eye(n)):
            return None
        axes = np.concatenate([np.asarray(tree.slide, float), np.asarray(tree.turn, float)], axis=1)
        carried = tuple(tuple(c for c in range(n) if tree.parents[c] == i) for i in range(n))
        return cls(space, axes, _inertias(tree), np.asarray(tree.armature, float), carried)

    @property
    def turns(self) -> np.ndarray:
        """Whether each joint turns (n,)."""
        return np.any(self.axes[:, 3:], axis=1)

    def map(self, i: int, position: Any) -> Array:
        """X_i (6, 6) at a position of joint i; 0 for joints on the base, which does not move."""
        if self.space.tree.parents[i] < 0:
            return jnp.zeros((6, 6))
        joints = self.space.joints(jnp.zeros(len(self.axes)).at[i].set(position))
        back, cross = joints.rotation[i].T, jnp.cross(joints.place[i], jnp.eye(3), axisa=-1, axisb=0, axisc=0)
        return jnp.block([[back, -back @ cross], [jnp.zeros((3, 3)), back]])

    def whole(self, i: int, of_carried: Any) -> Any:
        """Inertia of body i together with the (n, 6, 6) of the joints that it carries."""
        return sum((of_carried[c] for c in self.carried[i]), self.inertias[i])

    def above(self, i: int, moved: Any, floors: Any, least: Any) -> Any:
        """The matrix (7, 7) of the first inequality at X_i = `moved`, which must be positive definite."""
        both = moved @ np.eye(6, 7) + np.outer(self.axes[i], CORNER[6])
        kept = np.eye(6, 7).T @ floors[i] @ np.eye(6, 7)
        return both.mT @ self.whole(i, floors) @ both + (self.rotors[i] - least[i]) * CORNER - kept

    def below(self, i: int, moved: Any, ceilings: Any) -> Any:
        """The matrix (6, 6) of the second inequality."""
        return ceilings[i] - moved.mT @ self.whole(i, ceilings) @ moved

    def moments(self, ceilings: np.ndarray) -> np.ndarray:
        """Upper bounds m (n,)."""
        each = [axis @ self.whole(i, ceilings) @ axis for i, axis in enumerate(self.axes)]
        return np.array(each) * (1 + ROUND)

    def spread(self, i: int, shared: np.ndarray) -> np.ndarray:
        """What a joint shares, as moments (4, 4) [second first; firstᵀ mass] in the frame of its body."""
        part = np.zeros((4, 4), dtype=shared.dtype)
        if self.turns[i]:
            axis = self.axes[i, 3:] if shared.dtype != object else rational(self.axes[i, 3:])
            part[:3, :3] = np.outer(axis, axis) * shared[i, 2]
            part[:3, 3] = part[3, :3] = axis * shared[i, 1]
            part[3, 3] = shared[i, 0]
        else:
            rows, columns = np.triu_indices(3)
            part[rows, columns] = part[columns, rows] = shared[i]
        return part

    def bodies(self, shared: np.ndarray) -> list[np.ndarray]:
        """Moments (4, 4) of each body with what its joints share; exact for fractions."""
        tree, found = self.space.tree, []
        exact = rational if shared.dtype == object else np.asarray
        for i, joints in enumerate(self.carried):
            first, second = np.asarray(tree.first[i], float), np.asarray(tree.second[i], float)
            own = exact(
                np.block([[second, first[:, None]], [first[None], np.asarray(tree.mass[i], float)[None, None]]])
            )
            own = own + self.spread(i, shared)
            for c in joints:
                frame = np.eye(4)
                frame[:3, :3], frame[:3, 3] = np.asarray(tree.rotation[c]), np.asarray(tree.place[c])
                own = own - exact(frame) @ self.spread(c, shared) @ exact(frame).T
            found.append(own)
        return found

    def prove(self, inertia: InertiaBounds, domain: Box) -> Proof:
        """Prove the inequalities between the ends of all joints; the proof has no tree, since it is one for each."""
        start, boxes, holds = time.monotonic(), 0, all(map(is_definite, self.bodies(rational(inertia.shared))))
        for i in range(len(self.axes)):
            at = slice(i, i + 1)
            one = Box(domain.names[at], domain.units[at], domain.low[at], domain.high[at])
            for matrix in (
                lambda z, i=i: self.above(i, self.map(i, z[0]), inertia.floors, inertia.least),
                lambda z, i=i: self.below(i, self.map(i, z[0]), inertia.ceilings),
            ):
                found = prove(matrix, one, boxes=MOST)
                boxes, holds = boxes + found.boxes, holds and found.verdict == "holds"
        none = np.zeros((0, 2, len(self.axes)))
        return Proof("holds" if holds else "undecided", domain, [], None, none, boxes, time.monotonic() - start)

    def gains(self, inertia: InertiaBounds, document: GlobalDocument, designed: bool) -> GlobalDocument:
        """A document with the weights, and if `designed` the ω up to a factor, for the least noise of velocities."""
        if not designed:
            return document._replace(weights=1 / (document.omega * np.sqrt(inertia.least)))
        reach = self.reach(inertia.ceilings, document.velocity)
        # Coordinates that do not couple get a small gain too.
        reach, noise = reach + 0.02 * reach.max(), np.where(document.noise > 0, document.noise, 1.0)
        # ω ∝ √(u/D), of which Σ σ²ω³ is least where Σ r²/u ≤ 1.
        u = (reach**2 * inertia.least**1.5 / noise**2) ** 0.4
        omega = np.sqrt(u / inertia.least)
        return document._replace(alpha=DAMPING * omega, beta=omega**2, weights=1 / np.sqrt(u))

    def bounds(self, inertia: InertiaBounds, document: GlobalDocument) -> tuple[float, np.ndarray]:
        """The coupling in the norm of a document, and the accelerations (n,) by its unknown forces."""
        roots, weights = np.sqrt(inertia.least), document.weights
        reach = self.reach(inertia.ceilings, document.velocity)
        # Viscous friction pushes by F|z|, and |M⁻¹f|_M ≤ |f|_(1/D).
        along = math.hypot(*(reach * weights)) + (document.viscous * weights / roots).max()
        norm = (1 / (document.omega * weights * roots)).max() * along
        return float(norm) * (1 + ROUND), math.hypot(*(document.force / roots)) / roots * (1 + ROUND)

    def reach(self, ceilings: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """r (n,) for bounds of speeds."""
        carries, roots = self.space.tree.carried(), np.sqrt(self.moments(ceilings)) * (1 + ROUND)
        # Of joints i and k, the one that carries the other must turn.
        pairs = carries * roots * np.linalg.norm(self.axes[:, 3:], axis=1)[:, None]
        return 2 * (np.maximum(pairs, pairs.T) @ velocity) * (1 + ROUND)


def _inertias(tree: KinematicTree) -> np.ndarray:
    """Inertias (n, 6, 6) for twists (v, ω) at the origins."""
    mass, first, second = (np.asarray(part, float) for part in (tree.mass, tree.first, tree.second))
    eye = np.eye(3)
    cross = np.cross(first[:, None], eye)  # rows f × e_j, the transpose of the matrix of f ×
    turning = np.trace(second, axis1=1, axis2=2)[:, None, None] * eye - second
    return np.block([[mass[:, None, None] * eye, cross], [cross.swapaxes(1, 2), turning]])


def symmetric(entries: np.ndarray) -> np.ndarray:
    """Matrices (n, 6, 6) of their upper triangles, n · 21 numbers."""
    found = np.zeros((entries.size // 21, 6, 6))
    found[:, UPPER[0], UPPER[1]] = found[:, UPPER[1], UPPER[0]] = entries.reshape(-1, 21)
    return found


def solve_for(chain: Chain, coupling: Coupling) -> InertiaBounds | None:
    """Matrices that satisfy the inequalities between the ends of all joints, with a margin; None if none are found.

    Minimised are the sums of `size/D` and `m/size`, with the sizes that D and m have at most and at least, by sampling.
    """
    (low, high), n = coupling.domain[2:], len(chain.axes)
    inverse = coupling.inverses()
    least = 1 / np.diagonal(inverse, axis1=1, axis2=2).max(0)
    most = (np.diagonal(np.linalg.inv(inverse), axis1=1, axis2=2) - chain.rotors).max(0)
    maps = [
        np.asarray(jax.vmap(lambda q, i=i: chain.map(i, q))(np.linspace(low[i], high[i], POSITIONS))) for i in range(n)
    ]
    # Unknowns and inequalities are in units of the arm's inertia and reach.
    unit, reach = float(most.max()), float(np.sqrt(most.max() / np.trace(chain.inertias, axis1=1, axis2=2).max()))
    slack, twist = SLACK * float(least.min()) / unit, np.repeat([reach, 1.0], (3, 4))
    entries = unit / np.outer(twist, twist)[:6, :6]
    shares = np.where(chain.turns[:, None], unit / reach ** np.array([2, 1, 0, 0, 0, 0]), unit)

    def scaled(x):
        return symmetric(x[: 21 * n]) * entries

    def above(i, moved, x):
        form = chain.above(i, moved, scaled(x), least * x[21 * n : 22 * n])
        return form * np.outer(twist, twist) / unit - slack * np.eye(7)

    def below(i, moved, x):
        return chain.below(i, moved, scaled(x)) / entries - slack * np.eye(6)

    def above_inverse(i):
        return lambda x: np.array([[x[21 * n + i], 1.0], [1.0, x[22 * n + i]]])

    def moment(x):
        return sum(axis @ chain.whole(i, scaled(x)) @ axis / most[i] for i, axis in enumerate(chain.axes))

    def sound(i):
        scale = np.outer([1, 1, 1, reach], [1, 1, 1, reach]) / unit
        return lambda x: chain.bodies(x[:-1].reshape(n, 6) * shares)[i] * scale - x[-1] * np.eye(4)

    zero = moment(np.zeros(21 * n))
    cost = np.array([moment(each) - zero for each in np.eye(21 * n)])
    # The ceilings of joints on the base are arbitrary.
    bounded = [lambda x, i=i: np.eye(6) - scaled(x)[i] / entries for i, p in enumerate(maps) if not p[0].any()]
    floors = _cut(above, maps, np.repeat([0.0, 1.0], (22 * n, n)), [*map(above_inverse, range(n))], slack)
    ceilings = _cut(below, maps, cost, bounded, slack)
    largest = [*map(sound, range(n)), lambda x: np.array([[1.0 - x[-1]]])]
    shared = minimise(-1.0 * (np.arange(6 * n + 1) == 6 * n), largest)
    if floors is None or ceilings is None or shared is None:
        return None
    d = least * floors[21 * n : 22 * n]
    return InertiaBounds(d, scaled(floors), scaled(ceilings), shared[:-1].reshape(n, 6) * shares)


def _cut(
    form: Callable[[int, np.ndarray, np.ndarray], np.ndarray],
    maps: Sequence[np.ndarray],
    cost: np.ndarray,
    others: list[Callable[[np.ndarray], np.ndarray]],
    slack: float,
) -> np.ndarray | None:
    """Minimise a cost where forms of many maps are positive, by adding those that a solution for fewer violates."""
    chosen = [(i, k) for i, each in enumerate(maps) for k in range(0, len(each), len(each) // FIRST)]
    for _ in range(ROUNDS):
        x = minimise(cost, [*(lambda x, i=i, k=k: form(i, maps[i][k], x) for i, k in chosen), *others])
        if x is None:
            return None
        least = [np.linalg.eigvalsh(form(i, each, x))[:, 0] for i, each in enumerate(maps)]
        # The margin is there to be used, in part.
        wrong = [(i, k) for i, each in enumerate(least) for k in _valleys(each) if each[k] < -0.3 * slack]
        if not wrong:
            return x
        chosen += wrong
    return None


def _valleys(values: np.ndarray) -> np.ndarray:
    """Indices of local minima."""
    padded = np.concatenate([[np.inf], values, [np.inf]])
    return np.flatnonzero((values <= padded[:-2]) & (values <= padded[2:]))
