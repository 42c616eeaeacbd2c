"""Defines descriptions of robots, independent of the file format: links, joints and the forces in them."""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from covariant._door import MOST_COORDINATES, MOST_LINKS, check_count
from covariant._typing import Number
from covariant.models._parameters import AnyArray, namespace
from scalargraph.errors import InputError

MOST_TURNS = 4
"""Number of turns above which limits of a joint are suspected to be in degrees."""
SMALLEST_ENTRY = 1e-10
"""Entries of rotations below this count as zero: quarter turns in files are rounded, and zeros save work."""


class BodyInertia(NamedTuple):
    """Mass and moments of a rigid body about the origin of a frame.

    Attributes:
        mass: Mass [kg].
        first: First moment `∫ρ r` (3,) [kg m].
        second: Second moment `∫ρ r rᵀ` (3, 3) [kg m²].

    Example:
        >>> import numpy as np
        >>> from covariant.models import robots
        >>> rod = robots.BodyInertia.of(2.0, np.array([0.5, 0.0, 0.0]), np.diag([0.0, 0.1, 0.1]))
        >>> rod.first.tolist()
        [1.0, 0.0, 0.0]
        >>> rod.joined(rod).mass
        4.0
    """

    mass: Number
    first: AnyArray
    second: AnyArray

    @classmethod
    def of(cls, mass: Number, centre: AnyArray, about_centre: AnyArray) -> "BodyInertia":
        """Inertia of a body from its centre of mass.

        Args:
            mass: Mass [kg].
            centre: Centre of mass (3,) [m].
            about_centre: Inertia tensor (3, 3) about the centre of mass [kg m²], in the axes of the frame.

        Returns:
            The inertia about the origin of the frame.
        """
        # With the second moment S, I = tr(S) 1 − S, so tr(I) = 2 tr(S).
        trace = about_centre[0, 0] + about_centre[1, 1] + about_centre[2, 2]  # np.trace does not accept traced arrays
        central = trace / 2 * np.eye(3) - about_centre
        return cls(mass, mass * centre, central + mass * (centre[:, None] * centre[None, :]))

    def moved(self, rotation: np.ndarray, place: np.ndarray) -> "BodyInertia":
        """Transform the inertia to another frame.

        Args:
            rotation: Rotation (3, 3) from the present frame to the other one.
            place: Origin (3,) of the present frame in the other one [m].

        Returns:
            The inertia of the same body about the origin of the other frame.
        """
        first = rotation @ self.first
        # Moments of r' = R r + p; their sum over the body gives the terms of the parallel axis theorem.
        aside = first[:, None] * place[None, :]
        second = rotation @ self.second @ rotation.T + aside + aside.T + self.mass * np.outer(place, place)
        return BodyInertia(self.mass, first + self.mass * place, second)

    def joined(self, other: "BodyInertia") -> "BodyInertia":
        """Combine two bodies into one.

        Args:
            other: Inertia of the other body in the same frame.

        Returns:
            The inertia of both.
        """
        return BodyInertia(self.mass + other.mass, self.first + other.first, self.second + other.second)

    @property
    def about_centre(self) -> np.ndarray:
        """Inertia tensor (3, 3) about the centre of mass [kg m²]."""
        # A body without mass has no centre, and the quotient would be 0/0.
        central = self.second - np.outer(self.first, self.first) / self.mass if self.mass > 0 else self.second
        return np.trace(central) * np.eye(3) - central

    def with_mass(self, mass: Number, at: AnyArray) -> "BodyInertia":
        """Add a point mass.

        Args:
            mass: Mass [kg].
            at: Its place (3,) [m].

        Returns:
            The inertia of both.
        """
        return BodyInertia(self.mass + mass, self.first + mass * at, self.second + mass * at[:, None] * at[None, :])


NO_INERTIA = BodyInertia(0.0, np.zeros(3), np.zeros((3, 3)))


