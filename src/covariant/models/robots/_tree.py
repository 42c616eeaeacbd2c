"""A tree of rigid bodies in numbers: what carries what, by which joints, and with which inertia."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float


class KinematicTree(eqx.Module):
    """Rigid bodies that hang on each other by joints of one axis, or by ball joints, the parents first.

    Body i turns about, or slides along, an axis through its own origin. It stands on body `parents[i]`, or on the base
    where this is −1. The joints stand at `θ = coordinates q + offset`, linear functions of the n coordinates q: so one
    may follow another. A ball joint is three bodies with one and the same frame, the first two without mass; each turns
    about one axis of that frame, at the rate that is a component of the spin of the joint in it. Where it stands is a
    rotation matrix, and not three angles.

    - `turn`, `slide` (k, 3): the axis, in the frame of the body; zero in the one that the joint does not do.
    - `rotation` (k, 3, 3), `place` (k, 3): of the frame of the body in that of its parent, at θ = 0.
    - `mass` (k,) [kg], `first` (k, 3) [kg m] and `second` (k, 3, 3) [kg m²]: moments `∫ρ`, `∫ρ r`, `∫ρ r rᵀ` about the
      origin of the body.
    - `base_mass` (), `base_first` (3,), `base_second` (3, 3): of the base, where it floats.
    - `balls`: the first of the three bodies of each ball joint, b of them.
    - `coordinates` (k, 3b + n): the rates of the joints for those of the velocity, spins of ball joints first; for the
      configuration the last n columns. `offset` (k,).
    - `armature` (3b + n,): inertia of the rotors, as felt at these rates [kg m² or kg].
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
    balls: tuple[int, ...] = eqx.field(default=(), static=True)

    def frames(self) -> np.ndarray:
        """In which body (k,) the axis of each body stands still: in itself, or in the last one of its ball joint."""
        found = np.arange(len(self.parents))
        for first in self.balls:
            found[first : first + 3] = first + 2
        return found

    def carried(self) -> np.ndarray:
        """Which bodies (k, k) each body carries, itself included."""
        k = len(self.parents)
        found = np.eye(k, dtype=bool)
        for i in reversed(range(k)):
            if self.parents[i] >= 0:
                found[self.parents[i]] |= found[i]
        return found


class Links(eqx.Module):
    """Where the frames of a robot's links are.

    - `names`, `bodies` (l of them): of each link, its name and the body it is part of, −1 for the base.
    - `rotation` (l, 3, 3), `place` (l, 3): of its frame in that of the body.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    bodies: tuple[int, ...] = eqx.field(static=True)
    rotation: Float[Array, "l 3 3"]
    place: Float[Array, "l 3"]

    def of(self, link: str) -> tuple[int, Float[Array, "3 3"], Float[Array, "3"]]:
        """Body, rotation and place of a link. Raises `ValueError` for a name that is none."""
        if link not in self.names:
            raise ValueError(f"there is no link {link!r}; there are {', '.join(self.names)}")
        i = self.names.index(link)
        return self.bodies[i], self.rotation[i], self.place[i]
