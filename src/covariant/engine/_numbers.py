"""Decides which numbers of an observer are arguments of its compiled code, so that one code serves many observers.

A number that saves operations as a constant stays in the code: zero, ±1 in the tables of a model, and values that are
not finite. Numbers of a model that are equal in all observers, such as a mass that occurs in inertia and potential,
become one argument, so that results computed from either are computed once.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from covariant.observers import AbstractObserver
from covariant.signals import AnyArray
from scalargraph.errors import InputError

MODEL = {"model", "metric"}
"""Fields of observers that contain a model, or a metric designed for it."""
MOST_OPEN = 100
"""Largest size of an array that becomes an argument, as of a covariance of ten joints; larger tables are constants."""

Places = tuple[tuple[int, ...] | None, ...]


class OpenNumbers(NamedTuple):
    """The numbers of observers of one kind that are arguments of their code.

    Attributes:
        places: For each array of real numbers of the observer, in the order of its pytree's leaves, the index of the
            argument for each entry, −1 for a constant; None for an array of constants.
        values: The arguments (N, K) of each of N observers.
    """

    places: Places
    values: np.ndarray


def open_numbers(observers: Sequence[AbstractObserver], models: bool = True) -> OpenNumbers:
    """Decide which numbers of observers are arguments of their code."""
    leaves, trees = zip(*map(jax.tree.flatten, observers), strict=True)
    real = [eqx.is_inexact_array(leaf) and not np.iscomplexobj(leaf) for leaf in leaves[0]]
    for k, (tree, others) in enumerate(zip(trees, leaves, strict=True)):
        if tree != trees[0] or not all(map(_alike, real, others, leaves[0])):
            raise InputError(
                f"run_logs: observer {k} is of another kind than the first, not only of other numbers; run it alone"
            )
    paths = [path for path, _ in jax.tree_util.tree_flatten_with_path(observers[0])[0]]
    shared: dict[bytes, int] = {}
    columns: list[np.ndarray] = []
    places: list[tuple[int, ...] | None] = []
    for i in np.flatnonzero([eqx.is_inexact_array(leaf) for leaf in leaves[0]]).tolist():
        if not real[i]:  # complex numbers stay in the code
            places.append(None)
            continue
        rows = np.stack([np.ravel(others[i]) for others in leaves]).astype(float)
        fields = {getattr(key, "name", None) for key in paths[i]}
        of_model = not fields.isdisjoint(MODEL)
        varies = (rows != rows[0]).any(axis=0)  # NaN counts as varying, since it equals nothing
        few = rows.shape[1] <= MOST_OPEN and "metric" not in fields and (models or not of_model)
        opened = varies | (_usual(rows[0], of_model) & few)
        each = []
        for column, is_open in zip(rows.T, opened.tolist(), strict=True):
            # Gains may be equal by chance or by symmetry up to rounding, so each of them is an argument of its own.
            key = column.tobytes() if of_model else len(columns).to_bytes(8)
            if is_open and key not in shared:
                shared[key] = len(columns)
                columns.append(column)
            each.append(shared[key] if is_open else -1)
        places.append(tuple(each) if opened.any() else None)
    values = np.stack(columns, axis=1) if columns else np.empty((len(observers), 0))
    return OpenNumbers(tuple(places), values)


def _usual(values: np.ndarray, of_model: bool) -> np.ndarray:
    """Mask of the values that would save no operations as constants."""
    return np.isfinite(values) & (values != 0) & ~(of_model & (np.abs(values) == 1))


def _alike(real: bool, leaf: AnyArray, first: AnyArray) -> bool:
    """Whether leaves of two observers differ at most in the values of an array of real numbers."""
    if leaf is first:
        return True
    if real:
        return eqx.is_inexact_array(leaf) and not np.iscomplexobj(leaf) and np.shape(leaf) == np.shape(first)
    return bool(eqx.tree_equal(leaf, first))


def filled(leaves: Sequence[Any], places: Places, numbers: AnyArray) -> list[Any]:
    """The arrays of an observer with its open numbers filled in."""
    # Arrays with the same numbers share one result, since tracing each takes as long as tracing a step of a model.
    made: dict[tuple[Any, ...], Any] = {}
    results = []
    for leaf, at in zip(leaves, places, strict=True):
        if at is not None:
            known = np.asarray(leaf)
            key = at, known.shape, known.dtype.str, known.ravel()[np.array(at, int) < 0].tobytes()
            if key not in made:
                made[key] = _fill_leaf(known, np.array(at), numbers)
            leaf = made[key]
        results.append(leaf)
    return results


def _fill_leaf(leaf: np.ndarray, at: np.ndarray, numbers: AnyArray) -> Any:
    if (at == np.arange(at[0], at[0] + len(at))).all() and at[0] >= 0:
        entries = jax.lax.slice(numbers, (int(at[0]),), (int(at[0]) + len(at),))
    else:
        constants = leaf.ravel()[at < 0].astype(numbers.dtype)
        index = np.where(at < 0, len(numbers) + np.cumsum(at < 0) - 1, at)
        entries = jnp.concatenate([numbers, constants]).at[index].get(mode="promise_in_bounds")
    return jax.lax.convert_element_type(jax.lax.reshape(entries, leaf.shape), leaf.dtype)
