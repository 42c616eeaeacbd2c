"""A marine craft in the vectorial form of Fossen: velocities in the body frame, and coordinates of its position.

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

from covariant._linalg import solve
from covariant._typing import Matrix, Numbers, Scalar, Vector
from covariant.geometry.lie import SE2, SE3
from covariant.models._mechanical import check_shapes
from covariant.models._parameters import Parameter, Parametric
from covariant.models._state_space import StateSpace, state_space


class Craft(eqx.Module):
    """A craft `η' = J(η)ν`, `Mν' + C(ν)ν + D(ν)ν + g(η) = τ`, whose position η is measured; the input is τ.

    - `mass`: M (n, n), added mass included, symmetric positive definite.
    - `transform`: `J(η)` (n, n).
    - `damping`: `D(ν)` (n, n).
    - `restoring`: `g(η)` (n,); none by default.
    - `coriolis`: `C(ν)` (n, n), skew-symmetric; none by default.
    - `coordinates`, `units`, `velocities`: names of η and ν, and the units of η.
    - `circles`: indices of coordinates that are angles on a full circle [rad].
    - `parameters`: a `Parameter` for each name, as documentation.

    Raises `ValueError` when a matrix or function has the wrong shape, or M is not symmetric positive definite.
    """

    mass: Matrix
    transform: Callable[[Array], Array]
    damping: Callable[[Array], Array]
    restoring: Callable[[Array], Array]
    coriolis: Callable[[Array], Array]
    coordinates: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    velocities: tuple[str, ...] = eqx.field(static=True)
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
        circles: tuple[int, ...] = (),
        parameters: dict[str, Parameter] | None = None,
    ):
        self.mass = positive_definite("mass", mass, len(coordinates))
        self.transform, self.damping = transform, damping
        self.restoring = jnp.zeros_like if restoring is None else restoring
        self.coriolis = _no_coriolis if coriolis is None else coriolis
        self.coordinates, self.units, self.velocities = coordinates, units, velocities
        self.circles, self.parameters = circles, dict(parameters or {})
        n = len(coordinates)
        if not len(units) == len(velocities) == n:
            raise ValueError(f"a craft of {n} coordinates needs {n} units and {n} velocities")
        vector = jax.ShapeDtypeStruct((n,), jnp.float64)
        matrices = (("transform", self.transform), ("damping", self.damping), ("coriolis", self.coriolis))
        functions = (
            *((name, function, (vector,), (n, n)) for name, function in matrices),
            ("restoring", self.restoring, (vector,), (n,)),
        )
        check_shapes(functions, f"{n} coordinates", "this craft")

    def acceleration(self, eta: Vector, nu: Vector, tau: Vector) -> Vector:
        """ν' (n,) at the position η with the velocity ν under the force τ."""
        force = tau - (self.coriolis(nu) + self.damping(nu)) @ nu - self.restoring(eta)
        return solve(jnp.asarray(self.mass, nu.dtype), force)


@state_space.register
def _(model: Craft) -> StateSpace:
    return StateSpace(
        eqx.Partial(_rate, model),
        _position,
        coordinates=(*model.coordinates, *model.velocities),
        units=(*model.units, *(f"{unit}/s" for unit in model.units)),
        outputs=model.coordinates,
        inputs=len(model.coordinates),
        circles=model.circles,
        parameters=model.parameters,
    )


def _rate(model: Craft, t: Scalar, x: Float[Array, "two_n"], u: Vector) -> Float[Array, "two_n"]:
    eta, nu = jnp.split(x, 2)
    return jnp.concatenate([model.transform(eta) @ nu, model.acceleration(eta, nu, u)])


def _position(t: Scalar, x: Float[Array, "two_n"], u: Vector) -> Vector:
    return jnp.split(x, 2)[0]


def _no_coriolis(nu: Vector) -> Matrix:
    return jnp.zeros((nu.shape[0], nu.shape[0]), nu.dtype)


def positive_definite(name: str, matrix: Numbers, n: int) -> Matrix:
    """A matrix (n, n) checked to be symmetric positive definite. Raises `ValueError` that says what is wrong.

    Inside a compiled function its numbers are not known: there only its shape is checked.
    """
    if np.shape(matrix) != (n, n):
        raise ValueError(f"{name} must be a matrix of {n} rows and {n} columns; its shape is {np.shape(matrix)}")
    if isinstance(matrix, Tracer):
        return matrix
    found = np.asarray(matrix, float)
    if not np.allclose(found, found.T, rtol=1e-9, atol=0.0):
        raise ValueError(f"{name} must be symmetric")
    least = np.linalg.eigvalsh(found)[0]
    if not least > 0:
        raise ValueError(f"{name} must be positive definite; its smallest eigenvalue is {least:.3g}")
    return jnp.asarray(found)


def coriolis_matrix(mass: Numbers) -> Callable[[Array], Array]:
    """`ν ↦ C(ν)`, skew-symmetric, for the inertia M, (3, 3) of planar or (6, 6) of spatial motion.

    `C(ν)w = −ad*_w(Mν)`, so that `C(ν)ν` is the Coriolis term of Kirchhoff's equations.
    """
    return Parametric(_coriolis, mass=mass)


def _coriolis(nu: Vector, mass: Matrix) -> Matrix:
    group = {3: SE2, 6: SE3}[nu.shape[0]]
    return -jax.vmap(group.coadjoint, (0, None), 1)(jnp.eye(nu.shape[0], dtype=nu.dtype), mass @ nu)


def yaw_rotation(psi: Scalar) -> Matrix:
    """R(ψ) (3, 3): from surge, sway and yaw rate in the body frame to the rates of north, east and heading ψ [rad]."""
    c, s, zero = jnp.cos(psi), jnp.sin(psi), jnp.zeros_like(psi)
    return jnp.stack([jnp.stack([c, -s, zero]), jnp.stack([s, c, zero]), jnp.stack([zero, zero, jnp.ones_like(psi)])])


def euler_rotation(angles: Float[Array, "3"]) -> Matrix:
    """R (3, 3) of roll φ, pitch θ and yaw ψ [rad]: from the body frame to north, east and down."""
    (cr, cp, cy), (sr, sp, sy) = jnp.cos(angles), jnp.sin(angles)
    return jnp.stack(
        [
            jnp.stack([cy * cp, -sy * cr + cy * sp * sr, sy * sr + cy * cr * sp]),
            jnp.stack([sy * cp, cy * cr + sr * sp * sy, -cy * sr + sp * sy * cr]),
            jnp.stack([-sp, cp * sr, cp * cr]),
        ]
    )


def euler_rates(angles: Float[Array, "3"]) -> Matrix:
    """T (3, 3): from body angular velocity to the rates of roll, pitch and yaw. Singular at a pitch of ±90°."""
    (cr, cp, _), (sr, sp, _) = jnp.cos(angles), jnp.sin(angles)
    one, zero = jnp.ones_like(cr), jnp.zeros_like(cr)
    return jnp.stack(
        [
            jnp.stack([one, sr * sp / cp, cr * sp / cp]),
            jnp.stack([zero, cr, -sr]),
            jnp.stack([zero, sr / cp, cr / cp]),
        ]
    )


def euler_transform(eta: Float[Array, "6"]) -> Matrix:
    """J(η) (6, 6) of north, east, down, roll, pitch and yaw, equation (84)."""
    zero = jnp.zeros((3, 3), eta.dtype)
    return jnp.block([[euler_rotation(eta[3:]), zero], [zero, euler_rates(eta[3:])]])