class Follows(NamedTuple):
    """A constraint by which a joint follows another one: `θ = ratio θ_other + offset`.

    Attributes:
        joint: Name of the other joint; empty for a joint that is fixed at the offset.
        ratio: Change of the joint per change of the other.
        offset: Position of the joint [rad or m] if the other is at 0.

    Example:
        >>> from covariant.models import robots
        >>> robots.Follows("left_finger", ratio=-1.0, offset=0.0).joint
        'left_finger'
    """

    joint: str
    ratio: float
    offset: float


class FrictionLaw(NamedTuple):
    """Friction of a joint that depends on speed and direction, for the rate v [rad/s or m/s].

    The force against the motion is `viscous v + (coulomb + stribeck exp(−(v/stribeck_velocity)²)) s + asymmetry s²`
    with `s = tanh(v/smoothing)`. Source: Armstrong-Hélouvry 1991, Control of Machines with Friction, chapter 2.

    Attributes:
        viscous: Viscous friction [N m s/rad or N s/m].
        coulomb: Coulomb friction [N m or N], the mean of both directions.
        asymmetry: Half the difference between the Coulomb friction forwards and backwards [N m or N].
        stribeck: Friction at rest in excess of the Coulomb friction [N m or N].
        stribeck_velocity: Speed at which this excess has fallen by a factor of e [rad/s or m/s].
        load: Coulomb friction per unit of the motor's torque, in a joint with a servo [1].
        load_external: Coulomb friction per unit of the weight's torque, in a joint with a servo [1]; both act as
            `|load_external τ_weight − load τ_motor|`, so friction is largest if the motor carries the weight.
        smoothing: Speed v0 [rad/s or m/s] up to which the Coulomb friction rises, as tanh(v/v0).

    Example:
        >>> from covariant.models import robots
        >>> robots.FrictionLaw(viscous=0.1, coulomb=0.5).smoothing
        0.02
    """

    viscous: Number = 0.0
    coulomb: Number = 0.0
    asymmetry: Number = 0.0
    stribeck: Number = 0.0
    stribeck_velocity: Number = 0.1
    load: Number = 0.0
    load_external: Number = 0.0
    smoothing: Number = 0.02


class Servo(NamedTuple):
    """A motor that receives a position command c and gives `on (clip(gain k e − damping v, ±limit) − back_emf v)`.

    The error is `e = c + offset − q`. The position q is the one that the servo reports, so an encoder offset of the
    joint does not enter. Friction and rotor of the gear belong to the joint.

    Attributes:
        stiffness: Torque k per unit of the error, for a gain of 1 [N m/rad or N/m].
        gain: The servo's own position gain, such as the number in its register [1].
        damping: Damping within the limit [N m s/rad or N s/m].
        feedforward: Torque per rate of the command [N m s/rad or N s/m].
        delay: Time from the stamp of a command until it acts [s].
        offset: Position that the servo adds to the command [rad or m].
        dead_band: Error below which it gives no torque [rad or m].
        limit: Largest torque, or force of a linear servo [N m or N]; infinite without a limit.
        back_emf: Damping while it is on that the limit does not affect [N m s/rad or N s/m].
        supply: Voltage of the drive [V]; 0 if no drive is stated.
        resistance: Resistance of the winding [Ω].
        torque_constant: Torque per current, at the joint [N m/A or N/A].
        pwm_limit: Largest fraction of the voltage that the drive uses [1].
        backlash: Backlash of the gear [rad or m]: the position of the link is known up to half of it.
        switch: Whether an input switches the motor on (1) and off (0).
        logged_supply: Whether an input is the voltage of the drive [V].
        command_scale: Change of the servo's position per unit of its command [1].

    Example:
        >>> from covariant.models import robots
        >>> robots.Servo(stiffness=20.0, delay=0.04).limit
        inf
    """

    stiffness: Number
    gain: Number = 1.0
    damping: Number = 0.0
    feedforward: Number = 0.0
    delay: Number = 0.0
    offset: Number = 0.0
    dead_band: Number = 0.0
    limit: Number = np.inf
    back_emf: Number = 0.0
    supply: Number = 0.0
    resistance: Number = 0.0
    torque_constant: Number = 0.0
    pwm_limit: Number = 1.0
    backlash: Number = 0.0
    switch: bool = False
    logged_supply: bool = False
    command_scale: Number = 1.0


