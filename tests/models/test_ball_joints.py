"""Ball joints of robots: MuJoCo's mechanics, attitudes in logs, what is refused. Laws of spaces hold for one too."""

from pathlib import Path

import pytest

from covariant.models import robots

ARM = Path(__file__).with_name("ball_arm.xml")
INERTIA = '<inertia ixx="0.02" ixy="0.001" ixz="0" iyy="0.03" iyz="0" izz="0.025"/>'
INERTIAL = f'<inertial><origin xyz="0.1 0.05 -0.2"/><mass value="2"/>{INERTIA}</inertial>'


def test_a_ball_joint_is_locked_at_the_identity_and_follows_none(tmp_path):
    with pytest.raises(ValueError, match=r"joint 'shoulder': a ball joint is locked at 0; got 0\.5"):
        robots.load(ARM, lock={"shoulder": 0.5})
    (tmp_path / "led.urdf").write_text(
        f'<robot name="led"><link name="base"/><link name="top">{INERTIAL}</link><joint name="tip" type="spherical">'
        '<parent link="base"/><child link="top"/><mimic joint="tip"/></joint></robot>'
    )
    with pytest.raises(ValueError, match="joint 'tip': a ball joint cannot follow another one"):
        robots.load(tmp_path / "led.urdf")
