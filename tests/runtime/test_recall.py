"""What an earlier process made of an observer is found again, and never taken for another."""

import enum
import os
import pickle
import re
import subprocess
import sys
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant.lowering import _constants
from covariant.runtime import _recall
from covariant.runtime._recall import digest, recalled

# Without the type checks of the tests, which wrap the functions of the package.
PROCESS = """
import sys
import covariant
import numpy as np
from covariant import models
from covariant.observers import REGISTRY, Intrinsic
from covariant.runtime import Stream, _kernel, run_log
from covariant.runtime._recall import digest
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
def traced(*words, **more):
    raise SystemExit("traced")

if "warm" in {words}:
    _kernel.program = traced
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
    [made] = tmp_path.glob("*/*.made")
    assert python(RUN.format(words=["warm"], kept=True), tmp_path) == first
    # One that was cut short is made again, and is whole afterwards.
    whole = made.read_bytes()
    made.write_bytes(whole[:1000])
    assert python(RUN.format(words=[], kept=True), tmp_path) == first
    assert made.read_bytes() == whole
    assert not list(tmp_path.glob("*/tmp*"))
    assert python(RUN.format(words=[], kept=False), "off") == first


REFUSED = """
from covariant.lowering import LoweringError
from covariant.models import Lagrangian

def program(*words, **more):
    print("traced")
    raise LoweringError("no graph")

_kernel.program = program
record = Record(np.linspace(0, 1, 50), np.zeros((50, 2)), np.zeros((50, 2)))
print(run_log(Intrinsic(models.pendulum_chain(), 5.0, 8.0), record)[1])
mine = Lagrangian(lambda q: np.eye(2) * (2 + q[0] * 0), lambda q: q[0] * 0)
print(run_log(Intrinsic(mine, 5.0, 8.0), record)[1])
"""


def test_an_observer_without_a_graph_is_tried_once(tmp_path):
    said = "jax: no graph\njax: fewer than 100000 rows, and compiled C would not be kept\n"
    assert python(REFUSED, tmp_path) == f"traced\n{said}"
    assert python(REFUSED, tmp_path) == said


class Pair(NamedTuple):
    """Two things."""

    first: object
    second: object


def outer(x):
    return lambda y: x + y


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


def test_what_cannot_be_told_has_no_key():
    class Local(eqx.Module):
        x: float

    class Hidden:
        __slots__ = ("x",)

    class Word(str):
        pass

    endless: list = []
    endless.append(endless)
    made = {"__name__": "covariant.runtime._recall"}
    exec("def f(x): return x", made)
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
        endless,
        object(),
    ):
        assert digest(thing) is None
        assert digest((1, [thing])) is None


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
