"""What was made of an observer in an earlier process, found again by what the observer is made of.

Tracing an observer of a robot takes seconds. What comes out is the same in every process as long as the observer, this
package and those below it are, so the text is kept in the cache folder under a digest of all of these. Anything whose
making cannot be told from outside, such as a function of a user's own, has no digest: it is traced every time.
"""

import contextlib
import dataclasses
import enum
import functools
import hashlib
import pickle
import platform
import sys
import types
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np

from covariant._files import write_atomically
from covariant._programs import IMPORTED, cache_folder, let_go_of_unused
from covariant.engine._intact import ROOT, intact

Made = TypeVar("Made")

PACKAGES = ("covariant", "jax", "jaxlib", "equinox", "numpy", "jaxtyping")
"""What these and Python itself define is known from their versions, and what this one defines from its text."""

PLAIN = (type(None), bool, int, float, complex, str, bytes)
PROGRAM = type(jax.jit(abs))
"""The type of a function that JAX compiles; what it computes is what the function says."""

HEAP_TYPE, IMMUTABLE_TYPE = 1 << 9, 1 << 8
"""Flags of a class in CPython: those that a `class` statement makes have the first only."""


class _UntoldError(Exception):
    """Something cannot be told apart from something else."""


def recalled(key: str | None, kinds: tuple[type, ...], make: Callable[[], Made]) -> Made:
    """What `make` made under a key before, in this process or an earlier one, or what it makes now.

    - `key`: the `digest` of all that it is made of.
    - `kinds`: the types of what is made, which must be plain data; what is found of another type does not count.
    """
    folder = cache_folder()
    if folder is None or key is None:
        return make()
    place = folder / f"{key}.made"
    found: Any = None
    # There is none, or it was cut short, or is of another version of a class. Whoever can write here can write the
    # libraries beside it, which are loaded as well.
    with contextlib.suppress(Exception):
        found = pickle.loads(place.read_bytes())
    if isinstance(found, kinds):
        return found
    made = make()
    with contextlib.suppress(OSError):  # such as a full disk: it is made all the same
        write_atomically(place, lambda file: file.write(pickle.dumps(made)))
        let_go_of_unused(folder)
    return made


def digest(what: Any) -> str | None:
    """A key of arrays, modules of equinox, functions and containers, the same in every process; None if there is none.

    Equal keys mean equal content, to the bit, of equal code. What is equal may have two keys.
    """
    told = _Telling()
    try:
        told.add(what)
        told.add((_source(), platform.python_version(), jax.dtypes.canonicalize_dtype(float)))
        told.add(sorted((name, version(name)) for name in PACKAGES[1:]))
    except Exception:  # what others made may fail in any way when it is looked at; then it cannot be told
        return None
    return told.hash.hexdigest()[:32]


def _source() -> str:
    """A digest of the text of this package, if that is what runs."""
    texts, found = _texts()
    if not intact(texts):
        raise _UntoldError
    return found


@functools.cache
def _texts() -> tuple[dict[str, str], str]:
    """The text of each file of this package, and a digest of all."""
    paths, found = sorted(ROOT.rglob("*.py")), hashlib.sha256()
    if any(path.stat().st_mtime > IMPORTED for path in paths):  # what runs here is an earlier text
        raise _UntoldError
    texts = {str(path): path.read_text(encoding="utf-8") for path in paths}
    for path, text in texts.items():
        found.update(f"{Path(path).relative_to(ROOT).as_posix()}\n{text}".encode())
    return texts, found.hexdigest()


