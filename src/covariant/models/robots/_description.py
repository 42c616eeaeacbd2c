"""What a file says of a robot: its links, its joints and the forces in them, whatever the format."""

from typing import Any, NamedTuple

import numpy as np

MOST_TURNS = 4
"""Limits of a joint beyond so many turns are taken for degrees."""
SMALLEST_ENTRY = 1e-10
"""Entries of rotations below this are zero: quarter turns in files are rounded, and zeros cost nothing."""


class BodyInertia(NamedTuple):
    """Mass [kg], and first [kg m] and second [kg m²] moments `∫ρ r`, `∫ρ r rᵀ` about the origin of a frame."""

    mass: float
    first: np.ndarray
    second: np.ndarray

    @classmethod
    def of(cls, mass: float, centre: np.ndarray, about_centre: np.ndarray) -> "BodyInertia":
        """From the centre of mass and the inertia tensor (3, 3) about it, in the axes of the frame."""
        central = np.trace(about_centre) / 2 * np.eye(3) - about_centre
        return cls(mass, mass * centre, central + mass * np.outer(centre, centre))

    def moved(self, rotation: np.ndarray, place: np.ndarray) -> "BodyInertia":
        """The same body in a frame in which its own frame has this rotation and place."""
        first = rotation @ self.first
        aside = first[:, None] * place[None, :]
        second = rotation @ self.second @ rotation.T + aside + aside.T + self.mass * np.outer(place, place)
        return BodyInertia(self.mass, first + self.mass * place, second)

    def joined(self, other: "BodyInertia") -> "BodyInertia":
        """Of both bodies as one, in the same frame."""
        return BodyInertia(self.mass + other.mass, self.first + other.first, self.second + other.second)

    @property
    def about_centre(self) -> np.ndarray:
        """The inertia tensor (3, 3) about the centre of mass; that of no mass is zero."""
        central = self.second - np.outer(self.first, self.first) / self.mass if self.mass > 0 else self.second
        return np.trace(central) * np.eye(3) - central

    def with_mass(self, mass: Any, at: Any) -> "BodyInertia":
        """With a point mass [kg] at a place (3,) in addition."""
        return BodyInertia(self.mass + mass, self.first + mass * at, self.second + mass * at[:, None] * at[None, :])


NO_INERTIA = BodyInertia(0.0, np.zeros(3), np.zeros((3, 3)))


class Follows(NamedTuple):
    """A joint that follows another one: `θ = ratio θ_other + offset`; without a name of another, it stands still."""

    joint: str
    ratio: float
    offset: float


class Joint(NamedTuple):
    """A joint between two links.

    - `kind`: "revolute", "continuous" (a full circle), "prismatic", "planar" (in the plane normal to the axis),
      "ball", "floating" or "fixed". A floating joint carries the base of the robot; its frame is that of the parent.
    - `rotation` (3, 3), `place` (3,): of the frame of the child, which is that of the joint, in that of the parent,
      where the joint is at 0. `axis` (3,): in that frame, of unit length.
    - `damping` [N m s/rad or N s/m], `friction` [N m or N], `armature` [kg m² or kg], `stiffness` [N m/rad or N/m] of a
      spring that rests at `rest` [rad or m].
    - `reductions`: turns of each motor for one of the joint, or for 1 m, where they matter.
    - `lower`, `upper` [rad or m], `velocity` [rad/s or m/s], `effort` [N m or N]: limits, infinite where none is given.
    """

    name: str
    kind: str
    parent: str
    child: str
    rotation: np.ndarray
    place: np.ndarray
    axis: np.ndarray
    damping: float = 0.0
    friction: float = 0.0
    armature: float = 0.0
    stiffness: float = 0.0
    rest: float = 0.0
    lower: float = -np.inf
    upper: float = np.inf
    velocity: float = np.inf
    effort: float = np.inf
    follows: Follows | None = None
    reductions: tuple[float, ...] = ()


class Motor(NamedTuple):
    """A motor of a joint: `gain u − stiffness θ − damping θ' + constant` [N m or N], the input being u.

    - `name`: of the motor; `joint`: of the joint that it drives; `direction`: of its torque among the axes of that,
      for a ball joint a vector in the frame of the child.
    - `unsupported`: why it cannot be an input here, empty where it can.
    """

    name: str
    joint: str
    gain: float
    stiffness: float
    damping: float
    constant: float
    unsupported: str
    direction: tuple[float, ...] = (1.0,)