class Joint(NamedTuple):
    """A joint between two links.

    Attributes:
        name: Name of the joint.
        kind: "revolute", "continuous" (a full circle), "prismatic", "planar" (in the plane normal to the axis), "ball",
            "floating" or "fixed". A floating joint carries the base of the robot; its frame is that of the parent.
        parent: Name of the link that carries it.
        child: Name of the link that it carries.
        rotation: Rotation (3, 3) of the child's frame, which is also the joint's, in the parent's frame if the joint is
            at 0.
        place: Origin (3,) of the child's frame in the parent's frame [m] if the joint is at 0.
        axis: Axis (3,) in the frame of the joint, of unit length.
        damping: Viscous friction [N m s/rad or N s/m].
        friction: Coulomb friction [N m or N].
        armature: Inertia of the rotor, reflected to the joint [kg m² or kg].
        stiffness: Stiffness of a spring [N m/rad or N/m].
        rest: Position at which the spring rests [rad or m].
        lower: Lower limit [rad or m]; −inf without one.
        upper: Upper limit [rad or m]; inf without one.
        velocity: Limit of the speed [rad/s or m/s]; inf without one.
        effort: Limit of the torque or force [N m or N]; inf without one.
        follows: Constraint by which it follows another joint; None without one.
        reductions: Turns of each motor per turn of the joint, or per 1 m, if they are needed.
        law: Friction that replaces `damping` and `friction`; None without one.
        encoder_offset: Offset to add to a logged position to get the true one [rad or m].
        torque_constant: Factor of the logged torque, force or input of the joint's motors.
        servo: The servo that drives it; None if its input is a torque or force.

    Example:
        >>> from covariant.models import robots
        >>> shoulder, elbow = robots.read("double_pendulum").joints
        >>> elbow.kind, elbow.parent, elbow.damping
        ('continuous', 'upper', 0.006)
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
    armature: Number = 0.0
    stiffness: float = 0.0
    rest: float = 0.0
    lower: float = -np.inf
    upper: float = np.inf
    velocity: float = np.inf
    effort: float = np.inf
    follows: Follows | None = None
    reductions: tuple[float, ...] = ()
    law: FrictionLaw | None = None
    encoder_offset: Number = 0.0
    torque_constant: Number = 1.0
    servo: Servo | None = None


class Motor(NamedTuple):
    """A motor of a joint, which gives `gain u − stiffness θ − damping θ' + constant` [N m or N] for the input u.

    Attributes:
        name: Name of the motor.
        joint: Name of the joint that it drives.
        gain: Torque or force for u = 1 [N m or N].
        stiffness: Stiffness of a servo [N m/rad or N/m].
        damping: Damping of a servo [N m s/rad or N s/m].
        constant: Constant torque or force [N m or N].
        unsupported: Reason why it cannot be an input here; empty if it can.
        direction: Direction of its torque among the axes of the joint; for a ball joint a vector (3,) in the frame of
            the child.
        limit: Largest torque or force [N m or N]; infinite without one.
        delay: Time from the stamp of an input until it acts [s].

    Example:
        >>> from covariant.models import robots
        >>> servo = robots.Motor("servo", "elbow", gain=5.0, stiffness=5.0, damping=0.1, constant=0.0, unsupported="")
        >>> servo.direction
        (1.0,)
    """

    name: str
    joint: str
    gain: Number
    stiffness: float
    damping: float
    constant: float
    unsupported: str
    direction: tuple[float, ...] = (1.0,)
    limit: float = np.inf
    delay: float = 0.0


class Coincide(NamedTuple):
    """A closed loop in which two points of two links coincide, or two whole frames.

    Attributes:
        name: Name of the loop.
        links: The two links.
        points: A point (3,) of each link, in its own frame [m].
        rotation: Rotation (3, 3) of the second link's frame in that of the first; None if only points coincide.

    Example:
        >>> from covariant.models import robots
        >>> robots.read("four_bar").loops[0].links
        ('coupler', 'rocker')
    """

    name: str
    links: tuple[str, ...]
    points: tuple[tuple[float, ...], ...]
    rotation: tuple[tuple[float, ...], ...] | None = None


class Coupled(NamedTuple):
    """A constraint between the positions of two joints, `one = c0 + c1 other + c2 other² + …`.

    Attributes:
        name: Name of the constraint.
        joints: The dependent joint, and the other one.
        polynomial: The coefficients c0, c1, c2, …

    Example:
        >>> from covariant.models import robots
        >>> robots.Coupled("cam", ("lift", "shaft"), (0.0, 0.0, 0.02)).joints
        ('lift', 'shaft')
    """

    name: str
    joints: tuple[str, ...]
    polynomial: tuple[float, ...]


class Description(NamedTuple):
    """A robot, as described by a file.

    Attributes:
        name: Name of the robot.
        links: Inertia of each link, in its own frame, by name.
        joints: The joints, each after the joint that carries it.
        root: Name of the link that no joint carries.
        gravity: Gravity (3,) in the frame of the world [m/s²].
        used: Number of entries of the file that were used, by kind.
        ignored: Number of entries of the file that have no meaning here, by kind.
        doubts: Sentences on entries of the file that look wrong but do not prevent its use.
        motors: Motors that the file names; without motors, every joint has an input.
        motor_torques: Whether the inputs are torques of the motors, before the reductions of their joints.
        loops: Couplings of links or joints in addition to the tree of the joints.
        assembly: Positions of the joints in a pose in which the loops are closed, by name [rad or m, a ball joint by
            its quaternion wxyz]; None if the file has no such pose.

    Example:
        >>> from covariant.models import robots
        >>> robot = robots.read("double_pendulum")
        >>> robot.root, list(robot.links)
        ('base', ['base', 'upper', 'lower'])
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
    loops: tuple[Coincide | Coupled, ...] = ()
    assembly: Mapping[str, Any] | None = None


