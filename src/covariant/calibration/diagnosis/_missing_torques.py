"""The suspicions that a model lacks friction and rotor inertia, and that a log lacks the torques that carry the weight.

Its motion along a log then needs more torques than were logged. Their balance at measured positions, velocities and
accelerations is linear in the missing numbers, so least squares give them, on the blocks of time that choose.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._typing import MatrixField, Vector
from covariant.calibration.diagnosis._case import Case, Residual, averaged, input_effects, residual
from covariant.calibration.diagnosis._smooth import Smooth
from covariant.calibration.diagnosis._suspicion import HELD_OUT, Suspicion, blocks_of
from covariant.calibration.diagnosis._thresholds import NEEDED, THRESHOLDS, WEIGHTLESS
from covariant.models import Lagrangian, MechanicalSystem, Parametric, resistance

SMOOTHED = 0.05
"""Speed over which dry friction is smoothed, relative to the root mean square of the speed of the joint."""
LARGEST_ROTOR = 1e4
"""Largest inertia of a rotor behind a gear, over that of the links at its joint: slow motions in another unit of time
look like a larger one."""
TURNS = np.array([[1e-3], [3e-3], [1e-2]])
"""Distances over which friction may turn at a reversal, as fractions of the range of a coordinate."""
KINDS = ("viscous friction", "Coulomb friction", "inertia")
"""Missing torques; `Vocabulary` has the word for the inertia."""
OF_CHAIN = {
    "viscous friction": ("viscous", 1.0),
    "Coulomb friction": ("coulomb", 2 / np.pi),  # times atan(100 v), which ends at pi/2
    "inertia": ("rotor_inertia", 1.0),
}
"""What a chain of pendulums calls them, and its numbers in these."""
UNITS = {"viscous friction": ("N s/m", "N m s/rad"), "Coulomb friction": ("N", "N m"), "inertia": ("kg", "kg m²")}
"""Units of their numbers, for a coordinate that is a length and one that is an angle."""


def missing_torques(case: Case, log: Smooth) -> Iterator[Suspicion]:
    """Torques that model or log lack, fitted to the smoothed log: gravity, friction, both, and rotor inertia."""
    before = residual(case.model, log)
    if not before.told.any() or before.misfit < THRESHOLDS["torques"].least:
        return
    regression = _Regression.of(case.model, log, before)
    weightless = without_gravity(case.model)
    after = None if weightless is None else residual(weightless, log)
    beyond = None if after is None else regression.weightless(after)
    left = float("nan") if after is None else after.misfit
    friction = range(2 * log.q.shape[1])
    speeds = _speeds(log)
    light = case._replace(model=weightless)
    if beyond is not None:
        yield _suspicion(light, beyond, [], speeds, "torques", True)
    if needed := regression.needed(friction):
        yield _suspicion(case, regression, needed, speeds, "torques")
    if beyond is not None and left >= THRESHOLDS["torques"].least and (needed := beyond.needed(friction)):
        yield _suspicion(light, beyond, needed, speeds, "torques", True)
    every = regression.needed()
    if every and every[-1] >= len(friction):
        missing, inertia = regression.missing(every), _inertias(case.model, log)
        rotors = [each.value / inertia[each.joint] for each in missing if each.kind == "inertia"]
        if max(rotors) < LARGEST_ROTOR:
            yield _suspicion(case, regression, every, speeds, "rotors")


def friction_beside_scales(case: Case, log: Smooth) -> Iterator[Suspicion]:
    """Friction that a model lacks, fitted together with the scale of each input, which may be wrong as well."""
    before = residual(case.model, log)
    if not log.u.shape[1] or not before.told.any() or before.misfit < THRESHOLDS["torques"].least:
        return
    regression = _Regression.of(case.model, log, before).beside_inputs(case.model, log)
    if needed := regression.needed(range(2 * log.q.shape[1])):
        yield _suspicion(case, regression, needed, _speeds(log), "torques")


def _suspicion(
    case: Case,
    regression: "_Regression",
    needed: list[int],
    speeds: np.ndarray,
    threshold: str,
    weightless: bool = False,
) -> Suspicion:
    """The suspicion that a model lacks these torques; `case` has the model without gravity where it is about that."""
    missing = regression.missing(needed) if needed else []
    table, names = np.zeros((len(KINDS), len(case.names.q))), case.names
    for kind, joint, value in missing:
        table[KINDS.index(kind), joint] = value
    model = with_torques(case.model, table[0], table[1], table[2], speeds) if missing else case.model
    vocabulary = case.file.vocabulary
    called = {kind: kind for kind in KINDS} | {"inertia": vocabulary.inertia}
    named = ["friction"] * bool(table[:2].any()) + [vocabulary.inertia] * bool(table[2].any())
    what = " and ".join(["gravity"] * weightless + named)
    sizes = ", ".join(
        f"{called[kind]} {value:.2g} {UNITS[kind][int(names.angles[joint])]} in {names.q[joint]}"
        for kind, joint, value in missing
    )
    alike = f"; {vocabulary.like_it} looks like it" if table[2].any() else ""
    if alike and case.file.system == "pendulum_chain" and np.all(np.asarray(case.model.parameters["gear"].value) == 1):
        alike += (
            ", and behind a gear it is the rotor's times the square of [parameters] gear, which has to be set first"
        )
    words = ["where the inputs of the log are without those that carry the weight"] * weightless
    words += [f"with about {sizes}{alike}"] * bool(missing)
    lines = ["[parameters] gravity = 0, as the log has the inputs beyond gravity compensation"] * weightless
    lines += [_command(case, missing) or f"give the model {' and '.join(named)}"] * bool(missing)
    return Suspicion(
        what,
        ", ".join(names.q[i] for i in sorted({each.joint for each in missing})),
        " and ".join(words),
        "; ".join(lines),
        lambda case: case._replace(model=model),
        threshold,
        numbers={f"{called[kind]} of {names.q[joint]}": value for kind, joint, value in missing},
        expected=regression.left(needed),
    )


@eqx.filter_jit
def weights(model: MechanicalSystem, q: Float[np.ndarray, "K n"]) -> Float[Array, "K n"]:
    """Torques (K, n) that hold the weight of a model, and its springs."""
    return jax.vmap(jax.grad(model.potential))(q)


def by_joints(model: MechanicalSystem, log: Smooth, torque: Float[np.ndarray, "K n"]) -> list[np.ndarray]:
    """Accelerations (K, n) by the torque of each joint alone."""
    raised = np.asarray(_accelerations_by_torque(model, log.q, torque))
    return [raised[:, i] for i in range(log.q.shape[1])]


def friction_columns(model: MechanicalSystem, log: Smooth) -> list[Float[np.ndarray, "K n"]]:
    """Averaged accelerations by a unit of viscous friction in each joint, and by one of Coulomb friction."""
    torques = (-log.v, -np.tanh(log.v / _speeds(log)))
    return [averaged(log, each) for torque in torques for each in by_joints(model, log, torque)]


def turning_friction(log: Smooth) -> Iterator[Float[np.ndarray, "K n"]]:
    """Torques of a unit of friction that turns over a distance at a reversal, by Dahl's law, for several distances."""
    signs, steps = np.sign(log.v), np.abs(np.diff(log.q, axis=0, prepend=log.q[:1]))
    for distance in TURNS * np.ptp(log.q, axis=0):
        kept = np.exp(-steps / np.maximum(distance, np.finfo(float).tiny))
        state, torque = np.zeros_like(signs[0]), np.empty_like(signs)
        for k in range(len(signs)):
            torque[k] = state = signs[k] + (state - signs[k]) * kept[k]
        yield -torque


