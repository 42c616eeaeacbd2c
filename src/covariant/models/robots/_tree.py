"""Stores trees of rigid bodies as arrays: their parents, joints and inertias."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from covariant._names import refuse_unknown


class KinematicTree(eqx.Module):
    """Rigid bodies connected by joints of one axis or by ball joints, with parents before children.

    Body i turns about, or slides along, an axis through its origin. Its parent is the body `parents[i]`, or the base if
    this is −1. The joint positions are `θ = coordinates q + offset`, linear functions of the n coordinates q, so one
    joint may follow another. A ball joint is three bodies with the same frame, the first two without mass. Each turns
    about one axis of that frame, at the rate of one component of the joint's spin in it. The position of a ball joint
    is a rotation matrix, not three angles.

    Attributes:
        parents: Parent of each of the k bodies, −1 for the base.
        turn: Axis (k, 3) of turning joints in the frame of the body; zero for sliding ones.
        slide: Axis (k, 3) of sliding joints in the frame of the body; zero for turning ones.
        rotation: Rotation (k, 3, 3) of the frame of the body in that of its parent, at θ = 0.
        place: Origin (k, 3) of the frame of the body in that of its parent [m], at θ = 0.
        mass: Mass `∫ρ` (k,) [kg].
        first: First moment `∫ρ r` (k, 3) about the origin of the body [kg m].
        second: Second moment `∫ρ r rᵀ` (k, 3, 3) about the origin of the body [kg m²].
        base_mass: Mass () of the base [kg], if it floats.
        base_first: First moment (3,) of the base [kg m].
        base_second: Second moment (3, 3) of the base [kg m²].
        coordinates: Joint rates per velocity component (k, 3b + n), spins of the b ball joints first; for the
            configuration, the last n columns apply.
        offset: Positions of the joints at q = 0 (k,) [rad or m].
        armature: Inertia of the rotors, reflected to the velocity components (3b + n,) [kg m² or kg].
        balls: First of the three bodies of each of the b ball joints.
        weightless: Part () of the base's mass that has no weight [kg], the armature of a floating joint.

    Example:
        >>> from covariant.models import robots
        >>> tree = robots.load("double_pendulum").space.tree
        >>> tree.parents, tree.turn.tolist()
        ((-1, 0), [[0.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
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
    balls: tuple[int, ...] = eqx.field(static=True)
    weightless: Float[Array, ""]

    def frames(self) -> np.ndarray:
        """The body in whose frame the axis of each body is fixed.

        Returns:
            Indices (k,): the body itself, or the last one of its ball joint.
        """
        bodies = np.arange(len(self.parents))
        for first in self.balls:
            bodies[first : first + 3] = first + 2
        return bodies

    def carried(self) -> np.ndarray:
        """Bodies that each body carries.

        Returns:
            Boolean matrix (k, k): entry (i, j) says whether body i carries body j, itself included.
        """
        k = len(self.parents)
        bodies = np.eye(k, dtype=bool)
        for i in reversed(range(k)):
            # From the last body to the first: the list of a body is complete when its parent takes it over.
            if self.parents[i] >= 0:
                bodies[self.parents[i]] |= bodies[i]
        return bodies


class Links(eqx.Module):
    """The frames of a robot's links in the bodies to which they belong.

    Attributes:
        names: Names of the l links.
        bodies: Body of each link, −1 for the base.
        rotation: Rotation (l, 3, 3) of the frame of the link in that of the body.
        place: Origin (l, 3) of the frame of the link in that of the body [m].

    Example:
        >>> from covariant.models import robots
        >>> robots.load("double_pendulum").space.links.names
        ('base', 'upper', 'lower')
    """

    names: tuple[str, ...] = eqx.field(static=True)
    bodies: tuple[int, ...] = eqx.field(static=True)
    rotation: Float[Array, "l 3 3"]
    place: Float[Array, "l 3"]

    def of(self, link: str) -> tuple[int, Float[Array, "3 3"], Float[Array, "3"]]:
        """Frame of a link.

        Args:
            link: Name of the link.

        Returns:
            Its body, and the rotation (3, 3) and origin (3,) of its frame in that of the body.

        Raises:
            ValueError: There is no such link.
        """
        refuse_unknown("link", link, self.names)
        i = self.names.index(link)
        return self.bodies[i], self.rotation[i], self.place[i]
