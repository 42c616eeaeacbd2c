"""Generated C of an earlier process is found again by what an observer computes, and never taken for another's."""

import json
import os
import shutil
import subprocess
import sys
import time

import pytest

from covariant._files import read_sealed, write_sealed
from covariant._programs import UNUSED, cache_folder
from covariant.engine import _cache
from covariant.engine._cache import cached_text
from covariant.engine._sources import ROOT, source_files
from covariant.lowering import LoweringError

PROCESS = """
import sys
import jax.numpy as jnp
import numpy as np
from covariant import models
from covariant.codegen import _program
from covariant.engine import Stream, run_log
from covariant.lowering import LoweringError
from covariant.observers import Intrinsic
from covariant.signals import Record

def counted(*arguments, lower=_program.lower_traced, **options):
    written.append(arguments)
    return lower(*arguments, **options)

written = []
_program.lower_traced = counted
t = np.linspace(0, 1, 50)
record = Record(t, np.ones((50, 2)), np.stack([np.sin(t), np.cos(t)], axis=1))
chain = models.pendulum_chain(viscous=(0.1, 0.2))

def own(mass):
    return models.Lagrangian(lambda q: jnp.diag(jnp.array([mass, 1.0])), lambda q: 9.81 * jnp.cos(q[0]))

"""


