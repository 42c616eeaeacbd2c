"""Keys without tracing: observers that differ in anything have other keys, and those of foreign parts have none.

A wrong key would run the code of another observer, so every entry and every setting of every observer is changed.
"""

import copy
import enum
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import _programs, models, observers
from covariant.calibration import DataSheet, tuned_estimators
from covariant.engine import _description
from covariant.engine._description import description_key
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


def larger(x):
    """A number that is a percent larger, but for those that stay in the code."""
    if not eqx.is_inexact_array(x):
        return x
    values = np.where(np.abs(x) == 1, x, 1.01 * np.asarray(x))
    return x.at[...].set(values) if isinstance(x, jax.Array) else values


@pytest.mark.core(1)
@pytest.mark.long("ball_and_beam", "pendulum_chain")
@pytest.mark.parametrize("name", MODELS)
def test_another_number_of_a_model_changes_no_key(name):
    """Numbers are arguments: of whatever size they are, all observers keep the kernels that they have."""
    for entry, observer in tuned(name).items():
        observer = jax.tree.map(lambda x: x, observer)  # JAX sorts the keys of dictionaries
        other = jax.tree.map(larger, observer)
        assert key_of(other, closed=False) == key_of(observer, closed=False), entry
        assert key_of(other) != key_of(observer), entry


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


@pytest.mark.parametrize(
    "data",
    [
        None,
        [],
        [[1, 2], [1], 0, None, None],
        [[1, 2, 3], [1], 0, {"class": ["os", "stat_result"], "fields": []}, None],
        [[1, 2, 3], [1], 0, {"class": ["covariant.observers", "REGISTRY"], "fields": []}, None],
        [[1, 2, 3], [1], 0, {"class": ["covariant.observers.base._states", "Info"], "fields": [None]}, None],
        [[1, 2, 3], [1], 0, {"shape": "x", "dtype": "float64"}, None],
        [[1, 2, 3], [1], 0, {"shape": [1], "dtype": "thing"}, None],
    ],
)
def test_a_file_that_describes_no_layout_is_refused(data):
    with pytest.raises(ValueError, match="no layout"):
        Layout.from_data(data)
