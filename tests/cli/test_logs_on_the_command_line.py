"""Commands on logs in other units, formats and clocks; columns that are optional; and nothing written on a failure."""

import sys

import pytest

from covariant.models import ModelError, load

MODEL = """
system = "machines_for_logs:arm"
[parameters]
mass = 1.2
[columns]
t = "time"
q = ["angle"]
u = ["torque"]
v = ["speed"]
[units]
t = "ms"
q = "deg"
u = ["-1 mN m"]
v = "rpm"
[measurement]
std = 1e-4
[uncertainty]
acceleration = 1.0
"""
MACHINES = """
from covariant.models import pendulum_chain

def arm(mass: float = 1.0):
    return pendulum_chain(mass=[mass], length=[0.5])
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A model file beside the module that it names, in another folder than the one that commands run in."""
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "arm.toml").write_text(MODEL)
    (tmp_path / "model" / "machines_for_logs.py").write_text(MACHINES)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.delitem(sys.modules, "machines_for_logs", raising=False)
    return tmp_path


def test_a_model_file_that_names_code_says_what_is_wrong_there(folder):
    path = folder / "model" / "arm.toml"
    assert load(str(path)).model.coordinates == ("q1",)
    for old, new, words in (
        ("machines_for_logs:arm", "machines_for_logs:leg", "unknown attribute of module 'machines_for_logs' 'leg'"),
        ("machines_for_logs:arm", "no_such_module:arm", "module 'no_such_module' is not in the folder of the file"),
        ("mass = 1.2", "weight = 1.2", "unknown parameter of machines_for_logs:arm 'weight'"),
    ):
        path.write_text(MODEL.replace(old, new))
        with pytest.raises(ModelError, match=words):
            load(str(path))
