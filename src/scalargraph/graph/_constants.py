"""Computes equations of a jaxpr with known inputs in NumPy, since compiling a program for each would be slow.

A rule exists only for operations that round as in JAX: those that move entries, compare, or make one correctly rounded
IEEE operation for each entry. JAX itself computes all others.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from scalargraph.graph._jax_forms import JaxprEquation


def compute(eqn: JaxprEquation, values: Sequence[Any]) -> list[Any]:
    """Compute the outputs of an equation of a jaxpr whose inputs are known."""
    rule = None if eqn.unknown else _RULES.get(eqn.name)
    outputs = [atom.aval for atom in eqn.outvars]
    if rule is not None and all(_plain(aval) for aval in outputs):
        # Inputs get the type of their variable in the jaxpr, which may differ from NumPy's own choice.
        arrays = [np.asarray(v, atom.aval.dtype) for v, atom in zip(values, eqn.invars, strict=True)]
        with np.errstate(all="ignore"):
            result = rule(eqn.params, *arrays)
        if result is not NotImplemented:
            parts = result if eqn.primitive.multiple_results else [result]
            return [np.asarray(part, aval.dtype).reshape(aval.shape) for part, aval in zip(parts, outputs, strict=True)]
    with jax.ensure_compile_time_eval():
        result = eqn.primitive.bind(*(jnp.asarray(v) for v in values), **eqn.params)
    return [np.asarray(f) for f in (result if eqn.primitive.multiple_results else [result])]


def _plain(aval) -> bool:
    return aval.dtype in (np.dtype(kind) for kind in ("float64", "float32", "int64", "int32", "bool"))


Rule = Callable[..., Any]


def _each(function: Callable[..., Any]) -> Rule:
    return lambda parameters, *values: function(*values)


def _broadcast(parameters: dict, value: np.ndarray, *_) -> np.ndarray:
    shape, axes = parameters["shape"], parameters["broadcast_dimensions"]
    lifted = np.ones(len(shape), int)
    lifted[list(axes)] = value.shape
    return np.broadcast_to(value.reshape(lifted), shape)


def _select(parameters: dict, which: np.ndarray, *cases: np.ndarray) -> np.ndarray:
    if which.dtype == bool:
        # `select_n` takes the first case if the predicate is false.
        return np.where(which, cases[1], cases[0])
    return np.choose(np.clip(which, 0, len(cases) - 1), cases)


def _slice(parameters: dict, value: np.ndarray) -> np.ndarray:
    strides = parameters["strides"] or (1,) * value.ndim
    ends = zip(parameters["start_indices"], parameters["limit_indices"], strides, strict=True)
    return value[tuple(slice(*end) for end in ends)]


def _split_array(parameters: dict, value: np.ndarray) -> list[np.ndarray]:
    sizes = parameters["sizes"]  # NumPy would give one part for none
    return np.split(value, np.cumsum(sizes)[:-1], axis=parameters["axis"]) if sizes else []


def _iota(parameters: dict) -> np.ndarray:
    shape, axis = parameters["shape"], parameters["dimension"]
    lifted = np.ones(len(shape), int)
    lifted[axis] = shape[axis]
    return np.broadcast_to(np.arange(shape[axis]).reshape(lifted), shape)


def padded(parameters: dict, value: np.ndarray, fill: np.ndarray) -> np.ndarray:
    """Pad an array as the primitive `pad` does."""
    config = parameters["padding_config"]
    # Negative low or high padding removes entries. This is done last, after the interior padding.
    slots = [slice(max(low, 0), None, inside + 1) for low, _, inside in config]
    sizes = [max(n + (n - 1) * inside, 0) for n, (_, _, inside) in zip(value.shape, config, strict=True)]
    result = np.full([n + max(low, 0) + max(high, 0) for n, (low, high, _) in zip(sizes, config, strict=True)], fill)
    result[tuple(slice(at.start, at.start + n, at.step) for at, n in zip(slots, sizes, strict=True))] = value
    ends = zip(result.shape, config, strict=True)
    return result[tuple(slice(max(-low, 0), n - max(-high, 0)) for n, (low, high, _) in ends)]


def _window(value: np.ndarray, starts: Sequence[np.ndarray], sizes: Sequence[int]) -> tuple[slice, ...]:
    """The window of a slice, moved to where it fits."""
    # XLA moves a slice that would reach beyond the array to where it fits; NumPy would shorten it.
    first = [min(max(int(s), 0), n - size) for s, n, size in zip(starts, value.shape, sizes, strict=True)]
    return tuple(slice(s, s + size) for s, size in zip(first, sizes, strict=True))


def part_at(parameters: dict, value: np.ndarray, *starts: np.ndarray) -> np.ndarray:
    """Take a slice of an array, as the primitive `dynamic_slice` does."""
    return value[_window(value, starts, parameters["slice_sizes"])]


def updated_at(parameters: dict, value: np.ndarray, update: np.ndarray, *starts: np.ndarray) -> np.ndarray:
    """Replace a slice of an array, as the primitive `dynamic_update_slice` does."""
    changed = value.copy()
    changed[_window(value, starts, update.shape)] = update
    return changed


def gather_places(parameters: dict, shape: Sequence[int], starts: np.ndarray) -> np.ndarray:
    """Places of the entries of a `gather` in the flat array; −1 if out of bounds."""
    numbers, sizes = parameters["dimension_numbers"], parameters["slice_sizes"]
    dropped = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
    batching = zip(numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True)
    clips = parameters["mode"] != jax.lax.GatherScatterMode.FILL_OR_DROP
    places = _flat_places(shape, sizes, starts, numbers.start_index_map, dict(batching), clips)
    return _windows_at(numbers.offset_dims, places, dropped, len(sizes))


def scatter_places(parameters: dict, shape: Sequence[int], starts: np.ndarray, updates: Sequence[int]) -> np.ndarray:
    """Places in the flat array of the entries that a `scatter` updates; −1 for updates that are dropped."""
    numbers = parameters["dimension_numbers"]
    dropped = (*numbers.inserted_window_dims, *numbers.operand_batching_dims)
    window = iter(updates[k] for k in numbers.update_window_dims)
    sizes = [1 if d in dropped else next(window) for d in range(len(shape))]
    batching = zip(numbers.operand_batching_dims, numbers.scatter_indices_batching_dims, strict=True)
    clips = parameters["mode"] == jax.lax.GatherScatterMode.CLIP
    places = _flat_places(shape, sizes, starts, numbers.scatter_dims_to_operand_dims, dict(batching), clips)
    return _windows_at(numbers.update_window_dims, places, dropped, len(shape))


def _flat_places(
    shape: Sequence[int],
    sizes: Sequence[int],
    starts: np.ndarray,
    axes: Sequence[int],
    batching: dict[int, int],
    clips: bool,
) -> np.ndarray:
    """Places (*batch, *sizes) of the entries of windows in a flat array; −1 throughout a window that does not fit."""
    batch = starts.shape[:-1]
    first = np.zeros((*batch, len(shape)), int)
    first[..., list(axes)] = starts
    for axis, of_batch in batching.items():
        lifted = np.ones(len(batch), int)
        lifted[of_batch] = batch[of_batch]
        first[..., axis] = np.arange(batch[of_batch]).reshape(lifted)
    last = np.array(shape, int) - np.array(sizes, int)
    if clips:
        first = np.clip(first, 0, last)
    fits = ((first >= 0) & (first <= last)).all(-1, keepdims=True)
    offsets = np.indices(sizes).reshape(len(sizes), math.prod(sizes))
    strides = np.array([math.prod(shape[k + 1 :]) for k in range(len(shape))], int)
    places = (first @ strides)[..., None] + strides @ offsets
    return np.where(fits, places, -1).reshape(*batch, *sizes)


def _windows_at(axes: Sequence[int], places: np.ndarray, dropped: Sequence[int], dimensions: int) -> np.ndarray:
    """The axes of the windows moved to their positions in the primitive, without the axes of size one that it drops."""
    batch = places.ndim - dimensions
    windows = np.squeeze(places, tuple(batch + d for d in dropped))
    return np.moveaxis(windows, range(batch, windows.ndim), axes)


SLICES = {"dynamic_slice": part_at, "dynamic_update_slice": updated_at}


def _gather(parameters: dict, value: np.ndarray, starts: np.ndarray) -> Any:
    places, fill = gather_places(parameters, value.shape, starts), parameters["fill_value"]
    outside = places < 0
    if not outside.any():
        return value.ravel()[places]
    if fill is None and not np.issubdtype(value.dtype, np.floating):
        return NotImplemented  # the default value differs between types
    entries = np.append(value, np.zeros(1, value.dtype))  # the last entry stands for place −1
    return np.where(outside, np.nan if fill is None else fill, entries[places])


def _scatter(parameters: dict, value: np.ndarray, starts: np.ndarray, updates: np.ndarray) -> np.ndarray:
    changed, places = value.ravel().copy(), scatter_places(parameters, value.shape, starts, updates.shape).ravel()
    changed[places[places >= 0]] = updates.ravel()[places >= 0]
    return changed.reshape(value.shape)


def _scatter_add(parameters: dict, value: np.ndarray, starts: np.ndarray, updates: np.ndarray) -> np.ndarray:
    changed, places = value.ravel().copy(), scatter_places(parameters, value.shape, starts, updates.shape).ravel()
    # Updates are added one by one, so that two updates of one place both count, as in XLA on a CPU.
    np.add.at(changed, places[places >= 0], updates.ravel()[places >= 0])
    return changed.reshape(value.shape)


def _over_axes(function: Callable[..., Any]) -> Rule:
    return lambda parameters, value: function(value, tuple(parameters["axes"]))


def _divide(parameters: dict, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    if not np.issubdtype(a.dtype, np.floating):
        # XLA truncates towards zero; NumPy's // rounds down.
        quotient = np.abs(a) // np.where(b == 0, 1, np.abs(b)) * np.sign(a) * np.sign(b)
        return np.where(b == 0, -1, quotient)  # as in XLA
    return a / b


def _convert(parameters: dict, value: np.ndarray) -> Any:
    # NumPy and XLA convert numbers beyond the range of an integer differently, so JAX does these conversions.
    shortened = np.issubdtype(value.dtype, np.floating) and not np.issubdtype(parameters["new_dtype"], np.floating)
    return NotImplemented if shortened else value.astype(parameters["new_dtype"])


_RULES: dict[str, Rule] = {
    "add": _each(np.add),
    "add_any": _each(np.add),
    "sub": _each(np.subtract),
    "mul": _each(np.multiply),
    "div": _divide,
    "neg": _each(np.negative),
    "abs": _each(np.abs),
    "square": _each(np.square),
    "sqrt": _each(np.sqrt),
    "max": _each(np.maximum),
    "min": _each(np.minimum),
    "eq": _each(np.equal),
    "ne": _each(np.not_equal),
    "lt": _each(np.less),
    "le": _each(np.less_equal),
    "gt": _each(np.greater),
    "ge": _each(np.greater_equal),
    "and": _each(np.bitwise_and),
    "or": _each(np.bitwise_or),
    "xor": _each(np.bitwise_xor),
    "not": _each(np.invert),
    "is_finite": _each(np.isfinite),
    "select_n": _select,
    "broadcast_in_dim": _broadcast,
    "reshape": lambda parameters, value, *_: value.reshape(parameters["new_sizes"]),
    "squeeze": lambda parameters, value: np.squeeze(value, tuple(parameters["dimensions"])),
    "expand_dims": lambda parameters, value: np.expand_dims(value, tuple(parameters["dimensions"])),
    "transpose": lambda parameters, value: np.transpose(value, parameters["permutation"]),
    "concatenate": lambda parameters, *values: np.concatenate(values, axis=parameters["dimension"]),
    "rev": lambda parameters, value: np.flip(value, tuple(parameters["dimensions"])),
    "slice": _slice,
    "pad": padded,
    **SLICES,
    "split": _split_array,
    "gather": _gather,
    "scatter": _scatter,
    "scatter-add": _scatter_add,
    "reduce_or": _over_axes(np.any),
    "reduce_and": _over_axes(np.all),
    "iota": lambda parameters, *_: _iota(parameters),
    "convert_element_type": _convert,
    "copy": _each(np.copy),
}
