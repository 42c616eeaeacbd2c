"""Closed loops of robots: the same constraints as MuJoCo's, the motion of a DAE with multipliers, refusals by name."""

import pytest

from covariant.models import robots

LINK = (
    '<link name="{0}"><inertial><mass value="{1}"/><origin xyz="{2} 0 0"/>'
    '<inertia ixx="{3}" iyy="{3}" izz="{3}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
)
JOINT = (
    '<joint name="{0}" type="continuous"><parent link="{1}"/><child link="{2}"/>'
    '<origin xyz="{3} 0 0" rpy="{4} 0 0"/><axis xyz="{5}"/></joint>'
)
BUILT = {"crank": 0.328, "coupler": 0.271, "rocker": 1.151}


def urdf(folder, *parts):
    path = folder / "robot.urdf"
    path.write_text(f'<robot name="r"><link name="base"/>{"".join(parts)}</robot>')
    return path


def four_bar(folder):
    """The shipped four-bar as a tree without friction."""
    return urdf(
        folder,
        LINK.format("crank", 0.5, 0.075, 0.002),
        LINK.format("coupler", 0.6, 0.2, 0.01),
        LINK.format("rocker", 0.8, 0.15, 0.008),
        JOINT.format("crank", "base", "crank", 0, 0, "0 -1 0"),
        JOINT.format("coupler", "crank", "coupler", 0.15, 0, "0 -1 0"),
        JOINT.format("rocker", "base", "rocker", 0.35, 0, "0 -1 0"),
    )


@pytest.mark.core(1)
@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"links": ["coupler", "rocker"]}, "needs links and points"),
        ({"links": ["coupler", "rocker"], "points": [[0.4, 0], [0.3, 0]]}, "two of three numbers"),
        ({"links": ["coupler", "roker"], "points": [[0.4, 0, 0], [0.3, 0, 0]]}, "Did you mean 'rocker'"),
        ({"joints": ["coupler", "roker"], "polynomial": [0.0, 1.0]}, "Did you mean 'rocker'"),
        ({"link": ["coupler"]}, "key of .loop.pin."),
    ],
)
def test_wrong_tables_are_named(tmp_path, table, message):
    with pytest.raises(ValueError, match=message):
        robots.load(four_bar(tmp_path), loops={"pin": table}, assembly=BUILT)


def test_a_joint_that_closes_a_loop_is_written_as_a_table(tmp_path):
    path = four_bar(tmp_path)
    closing = JOINT.format("pin", "coupler", "rocker", 0.4, 0, "0 -1 0")
    path.write_text(path.read_text().replace("</robot>", f"{closing}</robot>"))
    with pytest.raises(ValueError, match=r"close a loop; leave 'pin' out, and write a table \[loop.pin\]"):
        robots.load(path)