class _Telling:
    """A hash of what is added to it."""

    def __init__(self):
        self.hash = hashlib.sha256()
        self._order: dict[int, int] = {}
        self._alive: list[Any] = []  # an id is that of one thing as long as the thing lives

    def add(self, x: Any) -> None:
        """Tell x, and everything that it is made of."""
        if type(x) in PLAIN:
            self._words(type(x).__name__, repr(x))
        elif isinstance(x, (np.ndarray, np.generic, jax.Array)):
            self._array(x)
        elif isinstance(x, np.dtype):
            self._words("dtype", x.str)
        elif type(x) in (tuple, list):
            self._words(type(x).__name__, len(x))
            for each in x:
                self.add(each)
        elif isinstance(x, dict):
            self._words(self._known(type(x)), len(x))
            for key, value in x.items():
                self.add(key)
                self.add(value)
        elif isinstance(x, enum.Enum):
            self._words(self._known(type(x)), x.name)
        elif isinstance(x, type):
            self._words("type", self._known(x))
        elif id(x) in self._order:
            self._words("again", self._order[id(x)])
        else:
            self._order[id(x)] = len(self._order)
            self._alive.append(x)
            self._compound(x)

    def _compound(self, x: Any) -> None:
        if isinstance(x, types.FunctionType):
            self._function(x)
        elif isinstance(x, types.MethodType):
            self._words("method")
            self.add((x.__func__, x.__self__))
        elif isinstance(x, functools.partial):
            self._words("partial")
            self.add((x.func, x.args, x.keywords))
        elif isinstance(x, tuple):  # with names
            self._words(self._known(type(x)), len(x))
            for each in x:
                self.add(each)
        elif hasattr(x, "__qualname__"):
            self._named(x)
        else:
            self._object(x)

    def _words(self, *words: object) -> None:
        for word in words:
            text = str(word).encode()
            self.hash.update(b"%d:" % len(text) + text)

    def _array(self, x: Any) -> None:
        a = np.asarray(x)
        if a.dtype.hasobject:
            raise _UntoldError
        weak = getattr(x, "weak_type", False)
        self._words("jax" if isinstance(x, jax.Array) else "numpy", weak, a.dtype.str, a.shape)
        self.hash.update(np.ascontiguousarray(a).tobytes())

    def _function(self, x: types.FunctionType) -> None:
        """By its name where that leads to it; else by its place in the text of its module, and what it closes over."""
        module = sys.modules.get(x.__module__)
        _root(x.__module__)
        if module is None or x.__globals__ is not vars(module):
            raise _UntoldError
        if _at(module, x.__qualname__) is x:
            self._words("function", x.__module__, x.__qualname__)
            return
        code = x.__code__
        if code.co_filename != getattr(module, "__file__", None):  # made while running
            raise _UntoldError
        self._words("code", x.__module__, x.__qualname__, code.co_firstlineno, code.co_linetable, code.co_code)
        self.add((x.__defaults__, x.__kwdefaults__))
        try:
            self.add([cell.cell_contents for cell in x.__closure__ or ()])
        except ValueError:  # a cell is empty
            raise _UntoldError from None

    def _named(self, x: Any) -> None:
        """Something callable that is no function of Python."""
        name, module = x.__qualname__, getattr(x, "__module__", None)
        if module is not None and _at(sys.modules.get(module), name) is x:
            _root(module)
            self._words("named", module, name)
        elif type(x) is PROGRAM:
            self._words("compiled")
            self.add(getattr(x, "__wrapped__"))  # noqa: B009
        else:
            self._object(x)

    def _object(self, x: Any) -> None:
        """By its class and its attributes."""
        if not hasattr(x, "__dict__") or any(map(_hides, type(x).__mro__[:-1])):
            raise _UntoldError
        self._words("object", self._known(type(x)))
        self.add(dict(sorted(vars(x).items())))
        # A field may be left to its class.
        fields = dataclasses.fields(x) if dataclasses.is_dataclass(x) else ()
        self.add([field.default for field in fields if field.name not in vars(x)])

    def _known(self, kind: type) -> str:
        """The name of a class that its name leads to."""
        _root(kind.__module__)
        if _at(sys.modules.get(kind.__module__), kind.__qualname__) is not kind:
            raise _UntoldError
        return f"{kind.__module__}.{kind.__qualname__}"


def _at(module: Any, name: str) -> Any:
    return functools.reduce(lambda x, part: getattr(x, part, None), name.split("."), module)


def _hides(kind: type) -> bool:
    """Whether a class keeps more than attributes: in slots, or because it is none of Python's own text."""
    made_in_python = kind.__flags__ & HEAP_TYPE and not kind.__flags__ & IMMUTABLE_TYPE
    return not made_in_python or bool(vars(kind).get("__slots__"))


def _root(module: str) -> None:
    """Raises where a module is of another package."""
    root = module.partition(".")[0]
    if root not in PACKAGES and root not in sys.stdlib_module_names:
        raise _UntoldError
