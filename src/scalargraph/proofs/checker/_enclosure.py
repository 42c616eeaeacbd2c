"""Encloses JAX functions over boxes by Taylor models: evaluates a jaxpr entry by entry, for arrays of boxes."""

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from scalargraph import LoweringError
from scalargraph.errors import InputError
from scalargraph.graph import STUMPFF, Branch, Call, ClosedJaxpr, JaxprEquation, Scan, equations, needed
from scalargraph.proofs.checker._primitives import (
    ARRAYS,
    ENTRIES,
    MOVES,
    NEEDS,
    STAYS,
    each,
    is_real,
    nonzero,
    settled,
    unrolled,
)
from scalargraph.proofs.checker._taylor import ROUND, Taylor, UndecidedError, curve, exact, forget, open_choices


def _refuse_shorter_types(eqn: JaxprEquation) -> None:
    """Refuse results of a shorter type than the arguments, since rounding is not a function of real numbers."""
    if eqn.name == "reduce_precision":
        raise InputError("the model makes numbers shorter, by 'reduce_precision'")
    old, new = ([atom.aval.dtype for atom in atoms if is_real(atom)] for atoms in (eqn.invars, eqn.outvars))
    if old and new and min(jnp.finfo(a).nmant for a in new) < max(jnp.finfo(a).nmant for a in old):
        raise InputError(f"the model makes numbers shorter, {old[0]} to {new[0]}, by '{eqn.name}'")


def is_whole(atom: Any) -> bool:
    """Whether a variable or literal of a jaxpr holds integers."""
    return jnp.issubdtype(atom.aval.dtype, jnp.integer)


def _result_array(value: Any, atom: Any) -> np.ndarray:
    """A result as an array: of Taylor models, or of known truth values or integers."""
    value = np.asarray(value, getattr(value, "dtype", object))
    if value.dtype != object or is_real(atom):
        return value
    if not any(isinstance(entry, Taylor) for entry in value.flat):
        return value.astype(atom.aval.dtype)
    if is_whole(atom):
        raise UndecidedError("a place is not decided")
    return each(lambda truth: truth if isinstance(truth, Taylor) else exact(float(truth)), value)