def numbers(values: Iterable[Any]) -> Any:
    """An array of numbers, some of which may be traced."""
    listed = list(values)
    return namespace(listed).asarray(listed, float)


def exact(rotation: np.ndarray) -> np.ndarray:
    """A rotation (3, 3) or axis (3,) with entries below `SMALLEST_ENTRY` set to 0."""
    return np.where(np.abs(rotation) < SMALLEST_ENTRY, 0.0, rotation)


def rows(matrix: Iterable[Iterable[float]]) -> tuple[tuple[float, ...], ...]:
    """The rows of a matrix as tuples."""
    return tuple(tuple(float(entry) for entry in row) for row in matrix)


def turn_about(axis: np.ndarray, angle: Number) -> np.ndarray:
    """Rotation (3, 3) by an angle [rad] about an axis (3,) of unit length (Rodrigues' formula)."""
    projection = np.outer(axis, axis)
    hat = np.cross(axis, np.eye(3)).T
    return projection + np.cos(angle) * (np.eye(3) - projection) + np.sin(angle) * hat


def limits_in_doubt(joint: Joint) -> list[str]:
    """A sentence if the limits of a turning joint look like degrees."""
    largest = max(abs(limit) for limit in (joint.lower, joint.upper))
    if joint.kind != "revolute" or not MOST_TURNS * 2 * np.pi < largest < np.inf:
        return []
    return [
        f"joint {joint.name!r}: its limits are {joint.lower:g} and {joint.upper:g} rad, more than {MOST_TURNS} turns; "
        "are they degrees?"
    ]


