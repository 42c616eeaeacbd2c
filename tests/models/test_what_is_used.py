"""The report of a robot file says what was used: attributes by name, and other kinds of files."""

import re
from pathlib import Path

import pytest

from covariant import models
from covariant.models import robots

ARM = """<robot name="arm"><link name="base"/>
<link name="a"><inertial><origin xyz="0 0 0.2"/><mass value="1"/>
<inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.001"/></inertial></link>
<link name="b"><inertial><origin xyz="0 0 0.1"/><mass value="0.5"/>
<inertia ixx="0.004" ixy="0" ixz="0" iyy="0.004" iyz="0" izz="0.0003"/></inertial></link>
<joint name="j1" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="9" velocity="9"/><dynamics damping="0.1" friction="0.2"/></joint>
<joint name="j2" type="continuous"><parent link="a"/><child link="b"/><origin xyz="0 0 0.4"/><axis xyz="0 1 0"/></joint>
</robot>"""


def written(path: Path, text: str) -> str:
    path.write_text(text)
    return str(path)


@pytest.mark.parametrize(
    "tag", ["dynamics", "limit", "inertia", "mass", "axis", "parent", "child", "origin", "joint", "link"]
)
@pytest.mark.parametrize("key", ["rotor_inertia", "K", "iyx", "spring_reference", "mu"])
def test_attributes_that_nobody_asks_for_are_ignored_by_name(tag, key, tmp_path):
    assert robots.read(written(tmp_path / "arm.urdf", ARM)).ignored == {}
    found = robots.read(written(tmp_path / "more.urdf", re.sub(f"<{tag} ", f'<{tag} {key}="0" ', ARM, count=1)))
    (name,) = found.ignored
    assert name.endswith(f"{tag} {key}")
    assert not found.doubts


def test_a_product_of_inertia_that_is_given_twice_has_to_be_the_same(tmp_path):
    twice = ARM.replace('ixy="0"', 'ixy="0.0001" iyx="0.0001"', 1)
    assert not robots.read(written(tmp_path / "same.urdf", twice)).doubts
    (doubt,) = robots.read(written(tmp_path / "other.urdf", twice.replace('iyx="0.0001"', 'iyx="0.009"'))).doubts
    assert "iyx = 0.009 is ignored, and differs from ixy = 0.0001" in doubt


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("rod.urdf.xacro", "<robot/>", r"is a xacro, which has to be expanded: xacro .*rod.urdf.xacro > rod.urdf"),
        ("rod.xacro", "<robot/>", r"xacro .*rod.xacro > rod.urdf"),
        ("rod.sdf", "<sdf/>", "SDF is not read; write the model as URDF"),
        ("rod.urdf", ARM.replace('value="1"', 'value="${m}"'), "of a xacro that was not expanded: xacro FILE"),
        ("rod.urdf", ARM.replace('"0 0 0.4"', '"0 0 ${l}"'), "of a xacro that was not expanded: xacro FILE"),
        ("rod.urdf", ARM.replace('lower="-2"', 'lower="$(arg low)"'), "of a xacro that was not expanded"),
    ],
)
def test_files_of_other_kinds_get_the_line_that_helps(name, text, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        models.load(written(tmp_path / name, text))
