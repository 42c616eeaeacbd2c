"""A function compiled from C as one that programs of JAX call, a lane for each element of a batch."""

import ctypes
import functools
import hashlib
from collections.abc import Callable
from importlib.metadata import version
from string import Template
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from covariant._compile import FAST, compiled as load, compiler, vector_bytes
from covariant.lowering import Lowered, c_rows, lower

REALS: dict[Any, Literal["double", "float"]] = {np.dtype(np.float64): "double", np.dtype(np.float32): "float"}


def compiled(function: Callable, *arguments: Any) -> Callable:
    """A function as compiled C, to be called in place of it under `jax.jit` and `jax.vmap`; a batch fills lanes.

    - `arguments`: pytrees of arrays of one real type, or of their shapes (`jax.ShapeDtypeStruct`), at which it is
      compiled. It is called with arrays of these shapes; `jax.vmap` adds axes.

    The results are those of the function up to rounding; errors at run time (`equinox.error_if`) are left out. It has
    no derivative. Raises `ValueError` for arguments of another shape or type, `LoweringError` where the function has
    no graph, and `OSError` where there is no C compiler.
    """
    if compiler() is None:
        raise OSError("there is no C compiler `cc`: install one, or call the function itself under jax.jit")
    shapes, kinds = _shapes(arguments), _told(arguments)
    types = {leaf.dtype for leaf in jax.tree.leaves(shapes)}
    if len(types) != 1 or not types <= set(REALS):
        told = ", ".join(sorted(map(str, types))) or "none"
        raise ValueError(f"compiled: the arguments must be float64 or float32, all of them one; got {told}")
    (dtype,) = types
    lowered = lower(function, *shapes, loops="any")
    if not lowered.inputs * len(lowered.outputs):
        raise ValueError("compiled: the function needs at least one number as argument and one as result")
    rows_of = _rows(_registered(lowered, REALS[dtype]), len(lowered.outputs), getattr(function, "__name__", "function"))

    @functools.wraps(function)
    def call(*given: Any) -> Any:
        if _told(given) != kinds:
            raise ValueError(f"compiled: the arguments are {_told(given)}; it was compiled for {kinds}")
        row = rows_of(jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(given)]))
        ends = np.cumsum([leaf.size for leaf in lowered.results])[:-1].tolist()
        parts = zip(jnp.split(row, ends), lowered.results, strict=True)
        return jax.tree.unflatten(lowered.tree, [part.reshape(r.shape).astype(r.dtype) for part, r in parts])

    return call


def _shapes(arguments: Any) -> Any:
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(jnp.shape(leaf), jnp.result_type(leaf)), arguments)


def _told(arguments: Any) -> str:
    """The types, shapes and structure of arguments."""
    return str(jax.tree.map(lambda leaf: f"{leaf.dtype}{list(leaf.shape)}", _shapes(arguments))).replace("'", "")


def _rows(target: str, width: int, name: str) -> Callable:
    """`(..., inputs) -> (..., width)` by a target of XLA."""

    @jax.custom_jvp
    def rows_of(rows):
        shape = jax.ShapeDtypeStruct((*rows.shape[:-1], width), rows.dtype)
        return jax.ffi.ffi_call(target, shape, vmap_method="broadcast_all")(rows)

    @rows_of.defjvp
    def refuse(primals, tangents):
        raise NotImplementedError(f"{name} as compiled C has no derivative; differentiate the function itself")

    return rows_of


def _registered(lowered: Lowered, real: Literal["double", "float"]) -> str:
    """The name under which XLA finds the compiled function."""
    lanes = vector_bytes() // {"double": 8, "float": 4}[real]
    given = {"rows": c_rows(lowered, "rows", lanes, real), "real": real, "version": version("jaxlib")}
    return _loaded(Template(_SOURCE).substitute(given))


@functools.cache
def _loaded(source: str) -> str:
    name = f"covariant_{hashlib.sha256(source.encode()).hexdigest()[:32]}"
    made = load(source, (*FAST, f"-I{jax.ffi.include_dir()}"), ctypes.CDLL)
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(made.call), platform="cpu")
    _LOADED.append(made)
    return name


_LOADED: list[ctypes.CDLL] = []
"""Libraries that XLA may call, which therefore stay loaded."""

_SOURCE = """$rows
#include "xla/ffi/api/c_api.h" /* of $version */

XLA_FFI_Error *call(XLA_FFI_CallFrame *frame)
{
    const XLA_FFI_Buffer *x, *y;
    int64_t count = 1;
    int k;
    /* The type of extension_start has another name in later releases, so it is not named here. */
    if (frame->extension_start != NULL && frame->extension_start->type == XLA_FFI_Extension_Metadata) {
        XLA_FFI_Metadata *told = ((XLA_FFI_Metadata_Extension *)frame->extension_start)->metadata;
        told->api_version.major_version = XLA_FFI_API_MAJOR;
        told->api_version.minor_version = XLA_FFI_API_MINOR;
        return NULL;
    }
    if (frame->stage != XLA_FFI_ExecutionStage_EXECUTE)
        return NULL;
    x = frame->args.args[0];
    y = frame->rets.rets[0];
    for (k = 0; k < x->rank - 1; ++k)
        count *= x->dims[k];
    rows(x->data, y->data, count);
    return NULL;
}
"""
