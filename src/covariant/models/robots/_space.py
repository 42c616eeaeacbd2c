"""The configuration space of a tree of rigid bodies, by sweeps along the tree.

A configuration embeds a machine in the flat space of its mass points, where its kinetic energy is a quadratic form. All
geometry follows from two things: the twists of the bodies, a linear function of the velocity, and the change of these
along a motion. Sums over mass points come down to mass, first and second moment of each body. Curvature is that of a
submanifold (Gauss), so no inertia matrix is ever differentiated.

Source: Featherstone 2008, Rigid Body Dynamics Algorithms, chapters 5 and 6; Kobayashi & Nomizu 1969, Foundations of
Differential Geometry II, chapter VII, for the equation of Gauss.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Inexact

from covariant._linalg import solve
from covariant._typing import Matrix, Vector
from covariant.geometry import AbstractManifold, AbstractSpace

Configuration = Inexact[Array, "..."]


class KinematicTree(eqx.Module):
    """Rigid bodies that hang on each other by joints of one axis, the parents first.

    Body i turns about, or slides along, an axis through its own origin. It stands on body `parents[i]`, or on the base
    where this is −1. The joints stand at `θ = coordinates q + offset`, linear functions of the n coordinates q: so one
    may follow another.

    - `turn`, `slide` (k, 3): the axis, in the frame of the body; zero in the one that the joint does not do.
    - `rotation` (k, 3, 3), `place` (k, 3): of the frame of the body in that of its parent, at θ = 0.
    - `mass` (k,) [kg], `first` (k, 3) [kg m] and `second` (k, 3, 3) [kg m²]: moments `∫ρ`, `∫ρ r`, `∫ρ r rᵀ` about the
      origin of the body.
    - `base_mass` (), `base_first` (3,), `base_second` (3, 3): of the base, where it floats.
    - `coordinates` (k, n), `offset` (k,).
    - `armature` (n,): inertia of the rotors, as felt at the coordinates [kg m² or kg].
    """

    parents: tuple[int, ...] = eqx.field(static=True)
    turn: Float[Array, "k 3"]
    slide: Float[Array, "k 3"]
    rotation: Float[Array, "k 3 3"]
    place: Float[Array, "k 3"]
    mass: Float[Array, "k"]
    first: Float[Array, "k 3"]
    second: Float[Array, "k 3 3"]
    base_mass: Float[Array, ""]
    base_first: Float[Array, "3"]
    base_second: Float[Array, "3 3"]
    coordinates: Float[Array, "k n"]
    offset: Float[Array, "k"]
    armature: Float[Array, "n"]

    def carried(self) -> np.ndarray:
        """Which bodies (k, k) each body carries, itself included."""
        k = len(self.parents)
        found = np.eye(k, dtype=bool)
        for i in reversed(range(k)):
            if self.parents[i] >= 0:
                found[self.parents[i]] |= found[i]
        return found


class Joints(NamedTuple):
    """Where each body stands on its parent now: `rotation` (k, 3, 3) and `place` (k, 3)."""

    rotation: Float[Array, "k 3 3"]
    place: Float[Array, "k 3"]


class Moments(NamedTuple):
    """Mass and moments of bodies, as those of `KinematicTree`, the base first."""

    mass: Float[Array, "k1"]
    first: Float[Array, "k1 3"]
    second: Float[Array, "k1 3 3"]


class RobotSpace(AbstractSpace):
    """The space of a tree of bodies. A velocity is q', after the twist (v, ω) of a floating base in its own frame."""

    tree: KinematicTree
    manifold: AbstractManifold = eqx.field(kw_only=True)
    floating: bool = eqx.field(default=False, static=True)

    def lower(self, x: Configuration, a: Vector) -> Vector:
        joints = self.joints(x)
        twists, gathered = jax.vjp(lambda b: self.twists(joints, b), a)
        momenta = jnp.concatenate(_momentum(self._moments(x), *_split(twists)), axis=1)
        return gathered(momenta)[0] + self._rotors(a)

    def __call__(self, x: Configuration) -> Matrix:
        """The inertia matrix, by composite bodies (Featherstone 2008, section 6.2)."""
        tree, joints = self.tree, self.joints(x)
        parents = jnp.asarray([p + 1 for p in tree.parents])
        order = jnp.arange(len(tree.parents))

        def collect(whole, body):
            i, parent, rotation, place = body
            mass, first, second = whole.mass[i + 1], whole.first[i + 1], whole.second[i + 1]
            turned = rotation @ first
            aside = jnp.outer(turned, place)
            moved = rotation @ second @ rotation.T + aside + aside.T + mass * jnp.outer(place, place)
            return Moments(
                whole.mass.at[parent].add(mass),
                whole.first.at[parent].add(turned + mass * place),
                whole.second.at[parent].add(moved),
            ), None

        bodies = (order, parents, *joints)
        whole = jax.lax.scan(collect, self._moments(x), bodies, reverse=True)[0]
        turn, slide = (axis.astype(x.dtype) for axis in (tree.turn, tree.slide))
        each = Moments(*(part[1:] for part in whole))
        own = jnp.concatenate(_momentum(each, slide, turn), axis=1)  # of each composite body, for its joint's unit rate
        carried = jnp.asarray(tree.carried(), x.dtype)

        def lower_down(columns, body):
            i, rotation, place, turn, slide, mine, carries = body
            columns = columns.at[i].set(mine)
            force, moment = columns[:, :3], columns[:, 3:]
            row = carries * (force @ slide + moment @ turn)
            force = force @ rotation.T
            moved = jnp.concatenate([force, moment @ rotation.T + jnp.cross(place[None], force)], axis=1)
            return jnp.where(carries[:, None] > 0, moved, columns), row

        bodies = (order, *joints, turn, slide, own, carried)
        at_base, rows = jax.lax.scan(lower_down, jnp.zeros_like(own), bodies, reverse=True)
        matrix = rows + rows.T - jnp.diag(jnp.diag(rows))
        coordinates = tree.coordinates.astype(x.dtype)
        matrix = coordinates.T @ matrix @ coordinates + jnp.diag(tree.armature.astype(x.dtype))
        if not self.floating:
            return matrix
        side = coordinates.T @ jnp.asarray(at_base)
        axes = jnp.eye(3, dtype=x.dtype)
        base = Moments(*(jnp.broadcast_to(part[:1], (6, *part.shape[1:])) for part in whole))
        nothing = jnp.zeros_like(axes)
        unit = jnp.concatenate([axes, nothing]), jnp.concatenate([nothing, axes])
        corner = jnp.concatenate(_momentum(base, *unit), axis=1)
        return jnp.block([[corner, side.T], [side, matrix]])

    def connection_force(self, x: Configuration, a: Vector, b: Vector) -> Vector:
        """`<∇_a b, ·>`: what the mass points resist the change of b along a with, summed up along the joints."""
        joints = self.joints(x)
        twists, gathered = jax.vjp(lambda w: self.twists(joints, w), b)
        spins = self.twists(joints, a)[:, 3:], twists[:, 3:]
        field = _field(self._bent(joints, a, b, *spins, twists[0, :3]), *spins)
        return gathered(_wrench(*_resistance(self._moments(x), *field)))[0]

    def curvature(self, x: Configuration, a: Vector, b: Vector, c: Vector) -> Vector:
        """`<R(a, b)c, w> = <II(a, w), II(b, c)> − <II(b, w), II(a, c)>` with the second fundamental form II (Gauss).

        In `<II(a, w), II(b, c)>` the first may be the whole `∂_a ∂_w` of the places: the second is normal to the rest.
        """
        joints, moments, matrix = self.joints(x), self._moments(x), self(x)
        twists, gathered = jax.vjp(lambda w: self.twists(joints, w), c)
        spin_a, spin_b, spin_c = self.twists(joints, a)[:, 3:], self.twists(joints, b)[:, 3:], twists[:, 3:]

        def normal(along, spin):
            """`II(along, c)`: its force on each body, and its moments `∫ρ II rᵀ`."""
            bent = self._bent(joints, along, c, spin, spin_c, twists[0, :3])
            force = gathered(_wrench(*_resistance(moments, *_field(bent, spin, spin_c))))[0]
            within = self.twists(joints, solve(matrix, force))
            return _resistance(moments, *_field(bent - within, spin, spin_c))

        of_a, of_b = normal(a, spin_a), normal(b, spin_b)

        def moved(w):
            speed, spin = _split(self.twists(joints, w))
            first = speed[0]
            return spin, self._bent(joints, a, w, spin_a, spin, first), self._bent(joints, b, w, spin_b, spin, first)

        # What is left of <∂_a ∂_w, II>: that of the part w × (a × r) of the field.
        beside = _about(of_b[1], spin_a) - _about(of_a[1], spin_b)
        onto = jax.vjp(moved, jnp.zeros_like(a))[1]((beside, _wrench(*of_b), -_wrench(*of_a)))[0]
        return solve(matrix, onto)

    def joints(self, x: Configuration) -> Joints:
        """Where each body stands on its parent at x."""
        tree = self.tree
        rotation, place, turn, slide = (
            part.astype(x.dtype) for part in (tree.rotation, tree.place, tree.turn, tree.slide)
        )
        angles = self.joint_angles(x)
        along = turn[:, :, None] * turn[:, None, :]
        turns = jnp.any(tree.turn != 0, axis=1)
        angle = jnp.where(turns, angles, 0.0)[:, None, None]
        eye = jnp.eye(3, dtype=x.dtype)[None]
        flat = jnp.where(turns[:, None, None], eye - along, 0.0)
        still = eye - flat
        turned = still + jnp.cos(angle) * flat + jnp.sin(angle) * _hat(turn)
        return Joints(rotation @ turned, place + jnp.einsum("kij,kj->ki", rotation, slide * angles[:, None]))

    def joint_angles(self, x: Configuration) -> Float[Array, "k"]:
        """Where the joints are [rad or m]."""
        coordinates, offset = (part.astype(x.dtype) for part in (self.tree.coordinates, self.tree.offset))
        return coordinates @ (x[16:] if self.floating else x) + offset

    def joint_rates(self, a: Vector) -> Float[Array, "k"]:
        """The rates of the joints [rad/s or m/s] at the velocity a."""
        return self.tree.coordinates.astype(a.dtype) @ (a[6:] if self.floating else a)

    @property
    def mass(self) -> Array:
        """Mass of the robot [kg]: of all that moves."""
        return self.tree.base_mass + jnp.sum(self.tree.mass)

    def first_moment(self, x: Configuration, joints: Joints) -> Float[Array, "3"]:
        """`∫ρ r` of the whole robot in the world [kg m]."""
        mass, first, _ = self._moments(x)

        def collect(total, body):
            i, parent, rotation, place = body
            carried, moment = total[0][i + 1], total[1][i + 1]
            moved = rotation @ moment + carried * place
            return (total[0].at[parent].add(carried), total[1].at[parent].add(moved)), None

        parents = jnp.asarray([p + 1 for p in self.tree.parents])
        bodies = (jnp.arange(len(parents)), parents, *joints)
        (mass, first), _ = jax.lax.scan(collect, (mass, first), bodies, reverse=True)
        if not self.floating:
            return first[0]
        pose = x[:16].reshape(4, 4)
        return pose[:3, :3] @ first[0] + mass[0] * pose[:3, 3]

    def twists(self, joints: Joints, a: Vector) -> Float[Array, "k1 6"]:
        """Twists (v, ω) of the base and of all bodies, each in its own frame, at the velocity a: linear in a."""
        tree, rates = self.tree, self.joint_rates(a)[:, None]
        first = jnp.zeros((len(tree.parents) + 1, 6), a.dtype)
        if self.floating:
            first = first.at[0].set(a[:6])
        own = jnp.concatenate([tree.slide.astype(a.dtype) * rates, tree.turn.astype(a.dtype) * rates], axis=1)
        return self._swept(joints, first, own)

    def _bent(
        self, joints: Joints, a: Vector, b: Vector, spin_a: Array, spin_b: Array, speed: Float[Array, "3"]
    ) -> Float[Array, "k1 6"]:
        """`∂_a ∂_b` of the place of each body, in its own frame: linear and angular acceleration (n, α), linear in b.

        A point of the body changes by `n + α × r + ω_b × (ω_a × r)`. `spin_a`, `spin_b` are the spins of the bodies,
        `speed` is that of the base, all at the velocities a and b.
        """
        tree, rates_a, rates_b = self.tree, self.joint_rates(a)[:, None], self.joint_rates(b)[:, None]
        turn, slide = tree.turn.astype(b.dtype), tree.slide.astype(b.dtype)
        own = jnp.concatenate(
            [
                jnp.cross(spin_b[1:], slide * rates_a) + jnp.cross(spin_a[1:], slide * rates_b),
                jnp.cross(spin_a[1:], turn * rates_b),
            ],
            axis=1,
        )
        base = jnp.concatenate([jnp.cross(spin_a[0], speed), jnp.cross(spin_a[0], spin_b[0])])

        def step(bent, body):
            i, parent, rotation, place, added = body
            push, turned = _field(bent[parent], spin_a[parent], spin_b[parent])
            moved = jnp.concatenate([(push + turned @ place) @ rotation, bent[parent, 3:] @ rotation])
            return bent.at[i + 1].set(moved + added), None

        parents = jnp.asarray([p + 1 for p in tree.parents])
        first = jnp.zeros((len(parents) + 1, 6), b.dtype).at[0].set(base)
        return jax.lax.scan(step, first, (jnp.arange(len(parents)), parents, *joints, own))[0]

    def _swept(self, joints: Joints, first: Float[Array, "k1 6"], own: Float[Array, "k 6"]) -> Float[Array, "k1 6"]:
        """Twists passed on along the tree from `first`, that of the base, each body adding its `own`."""

        def step(twists, body):
            i, parent, rotation, place, added = body
            speed, spin = twists[parent, :3], twists[parent, 3:]
            moved = jnp.concatenate([(speed + jnp.cross(spin, place)) @ rotation, spin @ rotation])
            return twists.at[i + 1].set(moved + added), None

        parents = jnp.asarray([p + 1 for p in self.tree.parents])
        return jax.lax.scan(step, first, (jnp.arange(len(parents)), parents, *joints, own))[0]

    def _rotors(self, a: Vector) -> Vector:
        felt = self.tree.armature.astype(a.dtype)
        return jnp.concatenate([jnp.zeros(6, a.dtype), felt * a[6:]]) if self.floating else felt * a

    def _moments(self, x: Configuration) -> Moments:
        tree = self.tree
        first = jnp.concatenate([tree.base_first[None], tree.first])
        second = jnp.concatenate([tree.base_second[None], tree.second])
        mass = jnp.concatenate([tree.base_mass[None], tree.mass])
        return Moments(*(part.astype(x.dtype) for part in (mass, first, second)))


