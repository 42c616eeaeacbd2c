"""What a fit has to know of a `StateSpace`: its states along a log, of which outputs tell a part, in their usual sizes.

A run is a motion with the readings as its configuration, and the states, not velocities, as its other part.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._integrate import rk4
from covariant.calibration.identification._error_model import (
    VAGUE,
    ErrorModel,
    NoiseLevels,
    acting,
    assembled,
    smoothed,
)
from covariant.calibration.identification._predict import MOST_SUBSTEPS
from covariant.calibration.identification._rows import MOST_ROWS, Rows, gather
from covariant.calibration.identification._unknowns import Unknowns
from covariant.models import Family, Motion, StateSpace
from covariant.signals import Record

SPEED = 100.0
"""Standard deviation of the states where a stretch begins, in their usual sizes."""
RATE, PLACES = 0.5, 64
"""Largest product of a Runge–Kutta step and of the largest rate of the states, and at how many rows that is taken."""
ROUNDING = 1e-9
"""Change of a state, relative to its size, below which it is a constant."""
PASSES = 6
"""How often states are smoothed before a search."""
FINE, LOOSE, OVER = 1e-3, 0.1, 20
"""Noise of readings in these passes, in sizes of the outputs, and the change of the states that they may make against
the model, in their usual sizes, over so many rows."""


class StateUnknowns(Unknowns):
    """The fitted function of a `StateSpace`, with usual sizes (N,) of its states."""

    sizes: Float[Array, "N"]

    def sizes_of(self, rows: Rows) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "T N"]]:
        """How far each output moves (n,), and the states (T, N) in their usual sizes, without the padding."""
        y, x = (np.asarray(part)[: rows.used] for part in rows.start)
        return np.maximum(np.sqrt(np.sum(np.diff(y, axis=0) ** 2, axis=0)), 1e-12), x / np.asarray(self.sizes)

    def speed(self, rows: Rows) -> Array:
        """Standard deviation of the states where a stretch begins, in their usual sizes."""
        del rows
        return jnp.asarray(SPEED)

    def steps(self, z: Any, rows: Rows) -> Array:
        """Runge–Kutta steps between rows that the largest rate of the states needs."""
        within = ~np.asarray(rows.fresh)[1:]
        at = np.arange(0, int(rows.used), max(1, int(rows.used) // PLACES))
        x, u = jnp.asarray(rows.start.v)[at], jnp.asarray(rows.inputs)[np.asarray(rows.rows)[at]]
        models = [self.model(jnp.asarray(z), machine) for machine in range(len(self.parts))]
        rates = np.concatenate([np.asarray(_rates(model, self.sizes, x, u)) for model in models])
        needed = np.max(np.diff(np.asarray(rows.t))[within], initial=0.0) * np.max(np.nan_to_num(rates)) / RATE
        return jnp.asarray(int(np.clip(np.ceil(needed), 1, MOST_SUBSTEPS)))

    def linearised(self, z: Array, run: Motion, rows: Rows, steps: Any) -> ErrorModel:
        """The linear model of the errors of the states, in their usual sizes, at unknowns z (p,)."""
        return _linearised(self, z, run, rows, steps)

    def along(self, run: Motion, errors: Array) -> Motion:
        """The states with their errors (T, ≥ N) corrected."""
        return Motion(run.q, run.v + self.sizes[None] * errors[:, : len(self.sizes)])

    def slower(self, rows: Rows, run: Motion) -> Float[np.ndarray, "T n"]:
        """Nothing: outputs have no velocities."""
        del run
        return np.full(np.shape(rows.y), np.nan)


@eqx.filter_jit
def _rates(model: StateSpace, sizes: Array, x: Array, u: Array) -> Float[Array, "K"]:
    """Bounds of the rates of the states, by the largest row of the Jacobian in usual sizes."""

    def rate(x, u):
        jacobian = jax.jacfwd(lambda x: model.f(jnp.zeros(()), x, u))(x)
        return jnp.max(jnp.sum(jnp.abs(jacobian * sizes[None] / sizes[:, None]), axis=1))

    return jax.vmap(rate)(x, u)


@eqx.filter_jit
def _linearised(unknowns: StateUnknowns, z: Array, run: Motion, rows: Rows, steps: Any) -> ErrorModel:
    n, p, sizes, manifold = run.v.shape[1], z.shape[0], unknowns.sizes, unknowns.manifold
    t, u, change = jnp.asarray(rows.t), *acting(unknowns, z, rows)
    dt = jnp.where(jnp.asarray(rows.fresh)[1:], 0.0, jnp.diff(t))
    machine = jnp.asarray(rows.machine)[jnp.asarray(rows.block)]
    machine = machine if len(unknowns.parts) > 1 else jnp.zeros_like(machine)

    def derivatives(function, machine):
        """Derivatives in the states and in all numbers of a function of a model and of both, and its value."""
        own, own_z, part = unknowns.of_machine(machine, z)
        moved = jnp.zeros(n + len(own_z))
        slope, value = jax.jacfwd(
            lambda d: (function(own.make(own.values(own_z + d[n:]))[0], sizes * d[:n], d[n:]),) * 2, has_aux=True
        )(moved)
        return slope[:, :n], value, jnp.zeros((len(value), p)).at[:, part].set(slope[:, n:])

    def step(t, x, u, change, machine, h, then):
        def ahead(model, dx, dz):
            acts = u + change @ dz
            return (rk4(lambda s, x: model.f(s, x, acts), t, x + dx, h, steps) - then) / sizes

        return derivatives(ahead, machine)

    def reading(t, x, u, change, machine, y):
        shows, error, slopes = derivatives(
            lambda model, dx, dz: -manifold.towards(model.h(t, x + dx, u + change @ dz), y), machine
        )
        return shows, slopes, -error

    y = jnp.asarray(rows.y)
    linear = jax.vmap(step)(t[:-1], run.v[:-1], u[:-1], change[:-1], machine[1:], dt, run.v[1:])
    pushes = jnp.broadcast_to(jnp.eye(n), (len(dt), n, n))
    read = jax.vmap(reading)(t, run.v, u, change, machine, jnp.where(jnp.isnan(y), run.q, y))
    return assembled((*linear, pushes), dt, rows, (jnp.ones(n, bool), *jnp.zeros((2, n))), *read, ~jnp.isnan(y))


def unknowns_of(family: Family, rows: Rows) -> Unknowns:
    """The unknowns of a family, whose states are known along rows if it is one of a `StateSpace`."""
    found = Unknowns.of(family)
    if family.file.mechanical:
        return found
    x, within = np.asarray(rows.start.v)[: int(rows.used)], ~np.asarray(rows.fresh)[1 : int(rows.used)]
    changes = OVER * np.sqrt(np.mean(np.diff(x, axis=0)[within] ** 2, axis=0))
    constant = changes <= ROUNDING * np.abs(x).max(axis=0)
    return StateUnknowns(**vars(found), sizes=jnp.asarray(np.where(constant, 1.0, changes)))


def rows_of(
    family: Any,
    records: Sequence[Record],
    slopes: Sequence[Float[np.ndarray, "_ n"]],
    machines: Sequence[int] | None = None,
    most: int = MOST_ROWS,
) -> Rows:
    """The rows of logs that a fit of a family uses, as by `gather`; `slopes` are velocities, or rates of outputs.

    Of a `StateSpace` the states begin near the true ones: smoothed under the first values, again and again, from those
    that one output alone shows, and constants for the others at which the model has derivatives.
    """
    model: Any = family.file.model
    rows = gather(model.manifold, records, slopes, machines, most)
    if family.file.mechanical:
        return rows
    first, speed = family.file.initial_state, float(np.sqrt(np.mean(np.asarray(rows.start.v) ** 2)))
    begin = jnp.broadcast_to(jnp.asarray(0.0 if first is None else first), len(model.coordinates))
    for off in (0.0, speed, -speed):
        run = Motion(rows.start.q, _shown_states(model, jnp.asarray(rows.start.q), begin + off))
        rows = rows._replace(start=run)
        unknowns = unknowns_of(family, rows)
        z: Any = np.zeros(len(unknowns.first))
        steps, given = unknowns.steps(z, rows), jax.tree.map(jnp.asarray, rows)
        if not np.asarray(unknowns.linearised(z, run, given, steps).fresh[1:] & ~given.fresh[1:]).any():
            break
    std = jnp.maximum(FINE * jnp.nanstd(jnp.asarray(rows.y), axis=0), 1e-12)
    noise = NoiseLevels(jnp.asarray(LOOSE / np.sqrt(OVER * rows.step)), std, jnp.zeros(()))
    for _ in range(PASSES):
        unknowns = unknowns_of(family, rows)
        system = unknowns.linearised(jnp.asarray(z), rows.start, given, steps)
        rows = rows._replace(start=unknowns.along(rows.start, _smoothed(system, noise, SPEED, VAGUE)))
    return rows


_smoothed = eqx.filter_jit(smoothed)


def _shown_states(model: StateSpace, y: Array, x: Array) -> Float[Array, "T N"]:
    """States (T, N): those that one output alone shows, from readings y (T, p), and the others as in x (N,)."""
    fixed = jnp.zeros(()), x, jnp.zeros(model.inputs)
    level, shows = np.asarray(model.h(*fixed)), np.asarray(jax.jacfwd(model.h, 1)(*fixed))
    states = np.tile(x, (len(y), 1))
    for i, row in enumerate(shows):
        if np.sum(row != 0) == 1:
            j = int(np.argmax(row != 0))
            states[:, j] += (np.asarray(y)[:, i] - level[i]) / row[j]
    return jnp.asarray(states)
