"""Robots from files: the same mechanics as MuJoCo's, the same geometry as the space derived from the metric alone."""

import jax.numpy as jnp
import numpy as np
import pytest

from covariant.models import Motion, robots

QUARTER = "1.5707963267948966"


def inertial(xyz: str, mass: float, xx: float, yy: float, zz: float) -> str:
    moments = f'ixx="{xx}" ixy="0" ixz="0" iyy="{yy}" iyz="0" izz="{zz}"'
    return f'<inertial><origin xyz="{xyz}"/><mass value="{mass}"/><inertia {moments}/></inertial>'


SHOULDER = """<inertial><origin xyz="0.02 -0.03 0.1" rpy="0.3 -0.2 0.5"/><mass value="2.5"/>
  <inertia ixx="0.02" ixy="0.001" ixz="-0.002" iyy="0.03" iyz="0.0015" izz="0.025"/></inertial>"""
WRIST = inertial("0 0.05 0.02", 0.8, 0.002, 0.001, 0.0025)
ARM = f"""
<robot name="arm">
  <link name="base"/>
  <link name="shoulder">{SHOULDER}<visual/></link>
  <link name="slider">{inertial("0.1 0 0", 1.2, 0.004, 0.006, 0.007)}</link>
  <link name="flange">{inertial("0 0 0", 0.3, 1e-3, 1e-3, 1e-3)}</link>
  <link name="wrist">{WRIST}</link>
  <link name="elbow">{inertial("0 0.1 0", 0.9, 0.003, 0.001, 0.003)}</link>
  <joint name="turn" type="continuous">
    <origin xyz="0 0 0.4" rpy="0.2 0.1 -0.3"/><parent link="base"/><child link="shoulder"/><axis xyz="0 0 2"/>
    <dynamics damping="0.5" friction="0.2"/>
  </joint>
  <joint name="slide" type="prismatic">
    <origin xyz="0.1 0 0.2" rpy="{QUARTER} 0 0.4"/><parent link="shoulder"/><child link="slider"/><axis xyz="1 1 0"/>
    <limit lower="-0.5" upper="0.5" effort="30" velocity="2"/>
  </joint>
  <joint name="mount" type="fixed">
    <origin xyz="0.2 0.1 0" rpy="0.1 0 0.7"/><parent link="slider"/><child link="flange"/>
  </joint>
  <joint name="roll" type="revolute">
    <origin xyz="0 0 0.1"/><parent link="flange"/><child link="wrist"/><axis xyz="1 0 0"/>
    <limit lower="-2" upper="2" effort="10" velocity="3"/>
  </joint>
  <joint name="bend" type="revolute">
    <origin xyz="-0.1 0 0.1" rpy="0 0.5 0"/><parent link="shoulder"/><child link="elbow"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="10" velocity="3"/>
  </joint>
</robot>
"""
NAMES = ("turn", "slide", "roll", "bend")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("robots")
    (folder / "arm.urdf").write_text(ARM)
    return folder


@pytest.fixture(scope="module")
def arm(folder):
    return robots.load(folder / "arm.urdf")


def state(model, seed: int):
    """A configuration and vectors (6, n)."""
    rng = np.random.default_rng(seed)
    n = len(model.coordinates)
    q = jnp.asarray(rng.uniform(-1, 1, n))
    if not model.manifold.commuting:
        rest = jnp.asarray(rng.normal(size=len(model.velocities) - n))
        q = model.manifold.retract(model.manifold.origin(), jnp.concatenate([rest, q]))
    return q, jnp.asarray(rng.normal(size=(6, model.manifold.zero(q).shape[0])))


WRONG = {
    "no link 'elbo'": ('<child link="elbow"/>', '<child link="elbo"/>'),
    "form a cycle": ('<parent link="base"/>', '<parent link="elbow"/>'),
    "carried by two joints": ('<child link="elbow"/>', '<child link="wrist"/>'),
    "mass must not be negative; got -0.8": ('<mass value="0.8"/>', '<mass value="-0.8"/>'),
    "inertia about the centre of mass must not be negative": ('ixx="0.004"', 'ixx="-0.004"'),
    "joint 'roll' moves no mass": (WRIST, ""),
    "unknown type 'hinge'": ('type="continuous"', 'type="hinge"'),
    "not readable XML": ("</robot>", ""),
    "document type or entities": ('<robot name="arm">', '<!DOCTYPE robot [<!ENTITY a "b">]><robot name="arm">'),
    "xyz must be three finite numbers; got '0 0 nan'": ('xyz="0 0 0.4"', 'xyz="0 0 nan"'),
    "the axis must have a direction": ('<axis xyz="0 0 2"/>', '<axis xyz="0 0 0"/>'),
    "<mass> and <inertia>": ('<mass value="0.3"/>', ""),
    "follows 'elbow_joint', and there is no such joint": (
        '<parent link="flange"/>',
        '<mimic joint="elbow_joint"/><parent link="flange"/>',
    ),
    "two joints are called 'turn'": ('<joint name="bend"', '<joint name="turn"'),
    "damping must not be negative": ('damping="0.5"', 'damping="-0.5"'),
    "lower limit 2.5 is above": ('lower="-2"', 'lower="2.5"'),
}


