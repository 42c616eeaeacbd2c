"""Computes the configuration space of a tree of rigid bodies by sweeps along the tree.

A configuration embeds a machine in the flat space of its mass points, where its kinetic energy is a quadratic form. All
geometry follows from the twists of the bodies, a linear function of the velocity, and from their change along a motion.
Sums over mass points reduce to mass, first and second moment of each body. Curvature is computed as for a submanifold
(Gauss), so an inertia matrix is never differentiated.

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
from covariant.models.robots._tree import KinematicTree, Links

Configuration = Inexact[Array, "..."]
UPPER = np.triu(np.ones((3, 3), bool))


class Joints(NamedTuple):
    """Position of each body on its parent in a configuration.

    Attributes:
        rotation: Rotation (k, 3, 3) of the frame of the body in that of its parent.
        place: Origin (k, 3) of the frame of the body in that of its parent [m].

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.models import robots
        >>> robots.load("double_pendulum").space.joints(jnp.zeros(2)).place[1].round(6).tolist()
        [0.0, 0.0, -0.3]
    """

    rotation: Float[Array, "k 3 3"]
    place: Float[Array, "k 3"]


class Moments(NamedTuple):
    """Mass and moments of bodies, as in `KinematicTree`, the base first.

    Attributes:
        mass: Mass (k + 1,) [kg].
        first: First moment (k + 1, 3) about the origin of the body [kg m].
        second: Second moment (k + 1, 3, 3) about the origin of the body [kg m²].

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.models.robots._space import Moments
        >>> Moments(jnp.ones(1), jnp.zeros((1, 3)), jnp.zeros((1, 3, 3))).mass.tolist()
        [1.0]
    """

    mass: Float[Array, "k1"]
    first: Float[Array, "k1 3"]
    second: Float[Array, "k1 3 3"]


class PointField(NamedTuple):
    """A vector `offset + gradient r` at each mass point r of each body, the base first.

    It also represents what is dual to such fields, sums of forces N on the mass points: `∫ρ N` and `∫ρ N rᵀ`.

    Attributes:
        offset: Value (k + 1, 3) at the origin of the body.
        gradient: Derivative (k + 1, 3, 3) with respect to r.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.models.robots._space import PointField
        >>> field = PointField(jnp.zeros((1, 3)), jnp.eye(3)[None])
        >>> (field.offset[0] + field.gradient[0] @ jnp.array([1.0, 2.0, 3.0])).tolist()
        [1.0, 2.0, 3.0]
    """

    offset: Float[Array, "k1 3"]
    gradient: Float[Array, "k1 3 3"]


class RobotSpace(AbstractSpace):
    """Configuration space of a tree of bodies: SE(3) × SO(3)ᵇ × coordinates, of which each factor may be absent.

    A configuration x is an array of the pose (4, 4) of a floating base, row by row, the rotation (3, 3) of each ball
    joint, and the coordinates q. A velocity is the twist (v, ω) of a floating base in its own frame, then the spin of
    each ball joint in the frame of the body that it carries, then q'.

    Attributes:
        tree: Bodies and joints.
        links: Frames of the links.
        manifold: Manifold of the configurations.
        floating: Whether the base floats.
        limits: Joint, and its lower and upper limit [rad or m], for each of the k positions of `joint_angles`; ±inf
            without a limit. The model does not stop a motion at a limit.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.models import robots
        >>> space = robots.load("double_pendulum").space
        >>> space.pose(jnp.zeros(2), "lower")[:3, 3].round(6).tolist()
        [0.0, 0.0, -0.3]
        >>> space.mass.round(6).item()
        1.0
    """

    tree: KinematicTree
    links: Links
    manifold: AbstractManifold = eqx.field(kw_only=True)
    floating: bool = eqx.field(default=False, static=True)
    limits: tuple[tuple[str, float, float], ...] = eqx.field(default=(), static=True)

    def lower(self, x: Configuration, a: Vector) -> Vector:
        """Momentum of a velocity, by one sweep along the tree.

        Args:
            x: Configuration.
            a: Velocity (n,).

        Returns:
            Covector (n,).
        """
        joints = self.joints(x)
        twists, gathered = jax.vjp(lambda b: self.twists(joints, b), a)
        momenta = jnp.concatenate(_momentum(self._bodies(x), *_split_twists(twists)), axis=1)
        # The transpose of the map from velocity to twists sums the momenta along the tree.
        return gathered(momenta)[0] + self._rotors(a)

    def __call__(self, x: Configuration) -> Matrix:
        """Inertia matrix, by composite bodies (Featherstone 2008, section 6.2).

        Args:
            x: Configuration.

        Returns:
            Matrix (n, n) for the components of the velocity.
        """
        tree, joints = self.tree, self.joints(x)
        parents = jnp.asarray([p + 1 for p in tree.parents], int)
        order = jnp.arange(len(tree.parents))

        def collect(whole, body):
            i, parent, rotation, place = body
            mass, first, second = whole.mass[i + 1], whole.first[i + 1], whole.second[i + 1]
            turned = rotation @ first
            aside = jnp.outer(turned, place)
            # Moments of the points R r + p, about the origin of the parent.
            moved = rotation @ second @ rotation.T + aside + aside.T + mass * jnp.outer(place, place)
            moved = jnp.where(UPPER, moved, moved.T)  # symmetric to the last bit, which halves the work when lowered
            return Moments(
                whole.mass.at[parent].add(mass),
                whole.first.at[parent].add(turned + mass * place),
                whole.second.at[parent].add(moved),
            ), None

        bodies = (order, parents, *joints)
        # In reverse, children come before parents: a composite body is complete when it is passed on.
        whole = jax.lax.scan(collect, self._bodies(x), bodies, reverse=True)[0]
        turn, slide = (axis.astype(x.dtype) for axis in (tree.turn, tree.slide))
        each = Moments(*(part[1:] for part in whole))
        # Momenta of the composite bodies, each for the unit rate of its joint.
        by_joint = jnp.concatenate(_momentum(each, slide, turn), axis=1)
        carried = jnp.asarray(tree.carried(), x.dtype)

        def lower_down(columns, body):
            i, rotation, place, turn, slide, momentum, carries = body
            columns = columns.at[i].set(momentum)
            force, moment = columns[:, :3], columns[:, 3:]
            row = carries * (force @ slide + moment @ turn)
            force = force @ rotation.T
            moved = jnp.concatenate([force, moment @ rotation.T + jnp.cross(place[None], force)], axis=1)
            # A body that is not carried here is on another branch: the frame of its momentum does not change.
            return jnp.where(carries[:, None] > 0.5, moved, columns), row

        bodies = (order, *joints, turn, slide, by_joint, carried)
        at_base, rows = by_joint, carried  # both are empty for a single body, for which JAX has no loop
        if tree.parents:
            at_base, rows = jax.lax.scan(lower_down, jnp.zeros_like(by_joint), bodies, reverse=True)
        # Parents come first, so row i has its entries in the columns of the bodies that i carries: the upper triangle.
        matrix = jnp.where(np.tri(len(tree.parents), dtype=bool).T, rows, rows.T)
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

    def raise_(self, x: Configuration, mu: Vector) -> Vector:
        """Velocity of a momentum, the inverse of `lower`.

        Args:
            x: Configuration.
            mu: Covector (n,).

        Returns:
            Velocity (n,).
        """
        return _solve_leaves_first(self(x), mu)

    def connection_force(self, x: Configuration, a: Vector, b: Vector) -> Vector:
        """Covector `<∇_a b, ·>`: inertial force of the mass points for the change of b along a, summed over joints.

        Args:
            x: Configuration.
            a: Velocity (n,).
            b: Velocity (n,), with constant components.

        Returns:
            Covector (n,).
        """
        joints = self.joints(x)
        twists, gathered = jax.vjp(lambda w: self._all_twists(joints, w), b)
        spins = self._all_twists(joints, a)[:, 3:], twists[:, 3:]
        field = self._accelerations(joints, a, b, *spins, twists[0, :3])
        return gathered(_wrench(_resistance(self._moments(x), field)))[0]

    def curvature(self, x: Configuration, a: Vector, b: Vector, c: Vector) -> Vector:
        """Riemann curvature `R(a, b)c` by the equation of Gauss.

        `<R(a, b)c, w> = <II(a, w), II(b, c)> − <II(b, w), II(a, c)>` with the second fundamental form II. In
        `<II(a, w), II(b, c)>` the first factor may be all of `∂_a ∂_w` of the positions, as the second is normal to the
        rest.

        Args:
            x: Configuration.
            a: Velocity (n,).
            b: Velocity (n,).
            c: Velocity (n,).

        Returns:
            Velocity (n,).
        """
        joints, moments, matrix = self.joints(x), self._moments(x), self(x)
        twists, gathered = jax.vjp(lambda w: self._all_twists(joints, w), c)
        spin_a, spin_b, spin_c = self._all_twists(joints, a)[:, 3:], self._all_twists(joints, b)[:, 3:], twists[:, 3:]

        def normal(along, spin, inertia):
            """Inertial forces of mass points with these moments for `II(along, c)`."""
            field = self._accelerations(joints, along, c, spin, spin_c, twists[0, :3])
            # The tangential part is removed: its momentum is the inertial force gathered along the tree.
            within = _solve_leaves_first(matrix, gathered(_wrench(_resistance(moments, field)))[0])
            speed, twist = _split_twists(self._all_twists(joints, within))
            return _resistance(inertia, PointField(field.offset - speed, _plus_cross(field.gradient, -1, twist)))

        # The second term of Gauss's equation has a minus sign, which negated moments provide.
        onto = normal(b, spin_b, moments), normal(a, spin_a, jax.tree.map(jnp.negative, moments))

        def moved(w):
            speed, spin = _split_twists(self._all_twists(joints, w))
            pairs = (a, spin_a), (b, spin_b)
            return tuple(self._accelerations(joints, e, w, turn, spin, speed[0]) for e, turn in pairs)

        # `moved` is linear, so its transpose is the same at every w.
        return _solve_leaves_first(matrix, jax.vjp(moved, jnp.zeros_like(a))[1](onto)[0])

    def joints(self, x: Configuration) -> Joints:
        """Position of each body on its parent.

        Args:
            x: Configuration.

        Returns:
            Rotations and origins.
        """
        tree = self.tree
        parts = tree.rotation, tree.place, tree.turn, tree.slide
        rotation, place, turn, slide = (part.astype(x.dtype) for part in parts)
        angles = self.joint_angles(x)
        along = turn[:, :, None] * turn[:, None, :]
        turns = jnp.any(tree.turn != 0, axis=1)
        angle = jnp.where(turns, angles, 0.0)[:, None, None]
        eye = jnp.eye(3, dtype=x.dtype)[None]
        flat = jnp.where(turns[:, None, None], eye - along, 0.0)
        still = eye - flat
        # Rodrigues' formula; for a sliding joint `flat` and `turn` are zero, and it gives the identity.
        turned = still + jnp.cos(angle) * flat + jnp.sin(angle) * _hat(turn)
        if tree.balls:
            turned = turned.at[np.array(tree.balls)].set(self.ball_rotations(x))
        slid = jnp.sum(rotation * (slide * angles[:, None])[:, None, :], axis=2)
        return Joints(_product(rotation, turned), place + slid)

    def joint_angles(self, x: Configuration) -> Float[Array, "k"]:
        """Positions of the joints.

        Args:
            x: Configuration.

        Returns:
            Positions (k,) [rad or m]; 0 for the axes of ball joints.
        """
        coordinates, offset = (part.astype(x.dtype) for part in (self.tree.coordinates, self.tree.offset))
        balls = len(self.tree.balls)
        return coordinates[:, 3 * balls :] @ x.reshape(-1)[16 * self.floating + 9 * balls :] + offset

    def ball_rotations(self, x: Configuration) -> Float[Array, "b 3 3"]:
        """Rotations of the ball joints.

        Args:
            x: Configuration.

        Returns:
            Rotation (b, 3, 3) of the frame that each joint carries, relative to its pose at the identity.
        """
        start = 16 * self.floating
        return x.reshape(-1)[start : start + 9 * len(self.tree.balls)].reshape(-1, 3, 3)

    def joint_rates(self, a: Vector) -> Float[Array, "k"]:
        """Rates of the joints.

        Args:
            a: Velocity (n,).

        Returns:
            Rates (k,) [rad/s or m/s]; for a ball joint the components of its spin.
        """
        return self.tree.coordinates.astype(a.dtype) @ (a[6:] if self.floating else a)

    def pose(self, x: Configuration, link: str) -> Float[Array, "4 4"]:
        """Pose `T_world_link` of the frame of a link; the world is the frame of the root if the root is fixed.

        Args:
            x: Configuration.
            link: Name of the link.

        Returns:
            Matrix (4, 4).

        Raises:
            ValueError: There is no such link.
        """
        body, rotation, place = self.links.of(link)
        rotation, place = rotation.astype(x.dtype), place.astype(x.dtype)
        joints = self.joints(x)
        while body >= 0:  # from the link to the root
            rotation, place = joints.rotation[body] @ rotation, joints.rotation[body] @ place + joints.place[body]
            body = self.tree.parents[body]
        last = jnp.array([[0.0, 0.0, 0.0, 1.0]], x.dtype)
        pose = jnp.concatenate([jnp.concatenate([rotation, place[:, None]], axis=1), last])
        return x.reshape(-1)[:16].reshape(4, 4) @ pose if self.floating else pose

    def relative(self, x: Configuration, link: str, other: str) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
        """Rotation and origin of another link's frame in a link's frame, only through the joints between them.

        Args:
            x: Configuration.
            link: Name of the link.
            other: Name of the other link.

        Returns:
            Rotation (3, 3) and origin (3,) [m].

        Raises:
            ValueError: There is no such link.
        """
        joints, frames = self.joints(x), []
        for name in (link, other):
            body, rotation, place = self.links.of(name)
            frames.append((body, rotation.astype(x.dtype), place.astype(x.dtype)))
        while frames[0][0] != frames[1][0]:
            # Parents come first, so the later of two bodies does not carry the other one.
            later = int(frames[1][0] > frames[0][0])
            body, rotation, place = frames[later]
            rotation, place = joints.rotation[body] @ rotation, joints.rotation[body] @ place + joints.place[body]
            frames[later] = self.tree.parents[body], rotation, place
        (_, first, origin), (_, second, place) = frames
        return first.T @ second, first.T @ (place - origin)

    def jacobian(self, x: Configuration, link: str) -> Float[Array, "6 n"]:
        """Jacobian of a link: its twist (v, ω), in its own frame, per component of the velocity.

        Args:
            x: Configuration.
            link: Name of the link.

        Returns:
            Matrix (6, n).

        Raises:
            ValueError: There is no such link.
        """
        body, rotation, place = self.links.of(link)
        rotation, place, joints = rotation.astype(x.dtype), place.astype(x.dtype), self.joints(x)

        def twist(a: Vector) -> Float[Array, "6"]:
            speed, spin = _split_twists(self.twists(joints, a)[body + 1])
            # v @ R is Rᵀ v: it converts from the frame of the body to that of the link.
            return jnp.concatenate([(speed + jnp.cross(spin, place)) @ rotation, spin @ rotation])

        zero = self.manifold.zero(x)
        return jax.vmap(twist, out_axes=1)(jnp.eye(zero.shape[0], dtype=zero.dtype))

    @property
    def mass(self) -> Array:
        """Mass of the robot [kg], base included, as far as it has weight."""
        return self.tree.base_mass + jnp.sum(self.tree.mass) - self.tree.weightless

    def first_moment(self, x: Configuration, joints: Joints) -> Float[Array, "3"]:
        """First moment `∫ρ r` of the whole robot in the world, as far as it has weight.

        Args:
            x: Configuration.
            joints: Position of each body on its parent, `joints(x)`.

        Returns:
            Vector (3,) [kg m].
        """
        mass, first, _ = self._bodies(x)

        def collect(total, body):
            i, parent, rotation, place = body
            carried, moment = total[0][i + 1], total[1][i + 1]
            moved = rotation @ moment + carried * place
            return (total[0].at[parent].add(carried), total[1].at[parent].add(moved)), None

        parents = jnp.asarray([p + 1 for p in self.tree.parents], int)
        bodies = (jnp.arange(len(parents)), parents, *joints)
        (mass, first), _ = jax.lax.scan(collect, (mass, first), bodies, reverse=True)
        if not self.floating:
            return first[0]
        pose = x.reshape(-1)[:16].reshape(4, 4)
        return pose[:3, :3] @ first[0] + (mass[0] - self.tree.weightless.astype(x.dtype)) * pose[:3, 3]

    def twists(self, joints: Joints, a: Vector) -> Float[Array, "k1 6"]:
        """Twists (v, ω) of the base and of all bodies, each in its own frame: linear in the velocity.

        Args:
            joints: Position of each body on its parent.
            a: Velocity (n,).

        Returns:
            Twists (k + 1, 6), the base first [m/s, rad/s].
        """
        tree, rates = self.tree, self.joint_rates(a)[:, None]
        first = jnp.zeros((len(tree.parents) + 1, 6), a.dtype)
        if self.floating:
            first = first.at[0].set(a[:6])
        by_joint = jnp.concatenate([tree.slide.astype(a.dtype) * rates, tree.turn.astype(a.dtype) * rates], axis=1)
        return self._propagated(joints, first, by_joint)

    def _all_twists(self, joints: Joints, a: Vector) -> Float[Array, "k1 6"]:
        """The twists of the base, of the bodies, and of the rotors of ball joints."""
        balls = len(self.tree.balls)
        if not balls:
            return self.twists(joints, a)
        start = 6 * self.floating
        spins = a[start : start + 3 * balls].reshape(balls, 3)
        return jnp.concatenate([self.twists(joints, a), jnp.concatenate([jnp.zeros_like(spins), spins], axis=1)])

    def _accelerations(
        self, joints: Joints, a: Vector, b: Vector, spin_a: Array, spin_b: Array, speed: Float[Array, "3"]
    ) -> "PointField":
        """`∂_a ∂_b` of the positions of the mass points; linear in b, for constant components of b.

        `spin_a` and `spin_b` are the spins of the bodies, `speed` is that of the base, for the velocities a and b.
        """
        tree, rates_a, rates_b = self.tree, self.joint_rates(a)[:, None], self.joint_rates(b)[:, None]
        turn, slide = tree.turn.astype(b.dtype), tree.slide.astype(b.dtype)
        k1 = len(tree.parents) + 1
        # A sliding axis turns with its body, so the spin for one velocity turns the rate of the other (Coriolis).
        sliding = jnp.cross(spin_b[1:k1], slide * rates_a) + jnp.cross(spin_a[1:k1], slide * rates_b)
        # The axes of the three bodies of a ball joint are all fixed in the frame that the joint carries.
        frame_spin = spin_a[1 + tree.frames()] if tree.balls else spin_a[1:k1]
        spun = jnp.cross(frame_spin, turn * rates_b)

        def points(angular, spin_a, spin_b):
            """The matrix of `r ↦ α × r + ω_b × (ω_a × r)`."""
            # ω_b × (ω_a × r) = ω_a (ω_b·r) − (ω_a·ω_b) r.
            twice = jnp.outer(spin_a, spin_b)
            return _plus_cross(twice - jnp.trace(twice) * jnp.eye(3, dtype=twice.dtype), 1, angular)

        def step(bent, body):
            (field, angular), (i, parent, rotation, place, more, more_angular) = bent, body
            moved = (field.offset[parent] + field.gradient[parent] @ place) @ rotation + more
            turned = angular[parent] @ rotation + more_angular
            now = PointField(
                field.offset.at[i + 1].set(moved),
                field.gradient.at[i + 1].set(points(turned, spin_a[i + 1], spin_b[i + 1])),
            )
            return (now, angular.at[i + 1].set(turned)), None

        parents = jnp.asarray([p + 1 for p in tree.parents], int)
        # The base's twist has constant components in its own frame, so it changes only by that frame's rotation ω_a.
        angular = jnp.cross(spin_a[0], spin_b[0])
        none = jnp.zeros((k1, 3), b.dtype)
        start = PointField(
            none.at[0].set(jnp.cross(spin_a[0], speed)),
            jnp.zeros((*none.shape, 3), b.dtype).at[0].set(points(angular, spin_a[0], spin_b[0])),
        )
        bodies = (jnp.arange(len(parents)), parents, *joints, sliding, spun)
        field = jax.lax.scan(step, (start, none.at[0].set(angular)), bodies)[0][0]
        if not tree.balls:
            return field
        rotors = jax.vmap(lambda one, other: points(jnp.cross(one, other), one, other))(spin_a[k1:], spin_b[k1:])
        return PointField(jnp.concatenate([field.offset, 0 * spin_b[k1:]]), jnp.concatenate([field.gradient, rotors]))

    def _propagated(
        self, joints: Joints, first: Float[Array, "k1 6"], by_joint: Float[Array, "k 6"]
    ) -> Float[Array, "k1 6"]:
        """Propagate twists along the tree from `first`, the base's twist; each joint adds its entry of `by_joint`."""

        def step(twists, body):
            i, parent, rotation, place, added = body
            speed, spin = twists[parent, :3], twists[parent, 3:]
            moved = jnp.concatenate([(speed + jnp.cross(spin, place)) @ rotation, spin @ rotation])
            return twists.at[i + 1].set(moved + added), None

        parents = jnp.asarray([p + 1 for p in self.tree.parents], int)
        return jax.lax.scan(step, first, (jnp.arange(len(parents)), parents, *joints, by_joint))[0]

    def _rotors(self, a: Vector) -> Vector:
        inertia = self.tree.armature.astype(a.dtype)
        return jnp.concatenate([jnp.zeros(6, a.dtype), inertia * a[6:]]) if self.floating else inertia * a

    def _bodies(self, x: Configuration) -> Moments:
        """Moments of the base and of the bodies."""
        tree = self.tree
        first = jnp.concatenate([tree.base_first[None], tree.first])
        second = jnp.concatenate([tree.base_second[None], tree.second])
        mass = jnp.concatenate([tree.base_mass[None], tree.mass])
        return Moments(*(part.astype(x.dtype) for part in (mass, first, second)))

    def _moments(self, x: Configuration) -> Moments:
        """Moments of the base, of the bodies, and of the rotors of ball joints.

        A rotor with the reflected inertia J about every axis of a joint is a body without mass and with the second
        moment J/2, which turns as the joint does, independent of its carrier. A rotor of a single axis adds no
        curvature.
        """
        bodies, balls = self._bodies(x), len(self.tree.balls)
        if not balls:
            return bodies
        inertia = self.tree.armature[: 3 * balls : 3].astype(x.dtype)
        second = inertia[:, None, None] / 2 * jnp.eye(3, dtype=x.dtype)[None]
        rotors = Moments(0 * inertia, jnp.zeros((balls, 3), x.dtype), second)
        return jax.tree.map(lambda one, other: jnp.concatenate([one, other]), bodies, rotors)


