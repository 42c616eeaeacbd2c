"""Unknowns of a search for the parameters of a model: their relative changes, which keep positive ones positive."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from covariant.calibration._least_squares import PRIOR
from covariant.calibration.identification._error_model import ErrorModel, Walk, error_model
from covariant.calibration.identification._predict import needed_substeps
from covariant.calibration.identification._rows import Rows
from covariant.geometry import AbstractManifold
from covariant.models import Family, MechanicalSystem, Motion
from covariant.signals import AnyArray

FASTER = 3.0
"""Standard deviation of the velocity at the start of a stretch, in largest velocities of the reference."""

NumpyArray = np.ndarray


class OfMotions:
    """What a fit has to know of a mechanical system, the run of which is a motion."""

    manifold: Any
    parts: Any

    def sizes_of(self, rows: Rows) -> tuple[Float[NumpyArray, "n"], Float[NumpyArray, "T n"]]:
        """How far each coordinate moves (n,), and the velocities (T, n), without the padding."""
        v = np.asarray(rows.start.v)[: rows.used]
        return np.maximum(np.sqrt(np.mean(v**2, axis=0)) * rows.step * np.sqrt(len(v)), 1e-12), v

    def speed(self, rows: Rows) -> Array:
        """Standard deviation of velocities where a stretch begins."""
        return jnp.asarray(FASTER * np.abs(np.asarray(rows.start.v)).max())

    def steps(self, z: NumpyArray, rows: Rows) -> Array:
        """Runge–Kutta steps between rows that the stiffest of the machines needs."""
        each = [self.model(jnp.asarray(z), machine) for machine in range(len(self.parts))]
        return jnp.asarray(max(needed_substeps(model, rows) for model in each))

    def model(self, z: Array, machine: int = 0) -> Any:
        """The model of a machine at unknowns z (p,)."""
        raise NotImplementedError

    def linearised(self, z: Array, run: Motion, rows: Rows, steps: Any) -> ErrorModel:
        """The linear model of errors along a motion, at unknowns z (p,)."""
        return error_model(self, z, run, rows, steps)

    def along(self, run: Motion, errors: Array) -> Motion:
        """The motion with its errors (T, ≥ 2n) corrected."""
        return _along(self.manifold, run, errors)

    def slower(self, rows: Rows, run: Motion) -> Float[NumpyArray, "T n"]:
        """Reference velocities minus those of a motion."""
        return np.asarray(rows.start.v) - np.asarray(run.v)


@eqx.filter_jit
def _along(manifold: Any, run: Motion, errors: Array) -> Motion:
    n = run.v.shape[1]
    return Motion(jax.vmap(manifold.retract)(run.q, errors[:, :n]), run.v + errors[:, n : 2 * n])


class Unknowns(eqx.Module, OfMotions):
    """The fitted function `make (k,) -> (model, lag)`, first values (p,), which are positive, which k of the p are
    those of each machine, the configurations of the model, and the numbers that walk along a log.

    The unknowns z (p,) are relative changes of the values.
    """

    make: Callable[[Array], tuple[Any, Any]]
    first: Float[Array, "p"]
    positive: Any
    parts: Int[AnyArray, "M k"]
    manifold: AbstractManifold
    walks: tuple[Walk, ...] = eqx.field(default=(), static=True, kw_only=True)

    @classmethod
    def of(cls, family: Family, known: bool = False) -> "Unknowns":
        """The unknowns of a family; `known` are values of which only those that the model file calls uncertain are
        not, and walk from where they begin as uncertain as the file says."""
        first, parts, drift = jnp.asarray(family.first), jnp.asarray(family.parts), family.file.parameters_drift
        stds = enumerate(map(family.file.uncertain_std, family.names)) if drift or known else ()
        walks = tuple(Walk(j, std * known, drift) for j, std in stds if std is not None)
        return cls(family.make, first, family.positive, parts, family.file.model.manifold, walks=walks)

    @classmethod
    def none(cls, model: MechanicalSystem) -> "Unknowns":
        """A model without any unknown number."""
        return cls(eqx.Partial(_as_it_is, model), jnp.zeros(0), (), jnp.zeros((1, 0), int), model.manifold)

    def model(self, z: Array, machine: int = 0) -> Any:
        """The model of a machine at relative changes z (p,)."""
        own, own_z, _ = self.of_machine(machine, z)
        return own.make(own.values(own_z))[0]

    def of_machine(self, machine: Any, z: Array) -> tuple["Unknowns", Array, Array]:
        """Unknowns of one machine, their relative changes (k,), and where they are among all."""
        part = jnp.asarray(self.parts)[machine]
        own = dataclasses.replace(self, first=self.first[part], positive=jnp.asarray(self.positive)[part])
        return own, z[part], part

    @property
    def size(self) -> Float[Array, "p"]:
        """Size of a relative change of one: the first value, or one unit where that is zero."""
        return jnp.abs(self.first) + jnp.equal(self.first, 0).astype(self.first.dtype)

    def values(self, z) -> Float[Array, "p"]:
        """Parameters at relative changes z (p,): logarithms of ratios for positive ones, for others the inverse
        hyperbolic sine of the change in units of `size`, which grows as a logarithm too."""
        ratio = jnp.asarray(self.first * jnp.exp(z))
        return jnp.where(jnp.asarray(self.positive), ratio, jnp.asarray(self.first + self.size * jnp.sinh(z)))

    def lowest(self, z: NumpyArray) -> Float[NumpyArray, "p"]:
        """Least steps (p,) from z: there are no bounds."""
        return np.full(len(z), -np.inf)

    def relative(self, values: Float[NumpyArray, "p"]) -> Float[NumpyArray, "p"]:
        """Relative changes z (p,) that give these parameters."""
        positive = np.asarray(self.positive)
        # A number that is not bounded may start from zero, or have become zero.
        ratio = np.where(positive, values, 1.0) / np.where(positive, np.asarray(self.first), 1.0)
        change = np.arcsinh((values - self.first) / np.asarray(self.size))
        return np.where(positive, np.log(ratio), change)

    def moved(self, z: NumpyArray, dz: NumpyArray) -> NumpyArray:
        """Unknowns (p,) after a step that is linear in the values, or for a positive parameter that falls in its
        inverse, since forces are linear in friction and accelerations in inverse masses."""
        positive = z + np.sign(dz) * np.log1p(np.abs(dz))
        return np.where(np.asarray(self.positive), positive, np.arcsinh(np.sinh(z) + np.cosh(z) * dz))

    def multiplied(self, z: NumpyArray, j: int, factor: float) -> NumpyArray:
        """Unknowns (p,) with parameter j multiplied by a factor; a parameter of zero is moved by its logarithm."""
        value = np.asarray(self.values(jnp.asarray(z)))
        target = value * factor if value[j] else value + np.log(factor) * np.asarray(self.size)
        return np.where(np.arange(len(z)) == j, self.relative(np.where(np.arange(len(z)) == j, target, value)), z)

    def fixed_at(self, z: NumpyArray) -> NumpyArray:
        """Values (p,) of z at which undetermined combinations are fixed: 0, or the z of a vanishing parameter."""
        return np.where(np.asarray(self.positive) & (z < -PRIOR), z, 0.0)

    def slopes(self, z) -> Float[Array, "p"]:
        """Derivative of each parameter in its relative change."""
        return jnp.where(jnp.asarray(self.positive), self.first * jnp.exp(z), self.size * jnp.cosh(z))


def _as_it_is(model: MechanicalSystem, values: Any) -> tuple[MechanicalSystem, float]:
    del values
    return model, 0.0
