"""`covariant model`: what is in a robot's file and in its metric."""

from commands import refused


def test_what_is_refused_is_one_line(tmp_path):
    (tmp_path / "robot.urdf").write_text("<robot><link name='a'/><joint name='j' type='hinge'/></robot>")
    refused("model", tmp_path / "robot.urdf", named=["unknown type 'hinge'"])