def _momentum(moments: Moments, speed: Array, spin: Array) -> tuple[Array, Array]:
    """Momentum and angular momentum about the origin of each body."""
    mass, first, second = moments
    inertia = jnp.trace(second, axis1=1, axis2=2)[:, None, None] * jnp.eye(3, dtype=second.dtype)[None] - second
    linear = mass[:, None] * speed + jnp.cross(spin, first)
    return linear, jnp.cross(first, speed) + jnp.einsum("kij,kj->ki", inertia, spin)


def _field(bent: Float[Array, "... 6"], spin_a: Array, spin_b: Array) -> tuple[Array, Array]:
    """The field `n + W r` (3,), (3, 3) of the accelerations of the points of bodies: W = α× + (ω_b×)(ω_a×)."""
    push, turn = _split(bent)
    twice = spin_a[..., :, None] * spin_b[..., None, :]
    trace = jnp.trace(twice, axis1=-2, axis2=-1)
    entries = [[twice[..., i, j] for j in range(3)] for i in range(3)]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        entries[i][i] = entries[i][i] - trace
        entries[k][j] = entries[k][j] + turn[..., i]
        entries[j][k] = entries[j][k] - turn[..., i]
    return push, jnp.stack([jnp.stack(row, -1) for row in entries], -2)


