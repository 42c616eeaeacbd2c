"""Compiles a function in C for calls from programs of JAX; each element of a batch is one lane."""

import ctypes
import functools
import hashlib
from collections.abc import Callable
from importlib.metadata import version
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from scalargraph import Lowered, c_rows, lower
from scalargraph.compiler import FAST, compiled as load, compiler, vector_bytes
from scalargraph.errors import InputError
from scalargraph.template import fill

REALS: dict[Any, Literal["double", "float"]] = {np.dtype(np.float64): "double", np.dtype(np.float32): "float"}


def compiled(function: Callable, *arguments: object) -> Callable:
    """Compile a function in C, for calls from `jax.jit` and `jax.vmap`; a batch fills the lanes of vectors.

    The results are those of the function up to rounding; run-time checks (`equinox.error_if`) are left out. The
    compiled function has no derivative.

    Use it if one function is called often under `jit` on a CPU and XLA is slow for it, as for many scalar operations.
    It does not speed up large matrices. For a whole log use `run_log`.

    Args:
        function: A function of pytrees of arrays that is a graph of scalars.
        *arguments: Pytrees of arrays of one real type, float64 or float32, or of their shapes (`jax.ShapeDtypeStruct`),
            for which it is compiled.

    Returns:
        A function that is called with arrays of these shapes and this type; `jax.vmap` adds axes. Other arguments raise
        `ValueError`.

    Raises:
        ValueError: The arguments have another type or several types, or arguments or results contain no number.
        LoweringError: The function is not a graph of scalars.
        OSError: There is no C compiler.
    """
    if compiler() is None:
        raise OSError("there is no C compiler `cc`: install one, or call the function itself under jax.jit")
    shapes, kinds = _shapes(arguments), _describe_shapes(arguments)
    types = {leaf.dtype for leaf in jax.tree.leaves(shapes)}
    if len(types) != 1 or not types <= set(REALS):
        names = ", ".join(sorted(map(str, types))) or "none"
        raise InputError(f"compiled: the arguments must be float64 or float32, all of them one; got {names}")
    (dtype,) = types
    lowered = lower(function, *shapes, loops="any")
    if not lowered.inputs * len(lowered.outputs):
        raise InputError("compiled: the function needs at least one number as argument and one as result")
    target = _register_target(lowered, REALS[dtype])
    rows_of = _rows(target, len(lowered.outputs), getattr(function, "__name__", "function"))

    @functools.wraps(function)
    def call(*values: Any) -> Any:
        if _describe_shapes(values) != kinds:
            raise InputError(f"compiled: the arguments are {_describe_shapes(values)}; it was compiled for {kinds}")
        row = rows_of(jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(values)]))
        ends = np.cumsum([leaf.size for leaf in lowered.results])[:-1].tolist()
        parts = zip(jnp.split(row, ends), lowered.results, strict=True)
        return jax.tree.unflatten(lowered.tree, [part.reshape(r.shape).astype(r.dtype) for part, r in parts])

    return call


def _shapes(arguments: object) -> Any:
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(jnp.shape(leaf), jnp.result_type(leaf)), arguments)


def _describe_shapes(arguments: object) -> str:
    """The types, shapes and structure of arguments."""
    return str(jax.tree.map(lambda leaf: f"{leaf.dtype}{list(leaf.shape)}", _shapes(arguments))).replace("'", "")


def _rows(target: str, width: int, name: str) -> Callable:
    """`(..., inputs) -> (..., width)` by a target of XLA."""

    @jax.custom_jvp
    def rows_of(rows):
        shape = jax.ShapeDtypeStruct((*rows.shape[:-1], width), rows.dtype)
        # With all batch axes in front, the rows of the whole batch are contiguous, and C handles them in one loop.
        return jax.ffi.ffi_call(target, shape, vmap_method="broadcast_all")(rows)

    @rows_of.defjvp
    def refuse(primals, tangents):
        raise NotImplementedError(f"{name} as compiled C has no derivative; differentiate the function itself")

    return rows_of


def _register_target(lowered: Lowered, real: Literal["double", "float"]) -> str:
    """Register the compiled function with XLA, and return the name of the target."""
    lanes = vector_bytes() // {"double": 8, "float": 4}[real]
    # The text contains the version, so that another release of jaxlib, with other headers, gets another library.
    words = {"ROWS": [c_rows(lowered, "rows", lanes, real)], "VERSION": version("jaxlib")}
    return _load_library(fill("covariant.engine", "ffi.c", words))


@functools.cache
def _load_library(source: str) -> str:
    name = f"covariant_{hashlib.sha256(source.encode()).hexdigest()[:32]}"
    library = load(source, (*FAST, f"-I{jax.ffi.include_dir()}"), ctypes.CDLL)
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(library.call), platform="cpu")
    _LOADED.append(library)
    return name


_LOADED: list[ctypes.CDLL] = []
"""Libraries that XLA may call; references to them keep them loaded."""
