"""SECURITY.md: which files of a stranger run code, and which do not. Certificates are tried in `test_files.py`."""

import re
import sys
from pathlib import Path

import pytest

from covariant import logs, models

ROOT = Path(__file__).parents[2]
URDF = """<robot name="one"><link name="base"/><link name="arm"><inertial><origin xyz="0 0 0.1"/><mass value="1"/>
<inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="hinge" type="continuous"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/></joint></robot>"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with a module that leaves a mark where it is imported."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    for name in ("stranger", "pendulum_chain", "plugin"):
        (tmp_path / f"{name}.py").write_text("import pathlib\npathlib.Path('marker').touch()\nmake = None\n")
    yield tmp_path
    sys.modules.pop("stranger", None)


def test_a_model_file_that_names_a_module_runs_it(folder):
    (folder / "model.toml").write_text('system = "stranger:make"\n')
    with pytest.raises(ValueError, match="stranger:make"):  # None is no model, but the module has run
        models.load("model.toml")
    assert (folder / "marker").exists()


def test_other_files_run_nothing(folder):
    (folder / "model.toml").write_text('system = "pendulum_chain"\n[parameters]\nmass = [1.0]\nlength = [1.0]\n')
    (folder / "one.urdf").write_text(URDF)
    (folder / "log.csv").write_text("t,stranger:make\n0,1\n0.1,2\n0.2,3\n")
    models.load("model.toml")
    models.load("one.urdf")
    assert logs.survey("log.csv").columns
    assert not (folder / "marker").exists()
    assert not {"stranger", "pendulum_chain", "plugin"} & {*sys.modules}


def test_a_robot_file_declares_no_entities(folder):
    (folder / "one.urdf").write_text('<!DOCTYPE robot [<!ENTITY a SYSTEM "/etc/passwd">]>' + URDF)
    with pytest.raises(ValueError, match="document type or entities"):
        models.load("one.urdf")


def test_files_and_tests_that_the_page_names_exist():
    named = re.findall(r"`((?:\w+/)*\w+\.py)`", (ROOT / "SECURITY.md").read_text(encoding="utf-8"))
    assert len(named) > 8
    for name in named:
        places = (ROOT / name, ROOT / "src" / name, ROOT / "src" / "covariant" / name)
        assert any(place.exists() for place in places), name


def test_the_library_unpickles_only_what_its_own_cluster_sends():
    """No other reader of pickles, no other lookup of entry points, and no network in the source."""
    readers = r"pickle\.loads?\(|allow_pickle|entry_points\(|\burllib\b|(import|from) socket\b|\bsocket\.|np\.load\("
    for path in (ROOT / "src").rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        if path.name == "_source.py":  # for the models that installed packages declare
            text = text.replace("entry_points(group=ENTRY_POINTS)", "", 1)
        if path.name == "_cases.py":  # it sends functions to processes, which it starts, and to a cluster
            text = text.replace("pickle.loads(pickled)", "", 1)
        assert not re.search(readers, text), path
