"""Bad input gives one clear line on standard error and exit code 2, and nothing is written: what takes long."""

import pytest
from test_bad_input import folder, refused


def test_a_motion_that_escapes_is_not_written(folder, monkeypatch, capsys):
    arguments = ("simulate", "model.toml", "-o", "out/l.csv", "--duration", "0.02", "--v0", "1e300")
    assert "the motion leaves the finite numbers" in refused(monkeypatch, capsys, *arguments)
