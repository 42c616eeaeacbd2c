"""`covariant model`: what is in a robot's file and in its metric."""

import sys

import pytest

from covariant.cli import main


def test_what_is_refused_is_one_line(tmp_path, capsys, monkeypatch):
    (tmp_path / "robot.urdf").write_text("<robot><link name='a'/><joint name='j' type='hinge'/></robot>")
    monkeypatch.setattr(sys, "argv", ["covariant", "model", str(tmp_path / "robot.urdf")])
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 2
    assert "unknown type 'hinge'" in capsys.readouterr().err
