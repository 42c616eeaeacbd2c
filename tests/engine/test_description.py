"""Keys without tracing: observers that differ in anything have other keys, and those of foreign parts have none.

A wrong key would run the code of another observer, so every entry and every setting of every observer is changed.
"""

import copy
import dataclasses
import enum
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import _programs, models, observers
from covariant.calibration import DataSheet, tuned_estimators
from covariant.codegen import trace_program
from covariant.engine import KernelForm, _description
from covariant.engine._cache import cache_key
from covariant.engine._description import description_key
from covariant.engine._kernel import _KernelKey
from covariant.engine._layout import Layout
from covariant.engine._numbers import open_numbers

SHEET = DataSheet(1e-2, 1.0, 0.01, motion_std=2.0, motion_time=0.3, speed=(1.0,))
MODELS = ("ball_and_beam", "free_body", "heavy_top", "hovercraft", "oscillator", "pendulum_chain", "satellite")


@functools.cache
def tuned(name: str) -> dict:
    """Every observer that fits a model of the library, and two that are built of others."""
    file = models.load(name)
    found = tuned_estimators(file.need_mechanical(name, "These"), file.dimension, SHEET, 100.0)
    kalman = found["intrinsic-kalman"].observer if isinstance(found["intrinsic-kalman"], observers.Gated) else None
    return found | {"late": observers.Delayed(found["intrinsic"], 0.02, 100.0)} | ({"kalman": kalman} if kalman else {})


def key_of(observer, closed: bool = True) -> str | None:
    places = () if closed else open_numbers([observer]).places
    return description_key(observer, places, (2,), 1, 1)


@pytest.fixture(autouse=True)
def cached(tmp_path, monkeypatch):
    monkeypatch.setenv("COVARIANT_CACHE", str(tmp_path))


class Other(enum.Enum):
    """A kind that this library does not know."""

    KIND = 1


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


@pytest.mark.long("free_body")
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
        assert len(seen) > 20


def larger(x):
    """A number that is a percent larger, but for those that stay in the code."""
    if not eqx.is_inexact_array(x):
        return x
    values = np.where(np.abs(x) == 1, x, 1.01 * np.asarray(x))
    return x.at[...].set(values) if isinstance(x, jax.Array) else values


@pytest.mark.long("ball_and_beam", "pendulum_chain")
@pytest.mark.parametrize("name", MODELS)
def test_another_number_of_a_model_changes_no_key(name):
    """Numbers are arguments: of whatever size they are, all observers keep the kernels that they have."""
    for entry, observer in tuned(name).items():
        observer = jax.tree.map(lambda x: x, observer)  # JAX sorts the keys of dictionaries
        other = jax.tree.map(larger, observer)
        assert key_of(other, closed=False) == key_of(observer, closed=False), entry
        assert key_of(other) != key_of(observer), entry


@pytest.mark.long
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


def function_of_a_script(q):
    return q


@pytest.mark.parametrize(
    "change",
    [
        lambda q: q,
        function_of_a_script,
        functools.partial(function_of_a_script),
        function_of_a_script.__code__,
        Other.KIND,
        object(),
        {1, 2},
        np.ma.array([1.0]),
        jax.random.key(0),
        np.array([None]),
        type("Setting", (str,), {})("text"),
    ],
    ids=lambda change: type(change).__name__,
)
def test_what_is_not_of_this_library_has_no_key(change):
    observer = observers.Intrinsic(models.oscillator(), 5.0, 8.0)
    assert key_of(observer) is not None
    changed = copy.copy(observer)
    object.__setattr__(changed, "order", change)
    assert key_of(changed) is None
    undeclared = copy.copy(observer)
    object.__setattr__(undeclared, "note", 1)
    assert key_of(undeclared) is None


def test_a_class_of_a_script_has_no_key():
    class Mine(observers.FilteredDerivative):
        """Another observer."""

    assert key_of(observers.FilteredDerivative(20.0)) is not None
    assert key_of(Mine(20.0)) is None


def test_flags_of_jax_and_files_of_the_library_are_in_the_key(monkeypatch):
    observer = observers.FilteredDerivative(20.0)
    key = key_of(observer)
    with jax.default_matmul_precision("float32"):
        assert key_of(observer) != key
    assert key_of(observer) == key
    monkeypatch.setattr(_description, "_library", lambda: "another version")
    assert key_of(observer) not in (key, None)
    monkeypatch.setattr(_programs, "IMPORTED", 0.0)
    assert key_of(observer) is None, "a file was changed after it was imported"


def test_complex_numbers_and_zeros_are_no_arguments_unless_they_differ():
    observer = observers.EKF(models.oscillator(), jnp.eye(1), 1e-4 * jnp.eye(1))
    numbers = [jnp.array([0.0, 2.0, jnp.nan]), jnp.array([0.0, 3.0, jnp.nan]), jnp.array([0.5, 3.0, jnp.nan])]
    one, two, three = (eqx.tree_at(lambda o: o.measurement_cov, observer, each) for each in numbers)
    assert open_numbers([one]).places == open_numbers([two]).places == open_numbers([one, two]).places
    assert open_numbers([one, three]).places != open_numbers([one]).places
    complex_one = eqx.tree_at(lambda o: o.measurement_cov, observer, jnp.array([2.0 + 1.0j]))
    assert None in open_numbers([complex_one]).places
    with pytest.raises(ValueError, match="another kind"):
        open_numbers([complex_one, eqx.tree_at(lambda o: o.measurement_cov, observer, jnp.array([3.0 + 1.0j]))])


@pytest.mark.parametrize("name", ["oscillator", "free_body"])
def test_a_layout_is_read_as_it_was_written(name):
    model = models.load(name).need_mechanical(name, "These")
    y = model.manifold.origin()
    copied = observers.ModelCopy(model, 5.0, 8.0)
    for observer in (copied, observers.Gated(copied, model, noise=1e-3, speed=1.0)):
        layout = Layout.of(trace_program(_KernelKey(observer, KernelForm(y.shape, 1)).recipe(), y))
        assert Layout.from_data(layout.data()) == layout


@pytest.mark.parametrize(
    "data",
    [
        None,
        [],
        [[1, 2], [1], 0, None, None],
        [[1, 2, 3], [1], 0, {"class": ["os", "stat_result"], "fields": []}, None],
        [[1, 2, 3], [1], 0, {"class": ["covariant.observers", "REGISTRY"], "fields": []}, None],
        [[1, 2, 3], [1], 0, {"class": ["covariant.observers.base._protocol", "Info"], "fields": [None]}, None],
        [[1, 2, 3], [1], 0, {"shape": "x", "dtype": "float64"}, None],
        [[1, 2, 3], [1], 0, {"shape": [1], "dtype": "thing"}, None],
    ],
)
def test_a_file_that_describes_no_layout_is_refused(data):
    with pytest.raises(ValueError, match="no layout"):
        Layout.from_data(data)