def _resistance(moments: Moments, push: Array, turn: Array) -> tuple[Array, Array]:
    """Force `∫ρ N` and moments `∫ρ N rᵀ` (3, 3) of each body, for the field `N = push + turn r`."""
    mass, first, second = moments
    force = mass[:, None] * push + jnp.einsum("kij,kj->ki", turn, first)
    return force, push[:, :, None] * first[:, None, :] + turn @ second


def _wrench(force: Array, about: Array) -> Float[Array, "k1 6"]:
    """Force and moment `∫ρ r × N` of each body, from `∫ρ N rᵀ`."""
    return jnp.concatenate([force, jnp.stack([about[:, i - 1, i - 2] - about[:, i - 2, i - 1] for i in range(3)], 1)], 1)


def _about(about: Array, spin: Array) -> Array:
    """`∫ρ (ω × r) × N` of each body, from `∫ρ N rᵀ`."""
    trace = jnp.trace(about, axis1=1, axis2=2)[:, None]
    return jnp.einsum("kji,kj->ki", about, spin) - trace * spin


def _split(twists: Array) -> tuple[Array, Array]:
    return twists[..., :3], twists[..., 3:]


def _hat(a: Array) -> Array:
    """The matrices (..., 3, 3) of `r ↦ a × r`, for vectors a (..., 3)."""
    x, y, z = (a[..., i] for i in range(3))
    none = jnp.zeros_like(x)
    return jnp.stack([jnp.stack(row, -1) for row in ((none, -z, y), (z, none, -x), (-y, x, none))], -2)
