"""What takes long of `test_cache.py`."""

import json
import os
import subprocess
import sys
import time

import pytest

from scalargraph import LoweringError

PROCESS = """
import sys
import jax.numpy as jnp
import numpy as np
from covariant import models
from covariant.codegen import _program
from covariant.engine import Stream, run_log
from scalargraph import LoweringError
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
from covariant.engine._kernel import KernelForm, _prepared, prepared

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
