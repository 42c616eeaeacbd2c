"""Torques that a motion of a robot needs, their derivatives in its open numbers, and which numbers a log determines."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from covariant.calibration._least_squares import PRIOR
from covariant.calibration.diagnosis import acceleration_kernel
from covariant.calibration.identification._robot_combinations import Combinations, combinations
from covariant.geometry import differential
from covariant.models import MechanicalSystem, RobotFamily, applied_force, input_count, resistance
from covariant.models.robots import servos_in
from scalargraph import on_batches

KNOWN = 0.1
"""The log shows a number if its standard error is below this fraction of its standard deviation in the prior."""
USEFUL = 0.1
"""Smallest useful value of a number, as a fraction of its usual size; the log must distinguish it from zero."""
APART = 2.0, 3.0
"""Standard errors that must separate zero from the smallest useful value, and a value from zero."""
WINDOWS = (1.0, 2.0, 4.0, 8.0)
"""Half windows that are compared, in multiples of the shortest; the one with the smallest standard errors is used."""
RESTING = 0.1
"""If a joint may stick in this fraction of a window or more, its torque is not used: a joint that sticks holds any
torque up to the dry friction."""
STICKING, SLOW = 3.0, 0.3
"""A joint sticks below 3 times the speed that smooths dry friction, as tanh(3) is 1 up to half a per cent. In a slow
motion the limit is 0.3 times the usual speed, but at least the smoothing speed."""
FEWEST = 5
"""Least number of samples in half a window."""
BLOCK = 6.0
"""Length of a block, in half windows, over which residuals may be correlated."""
FEWEST_BLOCKS = 12
BATCH = 1024


class Torques(NamedTuple):
    """The robot as functions of the coordinates x.

    Attributes:
        rows: Turns a function of the model and one row into `(x, *columns) -> values` at all rows. Its graph in NumPy
            evaluates it: a fit calls it a few dozen times, which takes less than to compile a program of JAX.
        derivatives: Derivatives (K, n, p) of the torques in x, at x and K rows (q, v, a, u) of a motion.
        slopes: `x -> function of rows` that returns these derivatives (n, p) of each row, and their derivatives (n, p,
            n + n + n + m) in the row; compiled, for searches.
    """

    rows: Callable[[Callable[..., Array]], Callable[..., np.ndarray]]
    derivatives: Callable[..., np.ndarray]
    slopes: Callable[[np.ndarray], Callable[..., tuple[Array, Array]]]

    @classmethod
    def of(cls, family: RobotFamily) -> "Torques":
        """The functions of a family."""
        arrays, model = flattened(family)

        def rows(function: Callable[..., Array]) -> Callable[..., np.ndarray]:
            return at_rows(lambda x, *row: function(model(arrays(x)), *row))

        # Torques are fewer than numbers: reverse mode from each torque.
        derivatives = at_rows(lambda x, *row: jax.jacrev(lambda x: _torque(model(arrays(x)), *row))(x))

        @jax.jit
        def with_slopes(flat: Array, slopes: Array, *columns: Array) -> tuple[Array, Array]:
            def one(row: Array, n: int) -> tuple[Array, Array]:
                def torques(part: Array) -> Array:
                    return _torque(model(part), *jnp.split(row, [n, 2 * n, 3 * n]))

                # Forward mode to the numbers, and then to the row; reverse mode twice takes much longer to compile.
                derivative = jax.vmap(lambda d: jax.jvp(torques, (flat,), (d,))[1], in_axes=1, out_axes=1)(slopes)
                return derivative, derivative

            n = columns[0].shape[1]
            slope, value = jax.vmap(jax.jacfwd(lambda row: one(row, n), has_aux=True))(jnp.concatenate(columns, axis=1))
            return value, slope

        slopes_at = jax.jit(jax.jacfwd(arrays))

        def slopes(x: np.ndarray) -> Callable[..., tuple[Array, Array]]:
            flat, to_arrays = arrays(x), slopes_at(x)
            return lambda *columns: with_slopes(flat, to_arrays, *columns)

        return cls(rows, derivatives, slopes)


def flattened(family: RobotFamily) -> tuple[Callable[..., Array], Callable[[Array], Any]]:
    """The arrays of the robot as one vector, by the coordinates x; and the robot by that vector."""
    whole: list[Callable[[Any], Any]] = []

    @jax.jit  # traced once for all functions of the robot
    def arrays(x: Array) -> Array:
        numbers, static = eqx.partition(family.make(x), eqx.is_inexact_array)
        flat, unravel = ravel_pytree(numbers)
        whole[:] = [lambda flat: eqx.combine(unravel(flat), static)]
        return flat

    # Traced, since a term whose numbers are zero at first is a part of the robot too.
    jax.eval_shape(arrays, jnp.zeros(len(family.names)))
    return arrays, whole[0]


def at_rows(function: Callable[..., Array]) -> Callable[..., np.ndarray]:
    """A function `(fixed, *row)` at all rows of some columns, by its graph, which is made at the first call."""
    graphs: dict[tuple[int, ...], Callable[..., np.ndarray]] = {}

    def evaluate(fixed: Any, *columns: np.ndarray) -> np.ndarray:
        widths = tuple(column.shape[1] for column in columns)
        if widths not in graphs:
            graphs[widths] = on_batches(function, fixed, *(column[0] for column in columns))
        once = jax.tree.map(lambda leaf: leaf[None], fixed)
        return batched(lambda *part: graphs[widths](once, *part), columns)

    return evaluate


class Determined(NamedTuple):
    """Which numbers a log determines, and how well.

    Attributes:
        standard_errors: Standard errors (p,); NaN for a number that the log does not show by itself.
        determined: Whether the log shows each number (p,), and distinguishes either its value or a tenth of its usual
            size from zero.
        combinations: Combinations that the log determines, of numbers that it cannot distinguish.
        prior: Standard deviations (p,) of the numbers before the log.
    """

    standard_errors: Float[np.ndarray, "p"]
    determined: Bool[np.ndarray, "p"]
    combinations: Combinations
    prior: Float[np.ndarray, "p"]

    @classmethod
    def of(
        cls,
        family: RobotFamily,
        x: Float[np.ndarray, "p"],
        sizes: Float[np.ndarray, "p"],
        information: Float[np.ndarray, "p p"],
        covariance: Float[np.ndarray, "p p"],
    ) -> "Determined":
        """Evaluate the information on coordinates x (p,), without the prior, and their covariance, with the prior."""
        slopes = np.asarray(jax.jit(jax.jacfwd(family.values))(x))
        prior = np.sqrt(np.sum((slopes * sizes * PRIOR) ** 2, axis=1))
        errors = np.sqrt(np.einsum("ij,jk,ik->i", slopes, covariance, slopes))
        to_linear = np.asarray(jax.jit(jax.jacfwd(family.linear))(x))
        undetermined = combinations(family, information, to_linear, sizes * PRIOR, KNOWN)
        # A number that only a combination shows, even one with a small part of others, is not known by itself.
        combined = np.isin(family.names, undetermined.leading)
        shown = (errors < KNOWN * prior) & ~combined
        values = np.asarray(jax.jit(family.values)(x))
        nonzero = told_from_zero(values, errors, prior / PRIOR)
        return cls(np.where(shown, errors, np.nan), shown & nonzero, undetermined, prior)


def told_from_zero(values: np.ndarray, errors: np.ndarray, usual: np.ndarray) -> Bool[np.ndarray, "p"]:
    """Whether numbers (p,) differ from zero, or cannot be of a useful size, by their standard errors."""
    return (APART[0] * errors < USEFUL * usual) | (APART[1] * errors < np.abs(values))


def needed(model: MechanicalSystem, q: Array, v: Array, a: Array) -> Array:
    """Torques (n,) that a motion needs, without friction."""
    weight = differential(model.manifold, model.potential, q)
    return model.space.lower(q, a) + model.space.connection_force(q, v, v) + weight


def efforts(model: MechanicalSystem, q: Array, v: Array, a: Array) -> Float[Array, "2 n"]:
    """Torques (n,) that the motors have to give for a motion, and those that it needs without friction."""
    without, servos = needed(model, q, v, a), servos_in(model)
    if servos is None:
        braking = resistance(model, jnp.zeros(()), q, v, jnp.zeros(input_count(model, len(q))))
    else:
        # Of a servo it is the torque within its limit, so that its own damping is no load.
        lost: Any = model.dissipation
        braking = lost.friction(q, v) - servos.rows.T @ (servos.back_emf * (servos.rows @ v))
    return jnp.stack([without - braking, without])


def motor_matrix(model: MechanicalSystem) -> Float[np.ndarray, "n m"]:
    """Generalised force (n, m) of a unit of each input."""
    origin = model.manifold.origin()
    zero = jnp.zeros(input_count(model, len(origin)))
    return np.asarray(jax.jit(jax.jacfwd(lambda u: model.force(jnp.zeros(()), origin, u)))(zero))


class InverseInputs(NamedTuple):
    """Inputs that torques need, the smallest where there are more than joints: `force τ + position q + rate v + bias`.

    Those of motors depend on the torques (m, n) alone, and commands on positions (m, n) and rates (m, n) too.
    """

    force: Float[np.ndarray, "m n"]
    position: Float[np.ndarray, "m n"]
    rate: Float[np.ndarray, "m n"]
    bias: Float[np.ndarray, "m"]

    def apply(self, torque: np.ndarray, q: np.ndarray, v: np.ndarray) -> Float[np.ndarray, "T m"]:
        """Inputs (T, m) at rows (T, n)."""
        return torque @ self.force.T + q @ self.position.T + v @ self.rate.T + self.bias


def inverse_inputs(model: MechanicalSystem) -> InverseInputs:
    """Inputs as functions of the torques that `efforts` returns."""
    servos = servos_in(model)
    if servos is None:
        inverse = np.linalg.pinv(motor_matrix(model))
        return InverseInputs(inverse, 0 * inverse, 0 * inverse, np.zeros(len(inverse)))
    rows, stiffness, damping, offset, zero = (
        np.asarray(each) for each in (servos.rows, servos.stiffness, servos.damping, servos.offset, servos.zero)
    )
    # With e the error, k e − d v is the torque, and e + q − offset what is commanded.
    to_inputs = np.linalg.pinv(np.asarray(servos.commands))
    to_servos = np.linalg.pinv(rows.T)
    bias = to_inputs @ (zero - offset)
    for places, value in ((servos.switches, 1.0), (servos.volts, servos.supply)):
        for servo, place in enumerate(places):
            if place >= 0:
                bias[place] = np.broadcast_to(value, len(places))[servo]
    return InverseInputs(
        to_inputs @ (to_servos / stiffness[:, None]),
        to_inputs @ rows,
        to_inputs @ (rows * (damping / stiffness)[:, None]),
        bias,
    )


def usual_sizes(
    family: RobotFamily, driving: np.ndarray, without_friction: np.ndarray, v: np.ndarray, a: np.ndarray
) -> tuple[Float[np.ndarray, "p"], Float[np.ndarray, "n"]]:
    """Usual sizes of the open numbers in a motion, and usual speeds of the joints."""
    motors, needs, speed, acceleration = (
        np.maximum(np.sqrt(np.mean(each**2, axis=0)), 1e-9) for each in (driving, without_friction, v, a)
    )
    return family.sizes(np.maximum(motors, needs), speed, acceleration), speed


def motor_inputs(
    model: MechanicalSystem, q: Float[np.ndarray, "T n"], v: Float[np.ndarray, "T n"], a: Float[np.ndarray, "T n"]
) -> tuple[Float[np.ndarray, "T m"], Float[np.ndarray, "n m"]]:
    """Inputs that a motion of a robot needs, by inverse dynamics with its friction.

    Args:
        model: The robot.
        q: Positions (T, n).
        v: Velocities (T, n).
        a: Accelerations (T, n).

    Returns:
        The inputs (T, m), the smallest ones where there are more than joints; and the torques (n, m) of a unit of each.

    Example:
        >>> import numpy as np
        >>> from covariant import models
        >>> from covariant.calibration import motor_inputs
        >>> still = np.zeros((1, 2))
        >>> motor_inputs(models.robots.load("double_pendulum"), np.array([[0.0, np.pi / 2]]), still, still)[0].round(3)
        array([[0.51, 0.51]])
    """
    return inverse_inputs(model).apply(in_batches(efforts, model, q, v, a)[:, 0], q, v), motor_matrix(model)


def _torque(model: MechanicalSystem, q: Array, v: Array, a: Array, u: Array) -> Array:
    """Torques (n,) that a motion needs beyond those that act; zero for the motion that the model predicts."""
    acting = applied_force(model, jnp.zeros(()), q, u) + resistance(model, jnp.zeros(()), q, v, u)
    return model.space.lower(q, a) + model.space.connection_force(q, v, v) - acting


def in_batches(function: Callable[..., Array], model: MechanicalSystem, *columns: np.ndarray) -> np.ndarray:
    """Evaluate a function of a model and one row at all rows, in batches."""
    return batched(lambda *part: mapped(function, model, *part), columns)


def batched(
    function: Callable[..., Array | np.ndarray], columns: Sequence[np.ndarray], batch: int = BATCH
) -> np.ndarray:
    """Evaluate a function of `batch` rows at all rows."""
    count = len(columns[0])
    size = -(-count // batch) * batch
    padded = [np.concatenate([c, np.repeat(c[-1:], size - count, axis=0)]) for c in columns]
    parts = [np.asarray(function(*(c[i : i + batch] for c in padded))) for i in range(0, size, batch)]
    return np.concatenate(parts)[:count]


@eqx.filter_jit
def mapped(function: Callable[..., Any], model: MechanicalSystem, *columns: Array) -> Any:
    """Evaluate a function of the model and one row at these rows."""
    return jax.vmap(lambda *row: function(model, *row))(*columns)


def sticking_speeds(family: RobotFamily, usual: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Speeds (n,) below which each joint may stick, by its usual speed (n,); 0 for one without dry friction."""
    resting = np.array(family.resting)
    return np.clip(SLOW * usual, resting, STICKING * resting)


def averaging(half: float, step: float) -> np.ndarray:
    """Weights of true accelerations, at points of a grid, in the residual acceleration of a window."""
    kernel = acceleration_kernel(half, max(int(half / step), 3))
    return kernel / kernel.sum()


def convolved(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Values (K, …) along an even grid, convolved with weights (k,)."""
    from scipy.signal import oaconvolve

    flat = values.reshape(len(values), -1)
    return oaconvolve(flat, weights[:, None], mode="same", axes=0).reshape(values.shape)
