"""What types the tests look at while the package runs, and in which rooms."""

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from beartype.roar import BeartypeCallHintViolation
from jaxtyping import Array, Float
from types_at_run_time import check_types, typed

import covariant
from covariant.proofs._file import Field
from covariant.proofs.checker import show_definite

SOURCE = Path(covariant.__file__).parent


def modules():
    for path in sorted(SOURCE.rglob("*.py")):
        if path.name not in ("__main__.py", "__init__.py"):
            yield ".".join(path.relative_to(SOURCE.parent).with_suffix("").parts)


def test_types_are_looked_at_in_every_room_but_lowering():
    """Whose inner loops run millions of times; the checker and its files have beartype's own hook, see below."""
    looked = {name: hasattr(importlib.import_module(name), "__typed__") for name in modules()}
    others = ("covariant.lowering.", "covariant.proofs.checker.", "covariant.proofs._file.")
    assert {name for name, seen in looked.items() if not seen} == {n for n in looked if f"{n}.".startswith(others)}
    assert len(looked) > 150


@pytest.mark.parametrize(
    "wrong", [lambda: show_definite("matrix", np.zeros((0, 1)), np.zeros((0, 1)), 1, "it"), lambda: Field(1, "", "")]
)
def test_a_wrong_type_in_the_checker_is_no_refusal(wrong):
    """Those are made of `ValueError` and its like, `TypeError` too."""
    with pytest.raises(BeartypeCallHintViolation) as caught:
        wrong()
    assert not isinstance(caught.value, ValueError | TypeError | LookupError | ArithmeticError | AttributeError)


def test_a_package_that_was_imported_before_is_refused():
    with pytest.raises(AssertionError, match="covariant has been imported already"):
        check_types("covariant")


@typed
def product(a: Float[Array, "n m"], b: Float[Array, "m"]) -> Float[Array, "n"]:
    return a @ b if a.shape[0] < 5 else b


@typed
def named(x: "Float[Array, 'n n']", k: int = 0) -> int:
    return k


@typed
def quoted(x: "Float[Array, 'n']", y: "Float[Array, 'n']") -> int:
    return len(x)


@typed
def around(a: Float[Array, "n"]) -> Float[Array, "n"]:
    product(jnp.ones((len(a) + 1, len(a) + 2)), jnp.ones(len(a) + 2))
    return a


class Pair(NamedTuple):
    first: int


class Both(eqx.Module):
    x: Float[Array, "n"]
    y: Float[Array, "n"]

    @typed
    def __call__(self, z: Float[Array, "k"]) -> Float[Array, "k"]:
        return product(jnp.ones((2, 3)), jnp.ones(3))[:1] if z.shape == (4,) else z

    @classmethod
    @typed
    def of(cls, x: int) -> "Both":
        return cls(jnp.ones(x), jnp.ones(x))

    @property
    @typed
    def number(self) -> int:
        return float(self.x[0])


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: product(jnp.ones((2, 3)), jnp.ones(2)),
        lambda: product(jnp.ones((2, 3)), np.ones(3)),
        lambda: product(jnp.ones((2, 3)), jnp.ones(3, jnp.int32)),
        lambda: product(jnp.ones((5, 4)), jnp.ones(4)),
        lambda: named(jnp.ones((2, 3))),
        lambda: named(jnp.ones((2, 2)), 1.0),
        lambda: quoted(jnp.ones(2), jnp.ones(3)),
        lambda: typed(Both)(jnp.ones(2), jnp.ones(3)),
        lambda: Both(jnp.ones(2), jnp.ones(2))(jnp.ones(4)),
        lambda: Both.of(2.0),
        lambda: Both.of(2).number,
        lambda: list(typed(words)(2)),
    ],
)
def test_what_is_not_of_its_type_is_found(wrong):
    with pytest.raises(TypeError, match="violates type hint"):
        wrong()


def words(count: str) -> Iterator[str]:
    yield from count


def test_what_is_of_its_type_passes():
    assert product(jnp.ones((2, 3)), jnp.ones(3)).shape == (2,)
    assert named(jnp.ones((2, 2)), 3) == 3
    assert quoted(jnp.ones(2), jnp.ones(2)) == 2
    assert list(typed(words)("ab")) == ["a", "b"]
    assert Both.of(2).y.shape == (2,)
    # Each call has dimensions of its own.
    assert around(jnp.ones(2)).shape == (2,)
    both = typed(Both)(jnp.ones(2), jnp.ones(2))
    assert both(jnp.ones(3)).shape == (3,)
    assert both(jnp.ones(1)).shape == (1,)


def test_what_says_no_types_is_left_alone():
    def plain(x):
        return x

    assert typed(plain) is plain
    assert typed(Pair) is Pair


TEXT = """'A text.'
import dataclasses, functools

def f(x: int):
    return x

@dataclasses.dataclass(frozen=True)
class Made:
    x: int

    @functools.lru_cache
    def kept(self, y: int): return y

    @classmethod
    def of(cls, x: int): return x

    @staticmethod
    def near(x: int): return x

    @property
    def told(self) -> str: return self.x

    def __call__(self):
        def within(x: int): return x
        return within("1")
"""


def test_only_the_packages_that_are_named_are_changed(tmp_path, monkeypatch):
    """And compiled modules of theirs lie beside those of who imports them without."""
    (tmp_path / "some").mkdir()
    for name in ("__init__", "one", "two"):
        (tmp_path / f"some/{name}.py").write_text(TEXT)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "meta_path", list(sys.meta_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    monkeypatch.setattr(sys, "pycache_prefix", None)
    check_types("some", but=("some.two",))
    one, two = importlib.import_module("some.one"), importlib.import_module("some.two")
    made = one.Made(1)
    wrong = (
        lambda: one.f("1"),
        lambda: one.Made("1"),
        lambda: one.Made.of("1"),
        lambda: one.Made.near("1"),
        lambda: made.told,
        lambda: made(),
        lambda: made.kept("1"),
    )
    for call in wrong:
        with pytest.raises(TypeError, match="violates type hint"):
            call()
    assert two.f("1") == two.Made("1").x == two.Made.of("1") == two.Made("1")() == "1"
    assert made.kept(2) == one.f(2) == one.Made.of(2) == one.Made.near(2) == 2
    assert hasattr(one.Made.kept, "cache_info")  # typed within other decorators, which take annotations away
    assert one.__doc__ == "A text."
    kept = {file.name.partition(".")[0]: ".typed-" in file.name for file in (tmp_path / "some/__pycache__").iterdir()}
    assert kept == {"__init__": True, "one": True, "two": False}
    for name in [name for name in sys.modules if name.partition(".")[0] == "some"]:
        del sys.modules[name]
