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
        joints, along, moments = self.joints(x), self.joint_rates(a), self._moments(x)
        (_, spin), (twists, gathered) = _split(self.twists(joints, a)), jax.vjp(lambda w: self.twists(joints, w), b)
        force, moment = _resistance(moments, spin, *_split(twists), *_split(self._change(joints, along, b, twists)))
        return gathered(jnp.concatenate([force, moment], axis=1))[0]

    def curvature(self, x: Configuration, a: Vector, b: Vector, c: Vector) -> Vector:
        """`<R(a, b)c, w> = <II(a, w), II(b, c)> − <II(b, w), II(a, c)>` with the second fundamental form II (Gauss)."""
        joints, moments = self.joints(x), self._moments(x)
        along_a, along_b = self.joint_rates(a), self.joint_rates(b)
        (_, spin_a), (_, spin_b) = _split(self.twists(joints, a)), _split(self.twists(joints, b))
        twists = self.twists(joints, c)

        def bend(along, spin, direction):
            """`II(direction, c)`: force and moment of each body, and a function of the spin of another motion."""
            change = self._change(joints, along, c, twists) - self.twists(joints, self.connection(x, direction, c))
            both = *_split(twists), *_split(change)
            force, moment = _resistance(moments, spin, *both)
            # What it does in the motion of w: also by the change of w that the other motion's spin makes.
            return jnp.concatenate([force, moment], axis=1), lambda side: jnp.concatenate(
                [jnp.cross(force, side), _across(moments, side, spin, *both)], axis=1
            )

        of_b, beside_b = bend(along_b, spin_b, b)
        of_a, beside_a = bend(along_a, spin_a, a)

        def moved(w):
            twists = self.twists(joints, w)
            return twists, self._change(joints, along_a, w, twists), self._change(joints, along_b, w, twists)

        onto = beside_b(spin_a) - beside_a(spin_b), of_b, -of_a
        return self.raise_(x, jax.vjp(moved, jnp.zeros_like(a))[1](onto)[0])

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

    def _change(
        self, joints: Joints, rates: Float[Array, "k"], b: Vector, twists: Float[Array, "k1 6"]
    ) -> Float[Array, "k1 6"]:
        """How the components of `twists`, those at the velocity b, change as the joints move with `rates`."""
        tree, rates = self.tree, rates[:, None]
        turn, slide = tree.turn.astype(b.dtype) * rates, tree.slide.astype(b.dtype) * rates
        mine = self.joint_rates(b)[:, None]
        # What a body gets from its parent, in its own frame: without the motion of its own joint.
        speed = twists[1:, :3] - tree.slide.astype(b.dtype) * mine
        spin = twists[1:, 3:] - tree.turn.astype(b.dtype) * mine
        own = jnp.concatenate([jnp.cross(speed, turn) + jnp.cross(spin, slide), jnp.cross(spin, turn)], axis=1)
        return self._swept(joints, jnp.zeros_like(twists), own)

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


def _resistance(
    moments: Moments, along: Array, speed: Array, spin: Array, speed_change: Array, spin_change: Array
) -> tuple[Array, Array]:
    """Force and moment `∫ρ ∂u`, `∫ρ r × ∂u` of each body, u being the velocity of its points at a twist.

    The twist (speed, spin) changes by (speed_change, spin_change) in the frame of the body, which spins by `along`:
    `∂u = (speed_change + along × speed) + spin_change × r + along × (spin × r)`.
    """
    force, moment = _momentum(moments, speed_change + jnp.cross(along, speed), spin_change)
    force = force + jnp.cross(along, jnp.cross(spin, moments.first))
    return force, moment + jnp.cross(jnp.einsum("kij,kj->ki", moments.second, along), spin)


def _across(
    moments: Moments, side: Array, along: Array, speed: Array, spin: Array, speed_change: Array, spin_change: Array
) -> Array:
    """`∫ρ [∂u (r · side) − side (r · ∂u)]` for each body: what ∂u, as in `_resistance`, does to `side × (w × r)`."""
    _, first, second = moments
    bend = speed_change + jnp.cross(along, speed)
    of_side = jnp.einsum("kij,kj->ki", second, side)
    onto = jnp.cross(spin_change, of_side) + jnp.cross(along, jnp.cross(spin, of_side)) + bend * _dot(first, side)
    of_spin = jnp.einsum("kij,kj->ki", second, spin)
    trace = jnp.trace(second, axis1=1, axis2=2)[:, None]
    return onto - side * (_dot(bend, first) + _dot(along, of_spin) - trace * _dot(along, spin))


def _split(twists: Array) -> tuple[Array, Array]:
    return twists[..., :3], twists[..., 3:]


def _dot(a: Array, b: Array) -> Array:
    return jnp.sum(a * b, axis=-1, keepdims=True)


def _hat(a: Array) -> Array:
    """The matrices (k, 3, 3) of `r ↦ a × r`, for vectors a (k, 3)."""
    return jnp.swapaxes(jnp.cross(a[:, None, :], jnp.eye(3, dtype=a.dtype)[None]), -1, -2)