def in_order(links: dict[str, BodyInertia], joints: list[Joint]) -> tuple[str, tuple[Joint, ...]]:
    """The root, and each joint after the joint that carries it; raises `ValueError` if the links are not a tree."""
    moving = sum(joint.kind != "fixed" for joint in joints)
    check_count(len(links), MOST_LINKS, "links")
    check_count(moving, MOST_COORDINATES, "joints that move")
    carrier: dict[str, Joint] = {}
    for joint in joints:
        for end in (joint.parent, joint.child):
            if end not in links:
                raise InputError(f"joint {joint.name!r}: there is no link {end!r}")
        if joint.child in carrier:
            raise InputError(
                f"link {joint.child!r} is carried by two joints, {carrier[joint.child].name!r} and {joint.name!r}: "
                f"they close a loop; leave {joint.name!r} out, and write a table [loop.{joint.name}] into a model "
                "file: two links and the point of each at which they meet"
            )
        carrier[joint.child] = joint
    roots = [name for name in links if name not in carrier]
    if not roots:
        raise InputError(f"no link is the root: the joints {', '.join(sorted(j.name for j in joints))} form a cycle")
    if len(roots) > 1:
        raise InputError(
            f"the links {', '.join(roots)} are carried by no joint; a robot has one root: connect the others"
        )
    ordered: list[Joint] = []
    stack = [roots[0]]
    while stack:
        link = stack.pop()
        below = [joint for joint in joints if joint.parent == link]
        # The order is depth first and, within a link, that of the file.
        if carrier.get(link) is not None:
            ordered.append(carrier[link])
        stack += [joint.child for joint in reversed(below)]
    if len(ordered) < len(joints):
        remaining = sorted({joint.name for joint in joints} - {joint.name for joint in ordered})
        raise InputError(f"the joints {', '.join(remaining)} form a cycle")
    return roots[0], tuple(ordered)


def negative_inertia(name: str, inertia: BodyInertia) -> str:
    """A sentence if a principal moment of inertia about the centre of mass is negative, else an empty text."""
    moments, size = _principal_moments(inertia)
    if moments[0] >= -1e-9 * size:
        return ""
    return (
        f"link {name!r}: the inertia about the centre of mass must not be negative; its principal moments are "
        + ", ".join(f"{m:.3g}" for m in moments)
        + " kg m²"
    )


def _principal_moments(inertia: BodyInertia) -> tuple[np.ndarray, float]:
    """Principal moments (3,) about the centre of mass, and the size to which their tolerances are relative."""
    moments = np.linalg.eigvalsh(inertia.about_centre)
    # The lower bound is for a body without mass.
    return moments, max(np.abs(moments).max(), np.abs(inertia.second).max(), 1e-12)


def doubts_on(name: str, inertia: BodyInertia) -> list[str]:
    """A sentence if no rigid body has these moments; raises `ValueError` if a number is out of range.

    A negative moment is only doubtful: it depends on the links fixed to this one, or to the ground, whether it matters.
    """
    numbers = np.array([inertia.mass, *inertia.first, *inertia.second.ravel()])
    if not np.isfinite(numbers).all():
        raise InputError(f"link {name!r}: mass, centre of mass and inertia must be finite numbers")
    if inertia.mass < 0:
        raise InputError(f"link {name!r}: the mass must not be negative; got {inertia.mass:g} kg")
    if negative := negative_inertia(name, inertia):
        return [negative]
    moments, size = _principal_moments(inertia)
    # Triangle inequality of principal moments, with a tolerance for the few digits in files.
    if moments[2] > (moments[0] + moments[1]) * (1 + 1e-6) + 1e-9 * size:
        return [
            f"link {name!r}: no rigid body has the principal moments of inertia "
            + ", ".join(f"{m:.3g}" for m in moments)
            + " kg m²: the largest exceeds the sum of the others"
        ]
    return []
