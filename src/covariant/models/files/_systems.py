"""Lists the systems of this library and what sentences call their parts; checks names and paths of models.

It loads nothing heavy.
"""

import errno
import os
from os import PathLike
from pathlib import Path
from typing import NamedTuple

from covariant._names import unknown
from covariant.models.robots import ROBOTS
from scalargraph.errors import InputError

LOG_FILES = (".csv", ".txt", ".parquet", ".mcap", ".db3", ".bag")
"""Suffixes of logs, which users sometimes pass instead of a model."""
ROBOT_FILES = (".urdf", ".xml")
"""Suffixes of robot files."""
SYSTEMS = {
    "ball_and_beam": "systems._ball_and_beam:ball_and_beam",
    "cybership": "marine:cybership",
    "duffing": "systems._duffing:duffing",
    "free_body": "systems._heavy_top:free_body",
    "heavy_top": "systems._heavy_top:heavy_top",
    "hopping_leg": "systems._hopping_leg:hopping_leg",
    "hovercraft": "systems._hovercraft:hovercraft",
    "legged_base": "systems._legged_base:legged_base",
    "lorenz": "systems._lorenz:lorenz",
    "manoeuvring_ship": "marine:manoeuvring_ship",
    "odin": "marine:odin",
    "oscillator": "systems._oscillator:oscillator",
    "pendulum_chain": "systems._pendulum_chain:pendulum_chain",
    "robot": "robots:load",
    "satellite": "systems._satellite:satellite",
    "ship": "marine:ship",
    "supply_vessel": "marine:supply_vessel",
    "underwater_vehicle": "systems._underwater_vehicle:underwater_vehicle",
    "unknown_frequency": "systems._unknown_frequency:unknown_frequency",
}
"""The systems that a model file may name, and the functions that build them, as `module:function`."""


class Vocabulary(NamedTuple):
    """What sentences about a machine call its parts.

    Attributes:
        coordinate: One of its coordinates.
        inertia: Inertia that moves with one coordinate alone, beside that of the model.
        like_it: What looks like such an inertia.
    """

    coordinate: str = "coordinate"
    inertia: str = "added inertia"
    like_it: str = "too small a mass or inertia in the model"


PLAIN = Vocabulary()
"""Words for a machine of any kind."""
JOINTED = Vocabulary("joint", "rotor inertia", "too small an inertia of the links")
"""Words for links that joints connect and motors drive."""
OF_LINKS = ("hopping_leg", "legged_base", "pendulum_chain", "robot")
"""The systems of links; of a model from Python it is not known whether it is one."""


def check_spec(spec: str | PathLike[str]) -> None:
    """Refuse a path or name from which no model can be loaded, before anything heavy is loaded.

    Args:
        spec: A path (.toml, .urdf, .xml), the name of a system or a robot, or `module:attribute`, which is not checked.

    Raises:
        ValueError: One line that names the spec and suggests the nearest name.

    Example:
        >>> from covariant import models
        >>> models.check_spec("oscillator")
    """
    name = os.fspath(spec)
    if name in ROBOTS or name in SYSTEMS:
        return
    if name.endswith((".toml", *ROBOT_FILES)):
        if not Path(name).exists():
            what = "a model file"
            if name.endswith(ROBOT_FILES):
                what = f"a URDF or MJCF file, or one of {', '.join(ROBOTS)}"
            raise InputError(f"{name}: {os.strerror(errno.ENOENT)}; give the path of {what}")
    elif ":" not in name:
        raise InputError(f"{name}: {unknown_model(name)}")


def unknown_model(name: str) -> str:
    """Message for a name that is not a model."""
    if Path(name).suffix in LOG_FILES:
        return (
            f"unknown model {name!r}. The model comes first and then the log: did you swap them? A model is a .toml, "
            ".urdf or .xml file, module:attribute, or the name of a system or a robot"
        )
    if name.endswith(".xacro"):
        return f"is a xacro, which has to be expanded: xacro {name} > {Path(name).name.split('.')[0]}.urdf"
    if name.endswith((".sdf", ".world")):
        return "SDF is not read; write the model as URDF, or as MJCF, and give that file"
    return f"{unknown('model', name, (*SYSTEMS, *ROBOTS))}, a .toml, .urdf or .xml file, or module:attribute"
