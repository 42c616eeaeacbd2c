"""What an earlier process made of an observer is found again, and never taken for another."""

import enum
import os
import pickle
import re
import subprocess
import sys
import time
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant._programs import UNUSED, cache_folder
from covariant.engine import _recall
from covariant.engine._recall import digest, recalled
from covariant.lowering import _constants

# Without the type checks of the tests, which wrap the functions of the package.
PROCESS = """
import sys
import covariant
import numpy as np
from covariant import models
from covariant.observers import REGISTRY, Intrinsic
from covariant.engine import Stream, _kernel, _recall, run_log
from covariant.engine._recall import digest
from covariant.signals import Record

def key(observer, inputs=2):
    return digest(_kernel._Asked(observer, np.zeros(2), inputs, (), 1).told())

"""


def python(script: str, folder) -> str:
    environment = dict(
        os.environ, COVARIANT_CACHE=str(folder), PYTHONHASHSEED=str(np.random.default_rng().integers(99))
    )
    done = subprocess.run([sys.executable, "-c", PROCESS + script], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


KEYS = """
chain, panda = models.pendulum_chain(), models.robots.load("panda")
for model in (chain, models.heavy_top(), panda):
    for entry in REGISTRY:
        try:
            made = entry.make(model, 5.0, 8.0)
        except (TypeError, ValueError):  # it takes other numbers
            continue
        print(type(model).__name__, entry.name, key(made))
told = {
    "again": Intrinsic(models.pendulum_chain(), 5.0, 8.0),
    "gain": Intrinsic(chain, 5.0, 8.000000000000002),
    "mass": Intrinsic(models.pendulum_chain((1.0, 1.0 + 1e-15)), 5.0, 8.0),
    "substeps": Intrinsic(chain, 5.0, 8.0, substeps=2),
    "payload": Intrinsic(models.robots.load("panda", payload={"panda_link7": (1.0, 0.0, 0.0, 0.1)}), 5.0, 8.0),
}
for name, made in told.items():
    print("told", name, key(made))
print("told inputs", key(told["again"], 3))
mine = models.Lagrangian(lambda q: np.eye(2) * (2 + q[0] * 0), lambda q: q[0] * 0)
print("mine", key(Intrinsic(mine, 5.0, 8.0)))
"""


def test_keys_are_those_of_another_process_and_tell_observers_apart(tmp_path):
    first, second = python(KEYS, tmp_path).splitlines(), python(KEYS, tmp_path).splitlines()
    assert first == second
    keys = dict(line.rsplit(maxsplit=1) for line in first)
    assert keys.pop("mine") == "None"  # what a user's function does is not known
    assert keys.pop("told again") == keys["Lagrangian intrinsic"]
    assert "None" not in keys.values()
    assert len(keys) > 15
    assert len(set(keys.values())) == len(keys)


RUN = """
import jax

def traced(*words, **more):
    raise SystemExit("traced")

if "warm" in {words}:
    jax.make_jaxpr = traced
usual = "c" if {kept} else "jax: fewer than 100000 rows, and compiled C would not be kept"
observer = Intrinsic(models.pendulum_chain(viscous=(0.1, 0.2)), 5.0, 8.0)
t = np.linspace(0, 1, 50)
record = Record(t, np.ones((50, 2)), np.stack([np.sin(t), np.cos(t)], axis=1))
assert run_log(observer, record)[1] == usual
done, engine = run_log(observer, record, None, "c")
assert engine == "c"
print(np.asarray(done.estimate)[-1].tolist(), type(done.info).__name__, np.asarray(done.info.result).tolist())
stream = Stream(observer, np.zeros(2), 100.0)
assert stream.engine == "c"
print([stream.step(0.02 * k, np.array([0.1 * k, 0.2]), np.ones(2)).tolist() for k in range(4)])
"""


def test_a_second_process_traces_nothing_and_finds_the_same_to_the_bit(tmp_path):
    first = python(RUN.format(words=[], kept=True), tmp_path)
    made, _ = tmp_path.glob("*/*.made")  # for logs, with gains as arguments, and for streams
    assert python(RUN.format(words=["warm"], kept=True), tmp_path) == first
    # One that was cut short is made again, and is whole afterwards.
    whole = made.read_bytes()
    made.write_bytes(whole[:1000])
    assert python(RUN.format(words=[], kept=True), tmp_path) == first
    assert made.read_bytes() == whole
    assert not list(tmp_path.glob("*/tmp*"))
    assert python(RUN.format(words=[], kept=False), "off") == first


REFUSED = """
import jax
from covariant.lowering import LoweringError

def refused(*words, **more):
    print("traced")
    raise LoweringError("no graph")

jax.make_jaxpr = refused
record = Record(np.linspace(0, 1, 50), np.zeros((50, 2)), np.zeros((50, 2)))
print(run_log(Intrinsic(models.pendulum_chain(), 5.0, 8.0), record)[1])
mine = models.Lagrangian(lambda q: np.eye(2) * (2 + q[0] * 0), lambda q: q[0] * 0)
print(run_log(Intrinsic(mine, 5.0, 8.0), record)[1])
"""


def test_an_observer_without_a_graph_is_tried_once(tmp_path):
    said = "jax: no graph\njax: fewer than 100000 rows, and compiled C would not be kept\n"
    assert python(REFUSED, tmp_path) == f"traced\n{said}"
    assert python(REFUSED, tmp_path) == said


CHANGED = """
from covariant.observers import Copy, _intrinsic

observer = Intrinsic(models.pendulum_chain(), 5.0, 8.0)
changes = (
    (Intrinsic, "bend", lambda self, at, drive, xi, v: drive - self.model.space.curvature(at, xi, v, v)),
    (Intrinsic, "bend", Copy.init),
    (_intrinsic, "second_order", lambda space, q, e: e),
    (_intrinsic, "second_order", np.linalg.norm),
    (_intrinsic, "Intrinsic", type("Intrinsic", (Intrinsic,), {})),
    (_recall, "PACKAGES", ("covariant", "jax")),
)
for owner, name, change in changes:
    usual = getattr(owner, name)
    setattr(owner, name, change)
    print(key(observer))
    setattr(owner, name, usual)
    print(key(observer))
"""


def test_who_changes_the_library_is_not_given_what_it_would_have_made(tmp_path):
    said = python(CHANGED, tmp_path).split()
    assert said[::2] == ["None"] * 6
    assert len(set(said[1::2])) == 1
    assert len(said[1]) == 32


SINGLE = """
t = np.linspace(0, 1, 50, dtype=np.float32)
record = Record(t, np.ones((50, 2), np.float32), np.stack([np.sin(t), np.cos(t)], axis=1))
observer = Intrinsic(models.pendulum_chain(), 5.0, 8.0)
run_log(observer, Record(record.t.astype(float), record.u.astype(float), record.y.astype(float)))
done, engine = run_log(observer, record)
print(engine, done.estimate.dtype)
"""


def test_the_type_of_a_result_does_not_depend_on_what_is_kept(tmp_path):
    said = "jax: fewer than 100000 rows, in single precision float32\n"
    assert [python(SINGLE, folder) for folder in (tmp_path, tmp_path, "off")] == [said] * 3


class Pair(NamedTuple):
    """Two things."""

    first: object
    second: object


def outer(x):
    return lambda y: x + y


@pytest.fixture
def as_written(monkeypatch):
    """The type checks of the tests wrap the functions of the package, which is then not as its text says."""
    monkeypatch.setattr(_recall, "intact", lambda texts: True)


@pytest.mark.usefixtures("as_written")
def test_things_are_told_apart():
    """Each has a key, and it is its own."""
    one, two = np.array([1.0, 2.0]), np.array([1.0, 2.0], np.float32)
    things = [
        None, True, 1, 1.0, "1", b"1", 1j, (), (1,), [1], (1, (2,)), ((1, 2),), {"a": 1}, {"b": 1}, {"a": 1, "b": 2},
        one, two, one[:1], one[None], jnp.asarray(one), jnp.asarray(1.0), jnp.ones(()) * 1, np.float64(1.0),
        np.dtype(float), float, np.sin, jnp.sin, jax.nn.relu, partial(np.add, 1), partial(np.add, 2),
        _constants.compute, enum.Flag, np.array([1, 2]), np.array([True]),
        -0.0, 0.0, float("nan"), "a" * 3 + "b", ("aaa", "b"), ("aa", "ab"),
    ]  # fmt: skip
    keys = [digest(thing) for thing in things]
    assert None not in keys
    assert len(set(keys)) == len(keys)
    assert keys == [digest(thing) for thing in things]


@pytest.mark.usefixtures("as_written")
def test_what_cannot_be_told_has_no_key():
    class Local(eqx.Module):
        x: float

    class Hidden:
        __slots__ = ("x",)

    class Word(str):
        pass

    endless: list = []
    endless.append(endless)
    made = {"__name__": "covariant.engine._recall"}
    exec("def f(x): return x", made)
    assert digest(1) is not None
    for thing in (
        made["f"],
        Word("a"),
        re.compile("a"),
        iter([1]),
        lambda x: x,
        outer(1),
        Pair(1, 2),
        Local(1.0),
        Hidden(),
        {1, 2},
        np.array([None]),
        jax.random.key(0),
        endless,
        object(),
    ):
        assert digest(thing) is None
        assert digest((1, [thing])) is None


@pytest.mark.usefixtures("as_written")
def test_another_source_or_setting_has_another_key(monkeypatch):
    key = digest(1)
    with jax.enable_x64(False):
        assert digest(1) != key
    monkeypatch.setattr(_recall, "_source", lambda: "other")
    assert digest(1) != key


def test_only_what_was_asked_for_is_found(tmp_path, monkeypatch):
    monkeypatch.setenv("COVARIANT_CACHE", str(tmp_path))
    assert recalled("this", (int,), lambda: 1) == 1
    assert recalled("this", (int,), lambda: 2) == 1
    assert recalled("that", (int,), lambda: 3) == 3
    [place] = [p for p in tmp_path.glob("*/*.made") if pickle.loads(p.read_bytes()) == 1]
    place.write_bytes(pickle.dumps("a word"))
    assert recalled("this", (int,), lambda: 4) == 4
    monkeypatch.setenv("COVARIANT_CACHE", "off")
    assert recalled("this", (int,), lambda: 5) == 5


@pytest.mark.parametrize("folder", ["/dev/null/nowhere", "off"])
def test_without_a_folder_everything_is_made(folder, monkeypatch):
    monkeypatch.setenv("COVARIANT_CACHE", folder)
    assert recalled("this", (int,), lambda: 6) == 6


def test_what_cannot_be_written_is_made_all_the_same(tmp_path, monkeypatch):
    def full(*words):
        raise OSError(28, "No space left on device")

    monkeypatch.setenv("COVARIANT_CACHE", str(tmp_path))
    monkeypatch.setattr(_recall, "write_atomically", full)
    assert recalled("this", (int,), lambda: 7) == 7
    assert not list(tmp_path.glob("*/*.made"))


def test_what_nobody_has_loaded_for_long_is_let_go(tmp_path, monkeypatch):
    monkeypatch.setenv("COVARIANT_CACHE", str(tmp_path))
    folder = cache_folder()
    now, old = time.time(), time.time() - 1.1 * UNUSED
    ages = {"old.so": (old, old), "old.made": (old, old), "jit-cache": (old, old), "notes.txt": (old, old)}
    ages |= {"read.so": (now, old), "made.so": (old, now)}
    for name, times in ages.items():
        (folder / name).write_text("")
        os.utime(folder / name, times)
    assert recalled("this", (int,), lambda: 8) == 8
    assert {file.name for file in folder.iterdir()} == {"this.made", "read.so", "made.so", "notes.txt"}