def _solve_leaves_first(matrix: Matrix, mu: Vector) -> Vector:
    """Solve `matrix a = mu`, eliminating each joint before the joints that carry it, so that zeros between branches
    are preserved.

    Source: Featherstone 2008, section 6.5.
    """
    return solve(matrix[::-1, ::-1], mu[::-1])[::-1]


def _momentum(moments: Moments, speed: Array, spin: Array) -> tuple[Array, Array]:
    """Momentum and angular momentum about the origin of each body."""
    mass, first, second = moments
    inertia = _rotational_inertia(second)
    linear = mass[:, None] * speed + jnp.cross(spin, first)
    return linear, jnp.cross(first, speed) + jnp.sum(inertia * spin[:, None, :], axis=2)


def _rotational_inertia(second: Float[Array, "k1 3 3"]) -> Float[Array, "k1 3 3"]:
    """The inertia tensors `tr(S) − S` of second moments S, entry by entry.

    The moment of a body along an axis does not contribute to its inertia about that axis; a trace would add and
    subtract it, with a rounding error.
    """
    others = [
        [second[:, j, j] + second[:, k, k] if i == m else -second[:, i, m] for m in range(3)]
        for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1)))
    ]
    return jnp.stack([jnp.stack(row, -1) for row in others], -2)