def without_gravity(model: MechanicalSystem) -> MechanicalSystem | None:
    """The model without gravity; None where its potential names no gravity, or has none."""
    potential: Any = model.potential
    held = potential.parameters if isinstance(potential, Parametric) else vars(potential)
    if "gravity" not in held or not np.any(np.asarray(held["gravity"])):
        return None
    nothing = jnp.zeros_like(held["gravity"])
    if isinstance(potential, Parametric):
        return eqx.tree_at(lambda each: each.potential.parameters["gravity"], model, nothing)
    return eqx.tree_at(lambda each: each.potential.gravity, model, nothing)


class _Missing(NamedTuple):
    kind: str
    joint: int
    value: float


def _command(case: Case, missing: list[_Missing]) -> str:
    """The command that fits them; "" for a model that has no such numbers."""
    model, kinds = case.model, {each.kind for each in missing}
    if case.file.system == "robot":
        return f"covariant fit MODEL LOG --parameters {_robot_parameters(missing, model.coordinates)}"
    named = [name for kind, (name, _) in OF_CHAIN.items() if kind in kinds]
    fitted = f"covariant fit MODEL LOG --parameters {','.join(named)}"
    if case.file.system != "pendulum_chain":
        return fitted if set(named) <= set(case.file.stated) else ""  # drafts of `init` name them as the chain does
    # A file without a number, or with zeros, needs first values to fit from.
    for kind, (name, factor) in OF_CHAIN.items():
        stated, values = np.asarray(model.parameters[name].value), {i: x for k, i, x in missing if k == kind}
        if values and not stated.any():
            first = np.array([values.get(i, 0.1 * min(values.values())) for i in range(len(stated))])
            geared = np.asarray(model.parameters["gear"].value) ** 2 if kind == "inertia" else 1.0
            fitted += f" --set 'parameters.{name}=[{', '.join(f'{x:.2g}' for x in factor * first / geared)}]'"
    return fitted


def _robot_parameters(missing: list[_Missing], coordinates: Sequence[str]) -> str:
    named = []
    for group, rotor in (("friction", False), ("armature", True)):
        joints = sorted({each.joint for each in missing if (each.kind == "inertia") == rotor})
        whole = len(joints) == len(coordinates)
        named += [group] if whole else [f"{group}.{coordinates[i]}" for i in joints]
    return ",".join(named)


