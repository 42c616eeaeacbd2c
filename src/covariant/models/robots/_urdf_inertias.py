"""URDF files with other inertias of links."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree

from covariant.models._names import refuse_unknown
from covariant.models.robots._library import located
from covariant.models.robots._xml import name_of, parse

KEYS = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")


def urdf_with_inertias(path: str | Path, inertia: Mapping[str, Sequence[float]]) -> str:
    """Text of a URDF file with other inertias; everything else stays, but for comments.

    Args:
        path: Path of the file, or the name of one of `ROBOTS`.
        inertia: The ten numbers of `OF_INERTIA`, by link, in the frame of the link.

    Returns:
        The text.

    Raises:
        ValueError: The file is no URDF, or has no such link.

    Example:
        >>> from covariant.models import robots
        >>> numbers = (1.0, 0.0, 0.0, -0.1, 0.01, 0.01, 0.001, 0.0, 0.0, 0.0)
        >>> '<mass value="1.0"' in robots.urdf_with_inertias("double_pendulum", {"lower": numbers})
        True
    """
    robot = parse(located(path))
    if name_of(robot) != "robot":
        raise ValueError(f"{path}: a URDF file begins with <robot>; found <{name_of(robot)}>")
    links = {link.get("name", ""): link for link in robot.findall("link")}
    for name, numbers in inertia.items():
        refuse_unknown(f"link of {path}", name, links)
        link = links[name]
        for old in link.findall("inertial"):
            link.remove(old)
        mass, *rest = (float(number) for number in numbers)
        new = ElementTree.Element("inertial")
        ElementTree.SubElement(new, "origin", xyz=" ".join(map(repr, rest[:3])), rpy="0 0 0")
        ElementTree.SubElement(new, "mass", value=repr(mass))
        ElementTree.SubElement(new, "inertia", {key: repr(value) for key, value in zip(KEYS, rest[3:], strict=True)})
        link.insert(0, new)
    ElementTree.indent(robot)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(robot, encoding="unicode") + "\n"