@pytest.mark.parametrize("words", WRONG)
def test_a_broken_file_gives_one_clear_line(words, tmp_path):
    path = tmp_path / "broken.urdf"
    old, new = WRONG[words]
    assert old in ARM
    path.write_text(ARM.replace(old, new))
    with pytest.raises(ValueError, match=r"broken\.urdf: ") as error:
        robots.load(path)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_entities_are_refused_in_any_encoding(tmp_path):
    path = tmp_path / "wide.urdf"
    path.write_text(
        '<?xml version="1.0" encoding="UTF-16"?><!DOCTYPE robot [<!ENTITY a "b">]><robot/>', encoding="utf-16"
    )
    with pytest.raises(ValueError, match="not text in UTF-8"):
        robots.read(path)


def test_names_that_the_robot_does_not_have_are_refused(folder):
    with pytest.raises(ValueError, match=r"unknown joint 'elbow'. Known: turn, slide, mount, roll, bend"):
        robots.load(folder / "arm.urdf", lock={"elbow": 0.0})
    with pytest.raises(ValueError, match="no joint moves"):
        robots.load(folder / "arm.urdf", lock=dict.fromkeys(NAMES, 0.0))


def test_what_was_used_and_what_was_not_is_counted(folder):
    found = robots.read(folder / "arm.urdf")
    assert found.used["joint"] == 5
    assert found.used["link/inertial"] == 5
    assert found.ignored == {"link/visual": 1}
    assert not found.doubts
    odd = ARM.replace('izz="0.007"', 'izz="0.07"')
    (folder / "odd.urdf").write_text(odd)
    assert "no rigid body has the principal moments" in robots.read(folder / "odd.urdf").doubts[0]


def test_motion_is_that_of_the_coordinates(arm):
    """Friction opposes every joint, and only those that have it."""
    q, (v, *_) = state(arm, 4)
    slow = np.asarray(arm.dissipation(q, 0 * v))
    np.testing.assert_array_equal(slow, 0)
    force = np.asarray(arm.dissipation(q, v))
    np.testing.assert_allclose(force[0], -0.5 * v[0] - 0.2 * 2 / np.pi * np.arctan(100 * v[0]), rtol=1e-12)
    np.testing.assert_array_equal(force[1:], 0)
    assert arm.state(Motion(q, v)).shape == (8,)


# Against MuJoCo, and the robots that come with the library


def test_a_mass_on_its_axis_is_told_from_no_mass(folder):
    path = folder / "needle.urdf"
    needle = f'<link name="base"/><link name="rod">{inertial("0 0 0.3", 0.5, 0.01, 0.01, 0.0)}</link>'
    joint = '<joint name="spin" type="{}">{}<parent link="base"/><child link="rod"/><axis xyz="0 0 1"/></joint>'
    path.write_text(f"<robot name='needle'>{needle}{joint.format('continuous', '')}</robot>")
    words = r"joint 'spin' moves 0\.5 kg, which have no moment of inertia about its axis 0 0 1: "
    with pytest.raises(ValueError, match=words):
        robots.load(path)
    assert robots.load(path, armature={"spin": 0.1}).coordinates == ("spin",)
    path.write_text(f"<robot name='needle'>{needle}{joint.format('fixed', '')}</robot>".replace("0 0 0.3", "0 0 0"))
    with pytest.raises(
        ValueError, match=r"the base moves 0\.5 kg, which have no moment of inertia about its axis 0 0 1: "
    ):
        robots.load(path, floating=True)
    double = '<link name="mid"/><joint name="one" type="continuous"><parent link="base"/><child link="mid"/></joint>'
    one = f'<link name="base"/><link name="rod">{inertial("0 0 0.3", 0.5, 0.01, 0.01, 0.01)}</link>{double}'
    two = '<joint name="two" type="continuous"><parent link="mid"/><child link="rod"/></joint>'
    path.write_text(f"<robot name='twice'>{one}{two}</robot>")
    with pytest.raises(ValueError, match=r"joint '(one|two)' and '(one|two)' can move together so that no mass moves"):
        robots.load(path)
