"""Reading a robot's file, whatever its format."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from covariant.models._mechanical import MechanicalSystem
from covariant.models.robots._assemble import assemble
from covariant.models.robots._description import Description
from covariant.models.robots._urdf import read_urdf


def read(path: str | Path) -> Description:
    """What a URDF file says of a robot. Raises `ValueError`, one line with the path, for what is wrong in it."""
    try:
        return read_urdf(Path(path))
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror or error}; give the path of a URDF file") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def load(
    path: str | Path,
    *,
    floating: bool = False,
    lock: Mapping[str, float] | None = None,
    actuated: Sequence[str] | None = None,
) -> MechanicalSystem:
    """The mechanical system of a robot, from its URDF file.

    Coordinates are the joints that are not fixed, locked or following another one, by their names [rad or m]; those of
    type "continuous" are full circles. Inputs are the torques [N m] or forces [N] at them.

    - `floating`: the root link moves freely. A configuration is then its pose T_world_root (4, 4), row by row, followed
      by the joints, and a velocity its twist (v, ω) in its own frame, followed by the rates of the joints.
    - `lock`: joints that stand still, and where [rad or m].
    - `actuated`: names of the joints with an input, in the order of the joints; by default all.

    Gravity is 9.81 m/s² along −z of the root, or of the world. Friction of a joint is
    `damping v + friction (2/π) atan(100 v)`.

    Raises `ValueError`, one line with the path, for what is wrong in the file, and for names it does not have.
    """
    robot = read(path)
    try:
        return assemble(robot, floating=floating, lock=lock, actuated=actuated)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
