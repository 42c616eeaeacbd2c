"""What takes long of `test_description.py`."""

import copy
import dataclasses
import enum

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_description import MODELS, cached, key_of, tuned

from covariant import models, observers
from covariant.codegen import trace_program
from covariant.engine._cache import cache_key
from covariant.engine._description import description_key
from covariant.engine._kernel import KernelForm, _KernelKey
from covariant.engine._layout import Layout
from covariant.engine._numbers import open_numbers


def variants(x, where: str = ""):
    """Copies of a value that differ from it in one place, each with the place."""
    if isinstance(x, enum.Enum):
        yield from ((where, other) for other in type(x) if other is not x)
    elif isinstance(x, bool):
        yield where, not x
    elif isinstance(x, int):
        yield where, x + 1
    elif isinstance(x, float):
        yield where, np.nextafter(x, np.inf).item()
    elif isinstance(x, str):
        yield where, f"{x}'"
    elif x is None:
        yield where, 1.0
    elif isinstance(x, (np.ndarray, jax.Array)):
        yield f"{where}:type", x.astype(np.float32 if x.dtype == np.float64 else np.float64)
        yield f"{where}:shape", x[None]
        for k in range(min(x.size, 8)):
            change = np.array(x)
            change.flat[k] = change.flat[k] + 1 if change.dtype.kind != "f" else np.nextafter(change.flat[k], np.inf)
            yield f"{where}:{k}", change if isinstance(x, np.ndarray) else jnp.asarray(change)
    elif isinstance(x, tuple):
        make = tuple if type(x) is tuple else lambda entries: type(x)(*entries)
        if type(x) is tuple:
            yield f"{where}+", (*x, None)
        for k, each in enumerate(x):
            yield from ((at, make([*x[:k], other, *x[k + 1 :]])) for at, other in variants(each, f"{where}[{k}]"))
    elif isinstance(x, dict):
        for name, each in x.items():
            yield from ((at, x | {name: other}) for at, other in variants(each, f"{where}[{name}]"))
    elif dataclasses.is_dataclass(x):
        for field in dataclasses.fields(x):
            for at, other in variants(getattr(x, field.name), f"{where}.{field.name}"):
                changed = copy.copy(x)
                object.__setattr__(changed, field.name, other)
                yield at, changed
    else:  # a function: another one of this library
        yield where, models.load


SHORT = ("oscillator", "free_body")


@pytest.mark.exhaustive("free_body", "pendulum_chain")
@pytest.mark.parametrize("name", [n if n in SHORT else pytest.param(n, marks=pytest.mark.long) for n in MODELS])
def test_observers_that_differ_in_anything_have_other_keys(name):
    """In one number by one unit in its last place, in a setting, a type, a shape, a function, or in their kind."""
    keys = {entry: key_of(observer) for entry, observer in tuned(name).items()}
    assert None not in keys.values()
    assert len(set(keys.values())) == len(keys)
    for entry, observer in list(tuned(name).items())[::5]:
        seen = {keys[entry]}
        for where, changed in variants(observer):
            key = key_of(changed)
            assert key not in seen, (entry, where)
            seen.add(key)
        assert len(seen) > 12


def test_equal_keys_are_of_equal_operations():
    """What is traced is the same to the last constant for observers of one key, and another for other keys."""

    def both(observer):
        form = KernelForm((2,), 2, open_numbers([observer]).places)
        traced = trace_program(_KernelKey(observer, form).recipe(), np.zeros(2), 2)
        return description_key(observer, form.opened, form.y, form.inputs, 1), cache_key(traced, 1)

    def chain(mass, substeps=1):
        return observers.Intrinsic(models.pendulum_chain(mass), 5.0, 8.0, substeps=substeps)

    pairs = [both(chain((0.6, 0.5))), both(chain((0.4, 0.3))), both(chain((0.3, 0.3))), both(chain((0.6, 0.5), 2))]
    assert pairs[0] == pairs[1] != pairs[2]
    for one in pairs:
        for other in pairs:
            assert (one[0] == other[0]) == (one[1] == other[1])


@pytest.mark.parametrize("name", ["oscillator", "free_body"])
def test_a_layout_is_read_as_it_was_written(name):
    model = models.load(name).need_mechanical(name, "These")
    y = model.manifold.origin()
    copied = observers.ModelCopy(model, 5.0, 8.0)
    for observer in (copied, observers.Gated(copied, model, noise=1e-3, speed=1.0)):
        layout = Layout.of(trace_program(_KernelKey(observer, KernelForm(y.shape, 1)).recipe(), y))
        assert Layout.from_data(layout.data()) == layout