def python(script: str, folder) -> str:
    seed = str(time.time_ns() % 1000)
    environment = dict(os.environ, COVARIANT_CACHE=str(folder), PYTHONHASHSEED=seed)
    done = subprocess.run([sys.executable, "-c", PROCESS + script], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


RUN = """
for model in (chain, own(2.0)):
    observer = Intrinsic(model, 5.0, 8.0)
    done, engine = run_log(observer, record)
    assert engine == "c"
    print(done.estimate[-1].tolist(), type(done.info).__name__, done.info.result.tolist())
    stream = Stream(observer, np.zeros(2), 100.0, 2)
    assert stream.engine == "c"
    print([stream.step(0.02 * k, np.array([0.1 * k, 0.2]), np.ones(2)).tolist() for k in range(4)])
print(len(written), file=sys.stderr)
assert len(written) == {count}
"""


@pytest.mark.exhaustive
def test_a_second_process_writes_nothing_and_finds_the_same_to_the_bit(tmp_path):
    """Of a model of the library and of one of a user's own functions, for logs and for streams."""
    first = python(RUN.format(count=3 * 2), tmp_path)  # a stream takes the kernel of the logs
    assert python(RUN.format(count=0), tmp_path) == first
    # Entries that were cut short are written again.
    whole = {entry: entry.read_bytes() for entry in tmp_path.glob("*/*.json")}
    for entry, content in whole.items():
        entry.write_bytes(content[: len(content) // 2])
    assert python(RUN.format(count=3 * 2), tmp_path) == first
    assert whole == {entry: entry.read_bytes() for entry in tmp_path.glob("*/*.json")}
    assert not list(tmp_path.glob("*/tmp*"))


CHANGES = """
from covariant.engine import KernelForm
from covariant.engine._kernel import _prepared, prepared

def show(model, *gains, **settings):
    _prepared.cache_clear()  # in one process an equal observer is given again
    print(prepared(Intrinsic(model, *gains, **settings), KernelForm((2,), 2)).key)

show(own(2.0), 5.0, 8.0)
show(own(2.0), 5.0, 8.0)
show(own(2.0 + 2**-51), 5.0, 8.0)
show(own(2.0), 5.0, 8.000000000000002)
show(own(2.0), 5.0, 8.0, substeps=2)
show(own(2.0), 5.0, 8.0, order=2)
Intrinsic.bend = lambda self, at, drive, xi, v: drive
show(own(2.0), 5.0, 8.0)
"""


@pytest.mark.long
def test_whatever_changes_an_observer_changes_its_key(tmp_path):
    """A number of a function, a gain, a setting, and a method of the library that a script replaces."""
    first, again, *others = python(CHANGES, tmp_path).split()
    assert first == again
    assert len({first, *others}) == 1 + len(others) == 6


REFUSED = """
def refused(*arguments, **options):
    print("lowered")
    raise LoweringError("no graph")

_program.lower_traced = refused
print(run_log(Intrinsic(own(2.0), 5.0, 8.0), record)[1])
"""


@pytest.mark.exhaustive
def test_an_observer_without_a_graph_is_tried_once(tmp_path):
    assert python(REFUSED, tmp_path) == "lowered\njax: no graph\n"
    assert python(REFUSED, tmp_path) == "jax: no graph\n"


def test_only_what_was_asked_for_is_found(tmp_path, monkeypatch):
    monkeypatch.setenv("COVARIANT_CACHE", str(tmp_path))
    assert cached_text("this", lambda: "1") == "1"
    assert cached_text("this", lambda: "2") == "1"
    assert cached_text("that", lambda: "3") == "3"
    for other in ("[]", "{}", '{"c": 1}', '{"c": "1", "d": "2"}', "null", "{"):
        write_sealed(cache_folder() / "this.json", other.encode())
        assert cached_text("this", lambda other=other: other) == other
    for entry in ("this", "that"):  # C that is not what was written is no text, whatever it says
        (cache_folder() / f"{entry}.json").write_text('{"c": "patched"}')
        assert cached_text(entry, lambda: "4") == "4"
    shutil.copy(cache_folder() / "this.json", cache_folder() / "other.json")
    assert cached_text("other", lambda: "not that of this") == "not that of this"
    monkeypatch.setenv("COVARIANT_CACHE", "off")
    assert cached_text("this", lambda: "5") == "5"
    assert cached_text(None, lambda: "6") == "6"


def test_a_refusal_is_kept_and_raised_again(tmp_path, monkeypatch):
    def refuse():
        raise LoweringError("there is none")

    monkeypatch.setenv("COVARIANT_CACHE", str(tmp_path))
    for write in (refuse, lambda: "never asked for"):
        with pytest.raises(LoweringError, match="there is none"):
            cached_text("this", write)
    [entry] = cache_folder().iterdir()
    assert json.loads(read_sealed(entry)) == {"refused": "there is none"}


def test_a_full_disk_and_a_folder_that_cannot_be_written_change_no_result(tmp_path, monkeypatch):
    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setenv("COVARIANT_CACHE", str(tmp_path))
    monkeypatch.setattr(_cache, "write_sealed", full)
    assert cached_text("this", lambda: "7") == "7"
    assert not list(tmp_path.glob("*/*.json"))
    monkeypatch.setenv("COVARIANT_CACHE", "/dev/null/nowhere")
    assert cached_text("this", lambda: "8") == "8"


def test_what_nobody_has_read_for_long_is_evicted(tmp_path, monkeypatch):
    monkeypatch.setenv("COVARIANT_CACHE", str(tmp_path))
    folder = cache_folder()
    now, old = time.time(), time.time() - 1.1 * UNUSED
    ages = {f"old{ending}": (old, old) for ending in (".so", ".json", ".made", "-cache", ".tmp", ".txt")}
    ages |= {"read.so": (now, old), "made.so": (old, now)}
    for name, times in ages.items():
        (folder / name).write_text("")
        os.utime(folder / name, times)
    assert cached_text("this", lambda: "9") == "9"
    assert {file.name for file in folder.iterdir()} == {"this.json", "read.so", "made.so", "old.txt"}


def test_a_text_depends_on_every_file_that_writes_it():
    writers = {path.relative_to(ROOT).as_posix() for path in _cache._WRITERS}
    modules = [path for room in ("lowering", "engine") for path in (ROOT / room).rglob("*.py")]
    assert {path.relative_to(ROOT).as_posix() for path in modules} <= writers
    assert {"lowering/c/_c_writer.py", "lowering/templates/rows.c", "engine/templates/kernel.c"} <= writers


def test_files_are_modules_and_templates_and_nothing_that_pip_compiled(tmp_path):
    names = ["room/_a.py", "room/inner/_b.py", "room/templates/c.c", "room/templates/d.py", "_e.py"]
    others = ["room/templates/__pycache__/d.pyc", "room/__pycache__/_a.pyc", "room/py.typed", "other/_f.py"]
    for name in names + others:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    listed = source_files("room", "_e.py", root=tmp_path)
    assert [path.relative_to(tmp_path).as_posix() for path in listed] == sorted(names)