class Description(NamedTuple):
    """A robot as a file describes it.

    - `links`: the inertia of each link, in its own frame, by name; `joints`, each after the one that carries it.
    - `root`: the link that nothing carries.
    - `gravity` (3,) [m/s²], in the frame of the world.
    - `used`, `ignored`: how often each kind of entry of the file was used, or has no meaning here.
    - `doubts`: sentences on what looks wrong in the file but does not keep it from being used.
    - `motors`: those that the file names; where there are none, every joint has an input.
    - `motor_torques`: the inputs are torques of the motors, before the reductions of their joints.
    """

    name: str
    links: dict[str, BodyInertia]
    joints: tuple[Joint, ...]
    root: str
    gravity: np.ndarray
    used: dict[str, int]
    ignored: dict[str, int]
    doubts: tuple[str, ...]
    motors: tuple[Motor, ...] = ()
    motor_torques: bool = False


def exact(rotation: np.ndarray) -> np.ndarray:
    """A rotation without entries that are zero but for rounding."""
    return np.where(np.abs(rotation) < SMALLEST_ENTRY, 0.0, rotation)


def turn_about(axis: np.ndarray, angle: float) -> np.ndarray:
    """The rotation (3, 3) about a unit axis by an angle [rad]."""
    along = np.outer(axis, axis)
    hat = np.cross(axis, np.eye(3)).T
    return along + np.cos(angle) * (np.eye(3) - along) + np.sin(angle) * hat


def limits_in_doubt(joint: Joint) -> list[str]:
    """A sentence where the limits of a turning joint look like degrees."""
    farthest = max(abs(limit) for limit in (joint.lower, joint.upper))
    if joint.kind != "revolute" or not MOST_TURNS * 2 * np.pi < farthest < np.inf:
        return []
    return [
        f"joint {joint.name!r}: its limits are {joint.lower:g} and {joint.upper:g} rad, more than {MOST_TURNS} turns; "
        "are they degrees?"
    ]


def in_order(links: dict[str, BodyInertia], joints: list[Joint]) -> tuple[str, tuple[Joint, ...]]:
    """The root, and the joints with each after the one that carries it, otherwise as they are given.

    Raises `ValueError` where the links are no tree.
    """
    carrier: dict[str, Joint] = {}
    for joint in joints:
        for end in (joint.parent, joint.child):
            if end not in links:
                raise ValueError(f"joint {joint.name!r}: there is no link {end!r}")
        if joint.child in carrier:
            raise ValueError(
                f"link {joint.child!r} is carried by two joints, {carrier[joint.child].name!r} and {joint.name!r}: "
                "closed loops are not supported; cut the loop"
            )
        carrier[joint.child] = joint
    roots = [name for name in links if name not in carrier]
    if not roots:
        raise ValueError(f"no link is the root: the joints {', '.join(sorted(j.name for j in joints))} form a cycle")
    if len(roots) > 1:
        raise ValueError(
            f"the links {', '.join(roots)} are carried by no joint; a robot has one root: connect the others"
        )
    ordered: list[Joint] = []
    stack = [roots[0]]
    while stack:
        at = stack.pop()
        below = [joint for joint in joints if joint.parent == at]
        # Depth first, in the order of the file.
        if carrier.get(at) is not None:
            ordered.append(carrier[at])
        stack += [joint.child for joint in reversed(below)]
    if len(ordered) < len(joints):
        left = sorted({joint.name for joint in joints} - {joint.name for joint in ordered})
        raise ValueError(f"the joints {', '.join(left)} form a cycle")
    return roots[0], tuple(ordered)


def doubts_on(name: str, inertia: BodyInertia) -> list[str]:
    """Sentences on an inertia that no rigid body has. Raises `ValueError` where it is not even an inertia."""
    numbers = np.concatenate([[inertia.mass], inertia.first, inertia.second.ravel()])
    if not np.isfinite(numbers).all():
        raise ValueError(f"link {name!r}: mass, centre of mass and inertia must be finite numbers")
    if inertia.mass < 0:
        raise ValueError(f"link {name!r}: the mass must not be negative; got {inertia.mass:g} kg")
    moments = np.linalg.eigvalsh(inertia.about_centre)
    size = max(np.abs(moments).max(), np.abs(inertia.second).max(), 1e-12)
    if moments[0] < -1e-9 * size:
        raise ValueError(
            f"link {name!r}: the inertia about the centre of mass must not be negative; its principal moments are "
            + ", ".join(f"{m:.3g}" for m in moments)
            + " kg m²"
        )
    if moments[2] > (moments[0] + moments[1]) * (1 + 1e-6) + 1e-9 * size:
        return [
            f"link {name!r}: no rigid body has the principal moments of inertia "
            + ", ".join(f"{m:.3g}" for m in moments)
            + " kg m²: the largest exceeds the sum of the others"
        ]
    return []