class _Regression(NamedTuple):
    """Accelerations of unit numbers (3n, J, n), residual ones (J, n), both in usual sizes, and rows held out (J,).

    `before` is what the model leaves as it is, whose measured accelerations have these sizes.
    """

    columns: Float[np.ndarray, "k J n"]
    residual: Float[np.ndarray, "J n"]
    held_out: np.ndarray
    before: Residual

    def sized(self, values: Float[np.ndarray, "K n"]) -> Float[np.ndarray, "J n"]:
        """Accelerations on the grid, at the points and of the coordinates that are compared, in usual sizes."""
        used, told = self.before.used, self.before.told
        return (values[used] / np.sqrt(np.mean(self.before.measured[used] ** 2, axis=0)))[:, told]

    @classmethod
    def of(cls, model: MechanicalSystem, log: Smooth, before: Residual) -> "_Regression":
        held_out = HELD_OUT[blocks_of(int(before.used.sum()))]
        made = cls(np.empty((0, 0, 0)), np.empty((0, 0)), held_out, before)
        # Measured accelerations are averages already.
        columns = [*friction_columns(model, log), *by_joints(model, log, -log.a)]
        columns = np.array([made.sized(each) for each in columns])
        return made._replace(columns=columns, residual=made.sized(before.measured - before.modelled))

    def weightless(self, after: Residual) -> "_Regression | None":
        """The same for residuals of the model without gravity; None where the log has some of its gravity."""
        weight = self.sized(self.before.modelled - after.modelled)[~self.held_out]
        if not np.any(weight):
            return None
        left = self.sized(after.measured - after.modelled)
        # What is left beside friction is compared with the weight itself, so that a wrong mass is not taken for it.
        columns = [weight.ravel(), *(column[~self.held_out].ravel() for column in self.columns[: self.friction])]
        table = np.stack(columns, axis=1)
        multiple = np.linalg.lstsq(table, left[~self.held_out].ravel(), rcond=1e-9)[0][0]
        return self._replace(residual=left) if abs(multiple) < WEIGHTLESS else None

    def beside_inputs(self, model: MechanicalSystem, log: Smooth) -> "_Regression":
        """The same without what a multiple of each input explains, on the blocks that choose."""
        effects = [self.sized(effect) for effect in input_effects(model, log, self.before)]
        chosen = np.stack([effect[~self.held_out].ravel() for effect in effects], axis=1)

        def beside(values):
            multiples = np.linalg.lstsq(chosen, values[~self.held_out].ravel(), rcond=1e-9)[0]
            return values - np.einsum("j,jkn->kn", multiples, np.array(effects))

        return self._replace(columns=np.array([beside(each) for each in self.columns]), residual=beside(self.residual))

    @property
    def friction(self) -> int:
        """Number of columns of friction, which are the first ones."""
        return len(self.columns) // len(KINDS) * KINDS.index("inertia")

    def missing(self, needed: list[int]) -> list["_Missing"]:
        """The numbers that matter, with their names."""
        kinds, joints = np.unravel_index(needed, (len(KINDS), len(self.columns) // len(KINDS)))
        values = self.values(needed)
        return [_Missing(KINDS[k], int(i), float(x)) for k, i, x in zip(kinds, joints, values, strict=True)]

    def needed(self, allowed: Sequence[int] | None = None) -> list[int]:
        """The numbers that matter beside the others, the least important dropped one after another."""
        tried = list(range(len(self.columns)) if allowed is None else allowed)
        used = [k for k, value in zip(tried, self.values(tried), strict=True) if value > 0]
        while used:
            without = {k: self.left([j for j in used if j != k]) for k in used}
            least = min(used, key=without.__getitem__)
            if without[least] > NEEDED * self.left(used):
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

    def left(self, used: Sequence[int]) -> float:
        """Mean square that is left on the blocks that choose; those held out judge the model that comes of it."""
        left = self.residual[~self.held_out]
        if used:
            left = left - np.einsum("k,kjn->jn", self.values(used), self.columns[used][:, ~self.held_out])
        return float(np.mean(left**2))


def _inertias(model: MechanicalSystem, log: Smooth) -> Float[np.ndarray, "n"]:
    """Usual inertia (n,) of the model that each joint moves."""
    some = jnp.asarray(log.q[log.used][:: max(1, len(log.q) // 20)])
    return np.median(np.diagonal(jax.vmap(model.space)(some), axis1=1, axis2=2), axis=0)


def _speeds(log: Smooth) -> Float[np.ndarray, "n"]:
    return SMOOTHED * np.maximum(np.sqrt(np.mean(log.v[log.used] ** 2, axis=0)), 1e-12)


@eqx.filter_jit
def _accelerations_by_torque(model: MechanicalSystem, q, torque):
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
    """A model in coordinates with further friction and rotors in its joints."""
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