class TaylorEnclosure:
    """A JAX function of z (d,) over boxes, as an array of `Taylor`.

    Args:
        function: The function, from an array (d,) to an array.
        low: Lower corner (d,) of a box that contains all others; variables of zero width are fixed.
        high: Upper corner (d,).
        slack: By how much z may lie outside its box (d,).
        watch: "" for the function itself. "defined" or "smooth" gives a matrix (1, 1) instead. It is 1 on boxes where
            everything that the function computes is defined, or defined without jumps, and not positive on others;
            there its terms show which variables widen the first number that is in doubt.

    Example:
        >>> import jax.numpy as jnp, numpy as np
        >>> from scalargraph.proofs.checker import TaylorEnclosure
        >>> low, high = np.array([-1.0]), np.array([1.0])
        >>> enclosure = TaylorEnclosure(lambda z: 2.0 + z[:, None], low, high, np.zeros(1))
        >>> entry = enclosure(np.array([[-1.0], [0.0]]), np.array([[0.0], [1.0]]))[0, 0]  # on two boxes
        >>> entry.middle.tolist(), entry.away.round(6).tolist()
        ([1.5, 2.5], [0.5, 0.5])
    """

    def __init__(
        self,
        function: Callable,
        low: np.ndarray,
        high: np.ndarray,
        slack: np.ndarray,
        watch: Literal["", "defined", "smooth"] = "",
    ):
        closed = jax.make_jaxpr(function)(jnp.asarray(low))
        self.body = ClosedJaxpr(closed.jaxpr, closed.consts) if watch else needed(closed)
        self.needs = {"": {}, "defined": NEEDS, "smooth": NEEDS | STAYS}[watch] if watch else None
        self.free, self.slack, self._places = high > low, slack, {}

    def __call__(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """The function over boxes."""
        forget()
        middle = low / 2 + high / 2
        # The middle is rounded, so the larger side, rounded up, is the half width; then |ε| ≤ 1 covers the whole box.
        half = np.maximum(high - middle, middle - low) * (1 + ROUND)
        z = np.array([Taylor([{(): c}, {}, {}], slack) for c, slack in zip(middle.T, self.slack, strict=True)], object)
        for k in np.flatnonzero(self.free):
            z[k] = Taylor([z[k].terms[0], {(int(k),): half[:, k]}, {}], self.slack[k])
        self._good, self._blame = np.ones(len(low), bool), np.zeros(low.T.shape)
        with np.errstate(all="ignore"):
            try:
                result = self._run(self.body, [z])[0]
            except LoweringError as error:
                raise InputError(f"{error}") from error
            return result if self.needs is None else np.array([[self._watched()]], object)

    def kinks(self) -> np.ndarray:
        """How much each variable widens the differences that leave choices open on the last B boxes (B, d)."""
        result = np.zeros(self._blame.shape)
        for gap, is_open in open_choices:
            for part in gap.terms[1:]:
                for m, t in part.items():
                    for k in m:
                        result[k] += np.where(is_open & np.isfinite(t), abs(t) / gap.away, 0.0)
        return result.T

    def _watched(self) -> Taylor:
        """1 on good boxes; on others 1 ± 2, split among the variables to blame, or −1 if there are none."""
        free = np.flatnonzero(self.free).tolist()
        shares = 2 * self._blame / np.where(self._good, 1.0, self._blame[free].sum(0)) * ~self._good
        attributed = self._good | (shares[free].sum(0) > 1.5)  # False if sums overflow or no variable is to blame
        return Taylor(
            [{(): np.where(attributed, 1.0, -1.0)}, {(k,): np.where(attributed, shares[k], 0.0) for k in free}, {}], 0.0
        )

    def _judge(self, holds: np.ndarray | bool, *entries: Taylor) -> None:
        """Record boxes on which a condition first fails, and how much each variable widens its numbers there."""
        lost = self._good & ~np.asarray(holds)
        if not lost.any():
            return
        self._good = self._good & ~lost
        for entry in entries:
            for part in entry.terms[1:]:
                for m, t in part.items():
                    for k in m:
                        self._blame[k] += np.where(lost & np.isfinite(t), abs(t), 0.0)

    def _run(self, body: ClosedJaxpr, args: Sequence) -> list:
        known = dict(zip([*body.jaxpr.constvars, *body.jaxpr.invars], [*body.consts, *args], strict=True))

        def read(atom) -> np.ndarray:
            x = np.asarray(atom.val if hasattr(atom, "val") else known[atom])
            return each(exact, x.astype(float)) if x.dtype != object and is_real(atom) else x

        for eqn in equations(body.jaxpr):
            x = list(map(read, eqn.invars))
            _refuse_shorter_types(eqn)
            if self.needs is not None and any(a.dtype == object for a in x):
                self._look(eqn, x)
            match eqn.form:
                case Call(inner):
                    out = self._run(inner, x)
                case Branch(bodies):
                    out = self._run(bodies[int(x[0])], x[1:])
                case Scan():
                    out = unrolled(eqn.form, x, self._run, np.stack)
                case _ if not any(a.dtype == object for a in x):
                    out = self._move(eqn, x)
                case _:
                    out = self._work(eqn, x)
            known |= {v: _result_array(value, v) for v, value in zip(eqn.outvars, out, strict=True)}
        return [read(atom) for atom in body.jaxpr.outvars]

    def _look(self, eqn: JaxprEquation, x: list) -> None:
        """Record the boxes on which a primitive is undefined, has an argument that is not finite, or jumps."""
        name = eqn.name
        need = (self.needs or {}).get(name)
        if name == "integer_pow" and eqn.params["y"] < 0:
            need = nonzero
        if name == "convert_element_type" and "select_n" in (self.needs or {}) and not is_real(eqn.invars[0]):
            need = settled  # a truth value as a number is a choice between 0 and 1
        if eqn.form is not None:  # the equations inside it are examined instead
            return
        for a, atom in zip(x, eqn.invars, strict=True):
            if is_real(atom) and name != "select_n" and name not in MOVES:
                for entry in set((a if a.dtype == object else each(exact, a)).flat):
                    self._judge(np.isfinite(entry.middle) & np.isfinite(entry.away), entry)
        if need is not None:
            pairs = (a if a.dtype == object or a.dtype == bool else each(exact, a.astype(float)) for a in x)
            for entries in zip(*(a.flat for a in np.broadcast_arrays(*pairs)), strict=True):
                self._judge(need(*entries), *(entry for entry in entries[-1:] if isinstance(entry, Taylor)))

    def _work(self, eqn: JaxprEquation, x: list) -> list:
        """Apply a primitive to numbers; `x` may also hold known indices and truth values."""
        name, p, atoms = eqn.name, eqn.params, eqn.invars
        chosen = name == "select_n" and x[0].dtype != object
        x = [
            a if a.dtype == object or is_whole(v) or (chosen and v is atoms[0]) else each(exact, a.astype(float))
            for a, v in zip(x, atoms, strict=True)
        ]
        if eqn.unknown is not None and (eqn.primitive is STUMPFF or name in {*ARRAYS, *MOVES, *ENTRIES}):
            raise InputError(f"the operation '{name}' with the parameter '{eqn.unknown}' is not known to the check")
        if name in ARRAYS:
            return [ARRAYS[name](p, *x)]
        if chosen or (name in MOVES and is_real(atoms[0]) <= is_real(eqn.outvars[0])):
            return self._move(eqn, x)
        if eqn.primitive is STUMPFF:
            return [each(functools.partial(curve, f"stumpff{p['k']}"), *x)]
        if name in ENTRIES:
            return [each(ENTRIES[name], *(a if a.dtype == object else each(exact, a.astype(float)) for a in x))]
        raise InputError(f"the operation '{name}' is not known to the check")

    def _move(self, eqn: JaxprEquation, x: list) -> list:
        """Apply a primitive to known numbers, or let it move entries."""
        pairs = [(a, a.dtype == object) for a in x]
        key = (eqn.name, *eqn.outvars, *(a.tobytes() for a, real in pairs if not real))
        if key not in self._places:
            starts = itertools.accumulate((a.size * real for a, real in pairs), initial=0)
            places = [np.arange(k, k + a.size).reshape(a.shape) for k, a in zip(starts, x, strict=False)]
            operands = [jnp.asarray(k if real else a) for k, (a, real) in zip(places, pairs, strict=True)]
            # JAX moves the indices of the entries, integers that are exact in a double; the entries follow them.
            with jax.ensure_compile_time_eval():
                out = eqn.primitive.bind(*operands, **eqn.params)
            self._places[key] = [np.asarray(o) for o in (out if eqn.primitive.multiple_results else [out])]
        entries = [a.ravel() for a, real in pairs if real]
        return [np.concatenate(entries)[o.astype(int)] for o in self._places[key]] if entries else self._places[key]
