"""Friction and rotor inertia that a model lacks, from the torques that its motion along a log needs beyond the logged.

The balance of torques at measured positions, velocities and accelerations is linear in these numbers, so least squares
give them. Of the blocks of time two in three fit them, and the third ones judge the model that has them.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from covariant._typing import MatrixField, Vector
from covariant.calibration.diagnosis._alternatives import BLOCKS, HELD_OUT, Blocks, better
from covariant.calibration.diagnosis._changes import Names
from covariant.calibration.diagnosis._finding import Finding
from covariant.calibration.diagnosis._residual import Residual, averaged, residual
from covariant.calibration.diagnosis._smooth import Smooth
from covariant.models import Lagrangian, MechanicalSystem, resistance

VISIBLE = 0.01
"""Fraction of the squares of the accelerations that a model has to leave beyond noise: 10 % of their size."""
EXPLAINED = 0.15
"""Fraction that may be left: a wrong mass or centre of mass that friction or a rotor resembles leaves more."""
SMOOTHED = 0.05
"""Speed over which dry friction is smoothed, relative to the root mean square of the speed of the joint."""
NEEDED = 1.25
"""A number is named where the model leaves this many times as much without it as with all."""
KINDS = ("viscous friction", "Coulomb friction", "rotor inertia")
OF_CHAIN = {
    "viscous friction": ("viscous", 1.0),
    "Coulomb friction": ("coulomb", 2 / np.pi),  # times atan(100 v), which ends at pi/2
    "rotor inertia": ("rotor_inertia", 1.0),
}
"""What a chain of pendulums calls them, and its numbers in these."""


class MissingTorques(NamedTuple):
    """Friction and rotor inertia that a model lacks.

    Attributes:
        kinds: Names of the numbers, from `KINDS`.
        joints: Index of the coordinate of each.
        values: Values [SI units], positive.
        model: The model with them.
        before, after: Fractions of the squares of the accelerations that the model leaves on blocks that are held out.
    """

    kinds: tuple[str, ...]
    joints: tuple[int, ...]
    values: tuple[float, ...]
    model: MechanicalSystem
    before: float
    after: float

    @property
    def what(self) -> str:
        """Name of the finding."""
        of_kind = [name for name in ("friction", "rotor inertia") if any(kind.endswith(name) for kind in self.kinds)]
        return " and ".join(of_kind)

    def finding(self, names: Names, model: MechanicalSystem, system: str, wrong: bool) -> Finding:
        """Finding on friction and rotor inertia that a model lacks.

        Args:
            names: Columns of the log.
            model: The model that lacks them.
            system: Name of the model's system, where it is one of the library.
            wrong: Whether the data sheet does not admit what the model leaves.
        """
        shares = [f"{100 * share:.3g} %" for share in (self.before, self.after)]
        of = [f"{kind} of {names.q[joint]}" for kind, joint in zip(self.kinds, self.joints, strict=True)]
        sizes = [
            f"{kind} {value:.2g} {_unit(kind, bool(names.angles[joint]))} in {names.q[joint]}"
            for kind, joint, value in zip(self.kinds, self.joints, self.values, strict=True)
        ]
        evidence = (
            f"on rows held out the model leaves {shares[0]} of the squares of the accelerations as it is, {shares[1]} "
            f"with about {', '.join(sizes)}"
        )
        if "rotor inertia" in self.kinds:
            evidence += "; too small an inertia of the links looks like it"
        line = self._command(model, system) or f"give the model {self.what}"
        where = ", ".join(names.q[i] for i in sorted(set(self.joints)))
        numbers = {"unexplained": self.before, "unexplained_after": self.after} | dict(
            zip(of, self.values, strict=True)
        )
        return Finding(self.what, where, evidence, line, wrong, numbers)

    def _command(self, model: MechanicalSystem, system: str) -> str:
        """The command that fits them, for a robot or a chain of pendulums; "" for others."""
        fitted = f"covariant fit MODEL LOG --parameters {self._parameters(system, model.coordinates)}"
        if system != "pendulum_chain":
            return fitted if system == "robot" else ""
        # A file without a number, or with zeros, needs first values to fit from.
        for kind, (name, factor) in OF_CHAIN.items():
            stated = np.asarray(model.parameters[name].value)
            if kind in self.kinds and not stated.any():
                own = [i for i, each in enumerate(self.kinds) if each == kind]
                values = np.full(len(stated), 0.1 * min(self.values[i] for i in own))
                values[[self.joints[i] for i in own]] = [self.values[i] for i in own]
                geared = np.asarray(model.parameters["gear"].value) ** 2 if name == "rotor_inertia" else 1.0
                first = ", ".join(f"{value:.2g}" for value in factor * values / geared)
                fitted += f" --set 'parameters.{name}=[{first}]'"
        return fitted

    def _parameters(self, system: str, coordinates: Sequence[str]) -> str:
        if system == "pendulum_chain":
            return ",".join(name for kind, (name, _) in OF_CHAIN.items() if kind in self.kinds)
        joints = {"friction": set(), "armature": set()}
        for kind, joint in zip(self.kinds, self.joints, strict=True):
            joints["armature" if kind == "rotor inertia" else "friction"].add(joint)
        every = set(range(len(coordinates)))
        named = (
            [group] if of == every else [f"{group}.{coordinates[i]}" for i in sorted(of)]
            for group, of in joints.items()
            if of
        )
        return ",".join(name for names in named for name in names)


def _unit(kind: str, angle: bool) -> str:
    return {
        "viscous friction": ("N s/m", "N m s/rad"),
        "Coulomb friction": ("N", "N m"),
        "rotor inertia": ("kg", "kg m²"),
    }[kind][int(angle)]


def missing_torques(model: MechanicalSystem, log: Smooth) -> MissingTorques | None:
    """Friction and rotor inertia with which a model explains a log much better.

    Args:
        model: The mechanical system, in coordinates.
        log: The smoothed log.

    Returns:
        The numbers and the model with them; None where they do not leave less than half on the blocks held out and
        little in all, or where the model leaves little as it is.
    """
    before = residual(model, log)
    if not before.told.any() or before.used.sum() < 2 * BLOCKS:
        return None
    now = Blocks.of(before)
    if now.beyond_noise(HELD_OUT) < VISIBLE:
        return None
    regression = _Regression.of(model, log, before)
    needed = regression.needed()
    if not needed:
        return None
    found = regression.values(needed)
    numbers = np.zeros((len(KINDS), log.q.shape[1]))
    numbers.flat[needed] = found
    completed = with_torques(model, numbers[0], numbers[1], numbers[2], _speeds(log))
    after = Blocks.of(residual(completed, log), before)
    if not better(now, after) or after.beyond_noise(HELD_OUT) > EXPLAINED:
        return None
    kinds, joints = np.unravel_index(needed, numbers.shape)
    return MissingTorques(
        tuple(KINDS[k] for k in kinds),
        tuple(int(i) for i in joints),
        tuple(float(value) for value in found),
        completed,
        now.beyond_noise(HELD_OUT),
        after.beyond_noise(HELD_OUT),
    )


class _Regression(NamedTuple):
    """Accelerations of unit numbers (3n, J, n), residual ones (J, n), both in usual sizes, and rows held out (J,)."""

    columns: Float[np.ndarray, "k J n"]
    residual: Float[np.ndarray, "J n"]
    held_out: np.ndarray

    @classmethod
    def of(cls, model: MechanicalSystem, log: Smooth, before: Residual) -> "_Regression":
        told = before.told
        scale = np.sqrt(np.mean(before.measured[before.used] ** 2, axis=0))[told]
        torques = (-log.v, -np.tanh(log.v / _speeds(log)), -log.a)
        columns = []
        for kind, torque in zip(KINDS, torques, strict=True):
            raised = np.asarray(_raised(model, log.q, torque))  # (K, n, n): of each joint alone
            # Measured accelerations are averages already.
            smooth = (lambda values: values) if kind == "rotor inertia" else (lambda values: averaged(log, values))
            columns += [smooth(raised[:, i])[before.used][:, told] / scale for i in range(log.q.shape[1])]
        blocks = np.concatenate(
            [
                np.full(len(part), block)
                for block, part in enumerate(np.array_split(np.arange(before.used.sum()), BLOCKS))
            ]
        )
        return cls(np.array(columns), before.left[:, told] / scale, HELD_OUT[blocks])

    def needed(self) -> list[int]:
        """The numbers that matter beside the others, the least important dropped one after another."""
        used = [k for k, value in enumerate(self.values(range(len(self.columns)))) if value > 0]
        while used:
            without = {k: self._left([j for j in used if j != k]) for k in used}
            least = min(used, key=without.__getitem__)
            if without[least] > NEEDED * self._left(used):
                return used
            used.remove(least)
        return used

    def values(self, used: Sequence[int]) -> np.ndarray:
        """Least-squares values on the blocks that choose, none of them negative."""
        from scipy.optimize import nnls

        rows = self.columns[list(used)][:, ~self.held_out].reshape(len(used), -1).T
        size = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
        # The triangular factor has the same least squares as all rows.
        orthogonal, triangle = np.linalg.qr(rows / size)
        return nnls(triangle, orthogonal.T @ self.residual[~self.held_out].ravel())[0] / size

    def _left(self, used: Sequence[int]) -> float:
        """Mean square that is left on the blocks that choose; those held out judge the model that comes of it."""
        left = self.residual[~self.held_out]
        if used:
            left = left - np.einsum("k,kjn->jn", self.values(used), self.columns[used][:, ~self.held_out])
        return float(np.mean(left**2))


def _speeds(log: Smooth) -> Float[np.ndarray, "n"]:
    return SMOOTHED * np.maximum(np.sqrt(np.mean(log.v[log.used] ** 2, axis=0)), 1e-12)


@eqx.filter_jit
def _raised(model: MechanicalSystem, q, torque):
    """Accelerations (K, n, n) by the torque of each joint alone."""

    def at(q, torque):
        return jax.vmap(lambda covector: model.space.raise_(q, covector))(jnp.diag(torque))

    return jax.vmap(at)(q, torque)


class _WithRotors(eqx.Module):
    """Inertia matrix with rotors at the joints."""

    metric: MatrixField
    inertia: Vector

    def __call__(self, q):
        return self.metric(q) + jnp.diag(self.inertia)


class _WithFriction(eqx.Module):
    """Dissipation of a model with further friction in the joints."""

    model: MechanicalSystem
    viscous: Vector
    coulomb: Vector
    resting: Vector

    def __call__(self, t, q, v, u):
        friction = self.viscous * v + self.coulomb * jnp.tanh(v / self.resting)
        return resistance(self.model, t, q, v, u) - friction


def with_torques(
    model: MechanicalSystem,
    viscous: Float[np.ndarray, "n"],
    coulomb: Float[np.ndarray, "n"],
    rotors: Float[np.ndarray, "n"],
    resting: Float[np.ndarray, "n"],
) -> Lagrangian:
    """A model in coordinates with further friction and rotors in its joints.

    Args:
        model: The mechanical system.
        viscous: Coefficients (n,) of viscous friction [N m s/rad or N s/m].
        coulomb: Coulomb friction (n,) [N m or N].
        rotors: Inertia (n,) of rotors, as felt at the joints [kg m² or kg].
        resting: Speeds (n,) over which the Coulomb friction is smoothed.
    """
    return Lagrangian(
        _WithRotors(model.space, jnp.asarray(rotors)),  # pyright: ignore[reportArgumentType]
        model.potential,
        model.force,
        _WithFriction(model, *map(jnp.asarray, (viscous, coulomb, resting))),
        model.circles,
        coordinates=model.coordinates,
        units=model.units,
        inputs=model.inputs,
    )