def _resistance(moments: Moments, field: PointField) -> PointField:
    """`∫ρ N` and `∫ρ N rᵀ` of each body, for the field `N = offset + gradient r`."""
    mass, first, second = moments
    force = mass[:, None] * field.offset + jnp.sum(field.gradient * first[:, None, :], axis=2)
    return PointField(force, field.offset[:, :, None] * first[:, None, :] + _product(field.gradient, second))


def _wrench(resisted: PointField) -> Float[Array, "k1 6"]:
    """Force `∫ρ N` and moment `∫ρ r × N` of each body."""
    force, dual = resisted
    # Negative indices work cyclically: entry 0 is r₁N₂ − r₂N₁, and so on.
    moment = [dual[:, i - 1, i - 2] - dual[:, i - 2, i - 1] for i in range(3)]
    return jnp.concatenate([force, jnp.stack(moment, axis=1)], axis=1)


def _plus_cross(matrix: Array, sign: int, a: Array) -> Array:
    """The matrix (..., 3, 3) of `r ↦ matrix r ± a × r`, entry by entry."""
    entries = [[matrix[..., i, j] for j in range(3)] for i in range(3)]
    for i in range(3):
        j, k = ((i + 1) % 3, (i + 2) % 3)[::sign]
        entries[k][j] = entries[k][j] + a[..., i]
        entries[j][k] = entries[j][k] - a[..., i]
    return jnp.stack([jnp.stack(row, -1) for row in entries], -2)


def _product(a: Array, b: Array) -> Array:
    """The matrix products (k, 3, 3), written out, as XLA 0.9 fails to compile some nested batches of small products."""
    return jnp.sum(a[:, :, :, None] * b[:, None, :, :], axis=2)


def _split_twists(twists: Array) -> tuple[Array, Array]:
    return twists[..., :3], twists[..., 3:]


def _hat(a: Array) -> Array:
    """The matrices (k, 3, 3) of `r ↦ a × r`, for vectors a (k, 3)."""
    return _plus_cross(jnp.zeros((*a.shape, 3), a.dtype), 1, a)
