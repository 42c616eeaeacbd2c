"""`covariant model`: what is in a robot's file and in its metric."""

from pathlib import Path

from commands import refused


def test_what_is_refused_is_one_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("robot.urdf").write_text("<robot><link name='a'/><joint name='j' type='hinge'/></robot>")
    refused("model", "robot.urdf", named=["unknown type 'hinge'"])
