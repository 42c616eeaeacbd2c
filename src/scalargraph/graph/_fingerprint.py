"""Hashes what a traced function computes; the hash is the same in every process, and equal keys mean equal functions.

A jaxpr determines what a function computes: its operations in order, their parameters, and its constants. The key is a
hash of these, without names of variables, and with the bytes of every constant. A jaxpr whose operations are not all
fixed in this way, such as one that calls Python, has no key. Jaxprs are read in the same forms as by the interpreter
(`_jax_forms`).
"""

import enum
import hashlib
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
from jax.core import ShapedArray
from jax.extend import core

from scalargraph.graph._jax_forms import ClosedJaxpr, equations
from scalargraph.graph._lowered import LoweringError
from scalargraph.graph._stumpff import STUMPFF

KNOWN = {p for each in (core.primitives, jax.lax) for p in vars(each).values() if isinstance(p, core.Primitive)}
KNOWN |= {STUMPFF}
"""Primitives whose meaning the versions of JAX and of this library determine; any other primitive may mean anything."""
BY_NAME = {"platform_index", "mirrored"}
"""Names of further known primitives: one that JAX does not export, and one of `_linalg`, which is not imported here."""
WITHOUT = {"sharding", "out_sharding"}
"""Parameters that say on which devices arrays are stored; they do not change values."""


class _UnknownError(Exception):
    """Raised for a part of a jaxpr whose meaning the jaxpr does not determine."""


def fingerprint(*parts: object) -> str | None:
    """Hash the content of traced functions and of values.

    Args:
        parts: Closed jaxprs, numbers, strings, arrays, and tuples, lists or dictionaries of these.

    Returns:
        The hash in hexadecimal digits, or None if the meaning of a part is not determined, such as a call of Python.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from scalargraph import fingerprint
        >>> one, two = (jax.make_jaxpr(lambda x, k=k: jnp.sin(k * x))(1.0) for k in (1.0, 1.0 + 2**-52))
        >>> fingerprint(one) == fingerprint(two)
        False
    """
    try:
        return _Keys().of(parts)
    except (_UnknownError, LoweringError):  # an unknown form
        return None


class _Keys:
    """Keys of parts; the key of a jaxpr that occurs many times is computed once."""

    def __init__(self):
        self._known: dict[tuple[int, ...], tuple[ClosedJaxpr, str]] = {}

    def of(self, x: object) -> str:
        """The key of a value that a jaxpr may have as a parameter or constant."""
        if x is None or isinstance(x, (bool, int, float, complex, str, bytes)):
            # Hexadecimal digits are exact, so that numbers that print alike have different keys.
            return _hash(type(x).__name__, x.hex() if isinstance(x, float) else repr(x))
        if isinstance(x, enum.Enum):
            return _hash("enum", type(x).__qualname__, x.name)
        if isinstance(x, np.dtype):
            return _hash("dtype", str(x))
        if isinstance(x, ClosedJaxpr):
            return self._body(x)
        if hasattr(x, "eqns") or hasattr(x, "jaxpr"):
            return self._body(ClosedJaxpr.of(x))
        if isinstance(x, (tuple, list)):
            return _hash(type(x).__qualname__, *map(self.of, x))
        if isinstance(x, dict):
            return _hash("dict", *(self.of(item) for item in sorted(x.items())))
        if isinstance(x, (jax.Array, np.ndarray, np.generic)):
            return _array(x)
        raise _UnknownError

    def _body(self, body: ClosedJaxpr) -> str:
        place = (id(body.jaxpr), *map(id, body.consts))
        if place not in self._known:
            # The body is stored beside its key, since an id is unique only as long as its object lives.
            self._known[place] = body, _hash(*self._parts(body))
        return self._known[place][1]

    def _parts(self, body: ClosedJaxpr) -> Iterator[str]:
        """The parts of a jaxpr, its variables numbered as they occur."""
        numbers: dict[core.Var, int] = {}
        if body.jaxpr.effects:
            raise _UnknownError
        yield from ("jaxpr", *map(self.of, body.consts))
        for variables in (body.jaxpr.constvars, body.jaxpr.invars):
            yield from ("variables", *(_new(variable, numbers) for variable in variables))
        for eqn in equations(body.jaxpr):
            yield from ("equation", eqn.name, *(_atom_text(atom, numbers) for atom in eqn.invars))
            if eqn.form is not None:
                yield from ("form", self.of(eqn.form))
            elif eqn.primitive in KNOWN or eqn.name in BY_NAME:
                for name, value in sorted(eqn.params.items()):
                    if name not in WITHOUT:
                        yield from ("parameter", name, self.of(value))
            else:
                raise _UnknownError
            yield from ("results", *(_new(variable, numbers) for variable in eqn.outvars))
        yield from ("outputs", *(_atom_text(atom, numbers) for atom in body.jaxpr.outvars))


def _hash(*parts: str) -> str:
    digest = hashlib.sha256()
    for part in parts:
        text = part.encode()
        digest.update(b"%d:" % len(text) + text)  # the length separates the parts of a list unambiguously
    return digest.hexdigest()


def _array(x: jax.Array | np.ndarray | np.generic) -> str:
    try:
        a = np.asarray(x)
    except TypeError as error:  # such as a key of random numbers
        raise _UnknownError from error
    if a.dtype.hasobject:
        raise _UnknownError
    return _hash("array", str(a.dtype), str(a.shape), np.ascontiguousarray(a).tobytes().hex())


def _kind(aval: object) -> str:
    if type(aval) is not ShapedArray:
        raise _UnknownError
    return f"{aval.dtype}{list(aval.shape)}{'*' * aval.weak_type}"


def _new(variable: core.Var, numbers: dict[core.Var, int]) -> str:
    numbers[variable] = len(numbers)
    return f"{numbers[variable]} {_kind(variable.aval)}"


def _atom_text(atom: core.Var | core.Literal, numbers: dict[core.Var, int]) -> str:
    if isinstance(atom, core.Literal):
        aval: Any = atom.aval
        return f"literal {_kind(aval)} {np.asarray(atom.val, aval.dtype).tobytes().hex()}"
    return str(numbers[atom])
