"""Changes parameters of a robot: friction, rotors, inertias, gravity, torque constants and encoder offsets."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from covariant._names import refuse_unknown
from covariant._typing import Number
from covariant.models._parameters import ANY_SIGN, POSITIVE, ZERO_OR_MORE, AnyArray, check_range, known, namespace
from covariant.models.robots._description import BodyInertia, Description, Joint, doubts_on, negative_inertia
from covariant.models.robots._loops import loops_of
from covariant.models.robots._servos import checked_law, with_servos
from scalargraph.errors import InputError

OF_INERTIA = ("mass", "cx", "cy", "cz", "ixx", "iyy", "izz", "ixy", "ixz", "iyz")
"""The ten inertial parameters of a link, in its frame: mass [kg], centre of mass [m], inertia about that [kg m²]."""


def changed(
    robot: Description,
    *,
    friction: Mapping[str, Mapping[str, Number]] | None = None,
    armature: Mapping[str, Number] | None = None,
    inertia: Mapping[str, Sequence[Number]] | None = None,
    gravity: Number | Sequence[Number] | None = None,
    torque_constants: Mapping[str, Number] | None = None,
    offsets: Mapping[str, Number] | None = None,
    servos: Mapping[str, Mapping[str, Any]] | None = None,
    loops: Mapping[str, Mapping[str, Any]] | None = None,
    assembly: Mapping[str, Any] | None = None,
) -> Description:
    """Replace parameters of a robot; see `load`.

    Args:
        robot: Description of the robot.
        friction: Fields of `FrictionLaw`, by joint.
        armature: Inertia of the rotor, by joint [kg m² or kg].
        inertia: The ten parameters of `OF_INERTIA`, by link.
        gravity: Its magnitude, in the direction of the file, or the vector (3,) [m/s²].
        torque_constants: Factor of the logged torque, by joint.
        offsets: Offset to add to a logged position, by joint [rad or m].
        servos: Keys of `[servo.JOINT]`, by joint.
        loops: Keys of `[loop.NAME]`, by name, in addition to the loops of the file.
        assembly: Positions of the joints in a pose in which the loops are closed.

    Returns:
        The changed description.

    Raises:
        ValueError: A joint or link does not exist, or a parameter is out of range; the message names the first one.
    """
    for name in (servos or {}).keys() & (armature or {}).keys():
        if "armature" in (servos or {})[name]:
            raise InputError(f"joint {name!r} has an armature in [servo.{name}] and in [parameters]; keep one of them")
    laws = {name: checked_law(name, fields) for name, fields in (friction or {}).items()}
    for what, named in (("friction", laws), ("armature", armature), ("torque_constants", torque_constants)):
        _check_joints(what, named or {}, robot.joints)
    _check_joints("offsets", offsets or {}, robot.joints)
    for what, named, least in (
        ("armature", armature, ZERO_OR_MORE),
        ("torque_constants", torque_constants, POSITIVE),
        ("offsets", offsets, ANY_SIGN),
    ):
        for name, value in (named or {}).items():
            check_range(f"{what} of {name!r}", value, least)

    def replaced(joint: Joint) -> Joint:
        return joint._replace(
            law=laws.get(joint.name, joint.law),
            armature=(armature or {}).get(joint.name, joint.armature),
            torque_constant=(torque_constants or {}).get(joint.name, joint.torque_constant),
            encoder_offset=(offsets or {}).get(joint.name, joint.encoder_offset),
        )

    links = dict(robot.links)
    for name, numbers in (inertia or {}).items():
        refuse_unknown("link of inertia", name, links)
        links[name] = inertia_of(name, numbers)
    robot = robot._replace(
        links=links,
        joints=tuple(replaced(joint) for joint in robot.joints),
        gravity=robot.gravity if gravity is None else _gravity(robot.gravity, gravity),
        loops=robot.loops + loops_of(loops or {}),
        assembly=robot.assembly if assembly is None else assembly,
    )
    return with_servos(robot, servos or {})


def inertia_of(name: str, numbers: Sequence[Number] | AnyArray) -> BodyInertia:
    """Inertia of a link from its ten inertial parameters.

    Args:
        name: Name of the link, for messages.
        numbers: The parameters of `OF_INERTIA`; they may be traced.

    Returns:
        The inertia about the origin of the link.

    Raises:
        ValueError: The number of parameters is not ten, or no physical body has them.
    """
    if len(numbers) != len(OF_INERTIA):
        raise InputError(f"inertia of {name!r}: give {', '.join(OF_INERTIA)}; got {len(numbers)} numbers")
    xnp = namespace(list(numbers))
    values = xnp.asarray(numbers, float)
    mass, centre, (xx, yy, zz, xy, xz, yz) = values[0], values[1:4], values[4:]
    tensor = xnp.stack([xnp.stack([xx, xy, xz]), xnp.stack([xy, yy, yz]), xnp.stack([xz, yz, zz])])
    inertia = BodyInertia.of(mass, centre, tensor)
    if known(values):
        doubts_on(name, inertia)
        if negative := negative_inertia(name, inertia):
            raise InputError(negative)
    return inertia


def numbers_of(inertia: BodyInertia) -> np.ndarray:
    """The ten inertial parameters of a link, the inverse of `inertia_of`.

    Args:
        inertia: Inertia about the origin of the link.

    Returns:
        The parameters (10,) of `OF_INERTIA`.
    """
    centre = inertia.first / inertia.mass if inertia.mass > 0 else np.zeros(3)
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = inertia.about_centre
    return np.array([inertia.mass, *centre, xx, yy, zz, xy, xz, yz])


def _gravity(direction: np.ndarray, gravity: Number | Sequence[Number]) -> Any:
    xnp = namespace(gravity)
    value = xnp.asarray(gravity, float)
    if value.shape not in ((), (3,)) or (known(value) and not np.isfinite(value).all()):
        raise InputError(f"gravity must be its magnitude or three numbers [m/s²], all finite; got {gravity!r}")
    size = float(np.linalg.norm(direction))
    return value if value.ndim else value * (direction / size if size else np.array([0.0, 0.0, -1.0]))


def _check_joints(what: str, named: Mapping[str, Any], joints: Sequence[Joint]) -> None:
    for name in named:
        refuse_unknown(f"joint of {what}", name, [joint.name for joint in joints])
