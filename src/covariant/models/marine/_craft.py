"""Models a marine craft in Fossen's vectorial form: velocities in the body frame, positions in the earth frame.

Source: Jouffroy & Fossen 2004, equations (38)–(39) and (80)–(85); Fossen 2011, Handbook of Marine Craft Hydrodynamics
and Motion Control, chapters 2 and 6, for the kinematics and the Coriolis matrix.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from covariant._linalg import solve, solve_square
from covariant._typing import Matrix, Numbers, Scalar, Vector
from covariant.geometry import wrap
from covariant.geometry.lie import SE2, SE3, SO3, rotation_from_quaternion
from covariant.models._mechanical import check_shapes
from covariant.models._parameters import Parameter, Parametric
from covariant.models._state_space import StateSpace, state_space
from scalargraph.errors import InputError


class Craft(eqx.Module):
    """A marine craft `η' = J(η)ν`, `Mν' + C(ν)ν + D(ν)ν + g(η) = τ`, whose position η is measured; the input is τ.

    It is the usual model form of marine engineering, in any number of degrees of freedom, for `craft_observer` and
    `Backstepping`. ν is in the body frame and η in the earth frame, so ν is not the derivative of η. It has n
    coordinates and m velocities; n > m if the attitude is a quaternion, which has no singular attitude. `state_space`
    converts it for Kalman filters; `underwater_vehicle` is a vehicle on SE(3).

    Attributes:
        mass: Inertia matrix M (m, m), added mass included, symmetric positive definite.
        transform: `J(η)` (n, m), of rank m.
        damping: `D(ν)` (m, m).
        restoring: `g(η)` (m,); zero by default, if n = m.
        coriolis: `C(ν)` (m, m), skew-symmetric; zero by default.
        coordinates: Names of the entries of η.
        units: Units of the entries of η.
        velocities: Names of the entries of ν.
        velocity_units: Units of the entries of ν, by default the units of η per second.
        circles: Indices of coordinates that are angles on a full circle [rad].
        parameters: A `Parameter` for each name, as documentation.

    Raises:
        ValueError: A matrix or function has the wrong shape, or M is not symmetric positive definite.

    Example:
        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> from covariant import models
        >>> sledge = models.marine.Craft(
        ...     2.0 * np.eye(1),
        ...     lambda eta: jnp.eye(1),
        ...     lambda nu: jnp.eye(1),
        ...     coordinates=("x",),
        ...     units=("m",),
        ...     velocities=("surge",),
        ... )
        >>> sledge.acceleration(jnp.zeros(1), jnp.array([4.0]), jnp.zeros(1)).tolist()
        [-2.0]
    """

    mass: Matrix
    transform: Callable[[Array], Array]
    damping: Callable[[Array], Array]
    restoring: Callable[[Array], Array]
    coriolis: Callable[[Array], Array]
    coordinates: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    velocities: tuple[str, ...] = eqx.field(static=True)
    velocity_units: tuple[str, ...] = eqx.field(static=True)
    circles: tuple[int, ...] = eqx.field(static=True)
    parameters: dict[str, Parameter]

    def __init__(
        self,
        mass: Numbers,
        transform: Callable[[Array], Array],
        damping: Callable[[Array], Array],
        restoring: Callable[[Array], Array] | None = None,
        coriolis: Callable[[Array], Array] | None = None,
        *,
        coordinates: tuple[str, ...],
        units: tuple[str, ...],
        velocities: tuple[str, ...],
        velocity_units: tuple[str, ...] | None = None,
        circles: tuple[int, ...] = (),
        parameters: dict[str, Parameter] | None = None,
    ):
        self.mass = positive_definite("mass", mass, len(velocities))
        self.transform, self.damping = transform, damping
        self.restoring = jnp.zeros_like if restoring is None else restoring
        self.coriolis = _no_coriolis if coriolis is None else coriolis
        self.coordinates, self.units, self.velocities = coordinates, units, velocities
        self.circles, self.parameters = circles, dict(parameters or {})
        n, m = len(coordinates), len(velocities)
        self.velocity_units = tuple(f"{unit}/s" for unit in units) if velocity_units is None else velocity_units
        if len(units) != n or len(self.velocity_units) != m or m > n:
            raise InputError(
                f"a craft of {n} coordinates and {m} velocities needs {n} units, {m} velocity_units, "
                "and no more velocities than coordinates"
            )
        position, velocity = (jax.ShapeDtypeStruct((k,), jnp.float64) for k in (n, m))
        functions = (
            ("transform", self.transform, (position,), (n, m)),
            ("damping", self.damping, (velocity,), (m, m)),
            ("coriolis", self.coriolis, (velocity,), (m, m)),
            ("restoring", self.restoring, (position,), (m,)),
        )
        check_shapes(functions, f"{n} coordinates and {m} velocities", "this craft")

    def displacement(self, origin: Vector, eta: Vector) -> Vector:
        """Displacement from one position to another: η − η₀ with angles wrapped to ±π, or `J⁺(η₀)(η − η₀)` if n > m.

        For a position and a unit quaternion the latter is the step in the body frame at η₀, and twice the vector part
        of the quaternion of the rotation.

        Args:
            origin: Position η₀ (n,).
            eta: Position η (n,).

        Returns:
            The displacement (m,).
        """
        step = wrap(self.circles, eta - origin)
        return step if len(self.velocities) == len(origin) else solve_square(self.transform(origin), step)

    def acceleration(self, eta: Vector, nu: Vector, tau: Vector) -> Vector:
        """Acceleration ν' of the craft.

        Args:
            eta: Position η (n,).
            nu: Velocity ν (m,) in the body frame.
            tau: Generalised force τ (m,) in the body frame.

        Returns:
            ν' (m,).
        """
        force = tau - (self.coriolis(nu) + self.damping(nu)) @ nu - self.restoring(eta)
        return solve(jnp.asarray(self.mass, nu.dtype), force)


@state_space.register
def _(model: Craft) -> StateSpace:
    return StateSpace(
        eqx.Partial(_rate, model),
        eqx.Partial(_position, model),
        coordinates=(*model.coordinates, *model.velocities),
        units=(*model.units, *model.velocity_units),
        outputs=model.coordinates,
        inputs=len(model.velocities),
        circles=model.circles,
        parameters=model.parameters,
    )


def _rate(model: Craft, t: Scalar, x: Vector, u: Vector) -> Vector:
    eta, nu = jnp.split(x, [len(model.coordinates)])
    return jnp.concatenate([model.transform(eta) @ nu, model.acceleration(eta, nu, u)])


def _position(model: Craft, t: Scalar, x: Vector, u: Vector) -> Vector:
    return x[: len(model.coordinates)]


def _no_coriolis(nu: Vector) -> Matrix:
    return jnp.zeros((nu.shape[0], nu.shape[0]), nu.dtype)


def positive_definite(name: str, matrix: Numbers, n: int) -> Matrix:
    """Convert a matrix to an array and check that it is symmetric positive definite.

    In a compiled function its numbers are not known, so only its shape is checked there.

    Args:
        name: Name of the matrix, for the message.
        matrix: The matrix (n, n).
        n: Its number of rows.

    Returns:
        The array (n, n).

    Raises:
        ValueError: It has another shape, or is not symmetric positive definite.

    Example:
        >>> from covariant import models
        >>> models.marine.positive_definite("mass", [[2.0]], 1).tolist()
        [[2.0]]
    """
    if np.shape(matrix) != (n, n):
        raise InputError(f"{name} must be a matrix of {n} rows and {n} columns; its shape is {np.shape(matrix)}")
    if isinstance(matrix, Tracer):
        return matrix  # its numbers are unknown while a program is traced
    array = np.asarray(matrix, float)
    if not np.allclose(array, array.T, rtol=1e-9, atol=0.0):  # relative, as inertias may have any unit
        raise InputError(f"{name} must be symmetric")
    smallest = np.linalg.eigvalsh(array)[0]
    if not smallest > 0:
        raise InputError(f"{name} must be positive definite; its smallest eigenvalue is {smallest:.3g}")
    return jnp.asarray(array)


def coriolis_matrix(mass: Numbers) -> Callable[[Array], Array]:
    """Coriolis matrix `ν ↦ C(ν)`, skew-symmetric, of a rigid body in Kirchhoff's equations.

    `C(ν)w = −ad*_w(Mν)`, so that `C(ν)ν` is the Coriolis term of Kirchhoff's equations.

    Args:
        mass: Inertia matrix M, (3, 3) for planar or (6, 6) for spatial motion.

    Returns:
        A function `ν (n,) -> C (n, n)`.

    Example:
        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> from covariant import models
        >>> coriolis = models.marine.coriolis_matrix(np.diag([1.0, 2.0, 3.0]))(jnp.array([1.0, 2.0, 3.0]))
        >>> bool((coriolis == -coriolis.T).all())
        True
    """
    return Parametric(_coriolis, mass=mass)


def _coriolis(nu: Vector, mass: Matrix) -> Matrix:
    group = {3: SE2, 6: SE3}[nu.shape[0]]
    # Column j is −ad*_{e_j}(Mν).
    return -jax.vmap(group.coadjoint, (0, None), 1)(jnp.eye(nu.shape[0], dtype=nu.dtype), mass @ nu)


def yaw_rotation(psi: Scalar) -> Matrix:
    """Rotation R(ψ) from surge, sway and yaw rate in the body frame to the rates of north, east and heading.

    Args:
        psi: Heading ψ [rad].

    Returns:
        Matrix (3, 3).

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> eastward = models.marine.yaw_rotation(jnp.array(jnp.pi / 2)) @ jnp.array([1.0, 0.0, 0.0])
        >>> bool(jnp.allclose(eastward, jnp.array([0.0, 1.0, 0.0])))
        True
    """
    c, s, zero = jnp.cos(psi), jnp.sin(psi), jnp.zeros_like(psi)
    # From the body to north and east, with z down: a positive ψ turns the bow from north to east.
    return jnp.stack([jnp.stack([c, -s, zero]), jnp.stack([s, c, zero]), jnp.stack([zero, zero, jnp.ones_like(psi)])])


def euler_rotation(angles: Float[Array, "3"]) -> Matrix:
    """Rotation R from the body frame to north, east and down, for Euler angles.

    The order of the rotations is yaw, pitch, roll: `R = Rz(ψ) Ry(θ) Rx(φ)`. The matrix itself is smooth for all angles;
    only the rates of the angles are singular, at a pitch of ±90°. The z axis points down, so a positive pitch raises
    the bow.

    Args:
        angles: Roll φ, pitch θ and yaw ψ (3,) [rad].

    Returns:
        Matrix (3, 3).

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> bow_up = models.marine.euler_rotation(jnp.array([0.0, jnp.pi / 2, 0.0])) @ jnp.array([1.0, 0.0, 0.0])
        >>> bool(jnp.allclose(bow_up, jnp.array([0.0, 0.0, -1.0])))  # z points down
        True
    """
    (cr, cp, cy), (sr, sp, sy) = jnp.cos(angles), jnp.sin(angles)
    return jnp.stack(
        [
            # R = Rz(ψ) Ry(θ) Rx(φ), Fossen 2011, equation (2.18).
            jnp.stack([cy * cp, -sy * cr + cy * sp * sr, sy * sr + cy * cr * sp]),
            jnp.stack([sy * cp, cy * cr + sr * sp * sy, -cy * sr + sp * sy * cr]),
            jnp.stack([-sp, cp * sr, cp * cr]),
        ]
    )


def euler_rates(angles: Float[Array, "3"]) -> Matrix:
    """Matrix T from the angular velocity in the body frame to the rates of roll, pitch and yaw.

    It is singular at a pitch of ±90°.

    Args:
        angles: Roll φ, pitch θ and yaw ψ (3,) [rad].

    Returns:
        Matrix (3, 3).

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> bool((models.marine.euler_rates(jnp.zeros(3)) == jnp.eye(3)).all())
        True
    """
    (cr, cp, _), (sr, sp, _) = jnp.cos(angles), jnp.sin(angles)
    one, zero = jnp.ones_like(cr), jnp.zeros_like(cr)
    rows = [one, sr * sp / cp, cr * sp / cp], [zero, cr, -sr], [zero, sr / cp, cr / cp]
    return jnp.stack([jnp.stack(row) for row in rows])


def euler_transform(eta: Float[Array, "6"]) -> Matrix:
    """Transform J(η) from the velocity in the body frame to η', equation (84).

    Args:
        eta: North, east, down [m], roll, pitch, yaw [rad] (6,).

    Returns:
        Matrix (6, 6).

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> bool((models.marine.euler_transform(jnp.zeros(6)) == jnp.eye(6)).all())
        True
    """
    zero = jnp.zeros((3, 3), eta.dtype)
    return jnp.block([[euler_rotation(eta[3:]), zero], [zero, euler_rates(eta[3:])]])


def quaternion_transform(eta: Float[Array, "7"]) -> Float[Array, "7 6"]:
    """Transform J(η) from the velocity in the body frame to η', for an attitude that is a quaternion.

    Fossen 2011, equation (2.72). It has rank 6 at all attitudes.

    Args:
        eta: North, east, down [m], and the unit quaternion wxyz (7,).

    Returns:
        Matrix (7, 6).
    """
    w, v = eta[3], eta[4:]
    rates = jnp.concatenate([-v[None], w * jnp.eye(3, dtype=eta.dtype) + SO3.hat(v)]) / 2
    rotation = rotation_from_quaternion(eta[3:])
    return jnp.block([[rotation, jnp.zeros((3, 3), eta.dtype)], [jnp.zeros((4, 3), eta.dtype), rates]])
