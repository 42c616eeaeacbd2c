"""Models the ideal fluid in the plane, periodic in both directions, as free motion on the group SU(n).

The domain is the torus [0, 2π)² [m]; u = (−∂₂ψ, ∂₁ψ) [m/s] with stream function ψ [m²/s] and vorticity ω = Δψ [1/s]:

    ω_t = −{ψ, ω} + ν Δω,   {f, g} = ∂₁f ∂₂g − ∂₂f ∂₁g

In the basis T_m of the clock and shift matrices, `(T_m)[k, k + m₂] = exp(2πi m₁(2k + m₂)/n)`, indices modulo n, with
`T_m T_l = exp(−2πi (m×l)/n) T_{m+l}`, the field f = Σ f_m exp(i m·x) becomes the matrix X_f = −(i n/4π) Σ f_m T_m of
su(n). Commutators are Poisson brackets, `[X_f, X_g] = X_{{f, g}}`, with sin(2π(m×l)/n)·n/2π for m×l: an error of
second order in |m||l|/n. The body velocity is X_ψ, the inertia −Δ, and Euler's equation `μ' = [μ, ζ]`, μ = X_{−ω}, is
the Euler–Poincaré equation of a left-invariant metric. On the group of particle maps Arnold's metric is
right-invariant; the configuration g is therefore the inverse map, from positions back to particle labels.

Sources: Arnold 1966, Ann. Inst. Fourier 16, 319–361; Zeitlin 1991, Physica D 49, 353–362. Aghannan & Rouchon 2003
name the ideal fluid as an extension of their observer.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from covariant._linalg import at_places
from covariant._typing import Element, Vector
from covariant.geometry.lie import SU, AbstractInertia
from covariant.models._mechanical import GroupSystem
from covariant.models._parameters import Parameter
from scalargraph.errors import InputError

Modes = Complex[Array, "N N"]
"""Fourier coefficients f_m of a real field at [m₁, m₂] modulo N, the order of `jnp.fft.fft2`; the mean f_0 is not used.

Frequencies run from −(N − 1)/2 to (N − 1)/2."""

Grid = Float[Array, "P P"]
"""Values of a real field at the points 2π(i, j)/P."""


def ideal_fluid(n: int, viscosity: float = 0.0) -> GroupSystem:
    """Ideal fluid with the n² − 1 modes |m₁|, |m₂| ≤ (n − 1)/2, as free motion on the group SU(n).

    Velocities are coordinates of `lie.SU(n)`; `velocity_coordinates` gives those of a stream function. The energy of
    the system is ½∫|u|²dx, that is, energy per unit density. It has no inputs.

    Args:
        n: Number of frequencies in each direction, odd and at least 3.
        viscosity: Kinematic viscosity ν [m²/s], the dissipation; none by default.

    Returns:
        The system with n² − 1 velocities [1/s].

    Raises:
        ValueError: n is even or less than 3, or ν negative.

    Example:
        >>> from covariant import models
        >>> models.fluid.ideal_fluid(3).group.dimension
        8
    """
    # n is odd, so that one half exists modulo n (`_coefficients`), and every frequency has its negative.
    if not isinstance(n, int) or n < 3 or n % 2 == 0:
        raise InputError(f"ideal_fluid: n must be an odd integer of 3 or more; got {n!r}")
    if not viscosity >= 0:
        raise InputError(f"ideal_fluid: the viscosity must not be negative; got {viscosity!r}")
    return GroupSystem(
        ParticleMaps(n),
        Laplacian(n),
        force=_no_force,
        dissipation=Viscosity(n, jnp.asarray(viscosity, float)) if viscosity else None,
        units=("1/s",) * (n**2 - 1),
        inputs=0,
        parameters={"viscosity": Parameter(viscosity, "m^2/s", "chosen")},
    )


def velocity_coordinates(n: int, stream: Modes) -> Vector:
    """Velocity of the fluid with a given stream function.

    Args:
        n: Number of frequencies in each direction.
        stream: Fourier coefficients (n, n) of the stream function [m²/s].

    Returns:
        Coordinates (n² − 1,) in `lie.SU(n)` [1/s].

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.models import fluid
        >>> stream = jnp.zeros((3, 3), complex).at[[1, 2], 0].set(0.5)  # ψ = cos x₁
        >>> v = fluid.velocity_coordinates(3, stream)
        >>> bool(jnp.allclose(fluid.stream_modes(3, v), stream))
        True
    """
    return SU(n).vee(_unit(n) * _matrix(n, stream))


def stream_modes(n: int, v: Vector) -> Modes:
    """Fourier coefficients of the stream function of a velocity, the inverse of `velocity_coordinates`.

    Args:
        n: Number of frequencies in each direction.
        v: Velocity (n² − 1,) in `lie.SU(n)` [1/s].

    Returns:
        Coefficients (n, n) [m²/s].

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.models import fluid
        >>> stream = jnp.zeros((3, 3), complex).at[[1, 2], 0].set(0.5)  # ψ = cos x₁
        >>> fluid.stream_modes(3, fluid.velocity_coordinates(3, stream))[1, 0].real.round(6).item()
        0.5
    """
    return _coefficients(n, SU(n).hat(v) / _unit(n))


def vorticity_modes(n: int, v: Vector) -> Modes:
    """Fourier coefficients of the vorticity of a velocity.

    Args:
        n: Number of frequencies in each direction.
        v: Velocity (n² − 1,) in `lie.SU(n)` [1/s].

    Returns:
        Coefficients (n, n) [1/s].

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.models import fluid
        >>> stream = jnp.zeros((3, 3), complex).at[[1, 2], 0].set(0.5)  # ψ = cos x₁
        >>> fluid.vorticity_modes(3, fluid.velocity_coordinates(3, stream))[1, 0].real.round(6).item()
        -0.5
    """
    return _times(-_squared_wave_numbers(n), stream_modes(n, v))


def vorticity(n: int, v: Vector, points: int) -> Grid:
    """Vorticity of a velocity on a grid.

    Args:
        n: Number of frequencies in each direction.
        v: Velocity (n² − 1,) in `lie.SU(n)` [1/s].
        points: Number of grid points in each direction, at least n.

    Returns:
        Values (points, points) [1/s].

    Raises:
        ValueError: There are fewer points than n.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.models import fluid
        >>> stream = jnp.zeros((3, 3), complex).at[[1, 2], 0].set(0.5)  # ψ = cos x₁, so that Δψ = −cos x₁
        >>> fluid.vorticity(3, fluid.velocity_coordinates(3, stream), 4)[0, 0].round(6).item()
        -1.0
    """
    return field(vorticity_modes(n, v), points)


def field(modes: Modes, points: int) -> Grid:
    """Values of a field at the points 2π(i, j)/points.

    Args:
        modes: Fourier coefficients (n, n).
        points: Number of grid points in each direction, at least n.

    Returns:
        Values (points, points), in the unit of the coefficients.

    Raises:
        ValueError: There are fewer points than frequencies.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.models import fluid
        >>> stream = jnp.zeros((3, 3), complex).at[[1, 2], 0].set(0.5)  # ψ = cos x₁
        >>> bool(jnp.allclose(fluid.field(stream, 4)[:, 0], jnp.array([1.0, 0.0, -1.0, 0.0])))
        True
    """
    rows = _rows(modes.shape[0], points)
    padded = jnp.zeros((points, points), modes.dtype).at[rows[:, None], rows].set(modes)
    # With norm="forward" the sum of coefficients times exponentials has no factor in front.
    return jnp.fft.ifft2(padded, norm="forward").real


def modes(n: int, values: Grid) -> Modes:
    """Lowest Fourier coefficients of a field on a grid.

    Args:
        n: Number of frequencies in each direction.
        values: Values (points, points) of the field at the points 2π(i, j)/points.

    Returns:
        Coefficients (n, n), in the unit of the values.

    Raises:
        ValueError: There are fewer points than n.

    Example:
        >>> import numpy as np
        >>> from covariant.models import fluid
        >>> x = 2 * np.pi * np.arange(4) / 4
        >>> fluid.modes(3, np.cos(x)[:, None] * np.ones((1, 4)))[1, 0].real.round(6).item()
        0.5
    """
    rows = _rows(n, values.shape[0])
    return jnp.fft.fft2(values, norm="forward")[rows[:, None], rows]


def carry(n: int, g: Element, tracer: Modes) -> Modes:
    """Transport a passive tracer, such as a dye, by a motion of the fluid.

    The tracer obeys `a_t = −{ψ, a}`, so `X_a ↦ g⁻¹ X_a g`. Without viscosity the vorticity is such a tracer itself.

    Args:
        n: Number of frequencies in each direction.
        g: Motion (n, n) in SU(n).
        tracer: Fourier coefficients (n, n) of the tracer before the motion.

    Returns:
        Coefficients (n, n) after the motion.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.models import fluid
        >>> stream = jnp.zeros((3, 3), complex).at[[1, 2], 0].set(0.5)  # ψ = cos x₁
        >>> bool(jnp.allclose(fluid.carry(3, jnp.eye(3, dtype=complex), stream), stream))  # at rest
        True
    """
    # g is unitary, so its inverse is gᴴ.
    return _coefficients(n, g.conj().T @ _matrix(n, tracer) @ g)


class ParticleMaps(SU):
    """SU(n) in the coordinates of `lie.SU`, for large n: the logarithm's derivative takes n³ operations, not n⁶.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.models import fluid
        >>> group = fluid.ParticleMaps(3)
        >>> y = jnp.ones(8)
        >>> bool(jnp.allclose(group.right_jacobian_inverse(jnp.zeros(8), y), y))
        True
    """

    def right_jacobian_inverse(self, x: Vector, y: Vector) -> Vector:
        """`J_r(x)⁻¹ y` (n² − 1,) of vectors x and y (n² − 1,), by the eigenvectors of x."""
        return _right_jacobian_inverse(SU(self.n), x, y)


class Laplacian(AbstractInertia):
    """The inertia `−Δ`, |m|² on mode m, in coordinates of `lie.SU(n)`, scaled so that energies are physical.

    The dot product of coordinates is `2 tr(Xᴴ Y)`, that is n³/8π² Σ f̄_m g_m, hence the factor 32π⁴/n³.

    Attributes:
        n: Number of frequencies in each direction, odd.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.models import fluid
        >>> inertia, v = fluid.Laplacian(3), jnp.ones(8)
        >>> bool(jnp.allclose(inertia.solve(inertia(v)), v))
        True
    """

    n: int = eqx.field(static=True)

    def __call__(self, x: Vector) -> Vector:
        return self.scale * _scale_modes(self.n, _nonzero_squares(self.n), x)

    def solve(self, mu: Vector) -> Vector:
        """Velocity (n² − 1,) whose momentum is mu, with one step of iterative refinement."""
        x = self._rounded_solution(mu)
        # A fixed transform makes the same rounding error at every step, and these accumulate: without this correction
        # a thousand steps change the Casimirs by about 1e-12.
        return x + self._rounded_solution(mu - self(x))

    def _rounded_solution(self, mu: Vector) -> Vector:
        return _scale_modes(self.n, 1 / _nonzero_squares(self.n), mu) / self.scale

    @property
    def scale(self) -> float:
        """The factor in front of |m|²."""
        # ½∫|u|²dx = ½(2π)² Σ|m|²|ψ_m|², over the n³/8π² of the dot product: 4π² · 8π²/n³.
        return 32 * np.pi**4 / self.n**3


class Viscosity(eqx.Module):
    """Dissipation `(g, v) -> (n² − 1,)` that adds νΔω to the rate of the vorticity.

    Attributes:
        n: Number of frequencies in each direction, odd.
        viscosity: Kinematic viscosity ν [m²/s].

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.models import fluid
        >>> drag, v = fluid.Viscosity(3, jnp.array(0.1)), jnp.ones(8)
        >>> bool(drag(jnp.eye(3), v) @ v < 0)  # takes energy
        True
    """

    n: int = eqx.field(static=True)
    viscosity: Float[Array, ""]

    def __call__(self, g: Element, v: Vector) -> Vector:
        inertia = Laplacian(self.n)
        # I/scale is −Δ and μ = I v, so this is νΔμ.
        return -self.viscosity.astype(v.dtype) / inertia.scale * inertia(inertia(v))


def _no_force(t, g, u):
    return jnp.zeros(g.shape[0] ** 2 - 1, g.real.dtype)


def _unit(n: int) -> complex:
    """The factor s of X_f = s Σ f_m T_m, with `−2i s² sin(2π(m×l)/n) -> −(m×l) s`."""
    return -1j * n / (4 * np.pi)


def _frequencies(n: int) -> np.ndarray:
    # fftfreq divides and multiplies by n, which rounds for some n.
    return np.rint(np.fft.fftfreq(n, 1 / n)).astype(int)


def _squared_wave_numbers(n: int) -> np.ndarray:
    squares = _frequencies(n) ** 2.0
    return squares[:, None] + squares


def _scale_modes(n: int, factors: np.ndarray, x: Vector) -> Vector:
    """x with its modes multiplied by real factors."""
    return SU(n).vee(_matrix(n, _times(factors, _coefficients(n, SU(n).hat(x)))))


def _nonzero_squares(n: int) -> np.ndarray:
    squares = _squared_wave_numbers(n)
    squares[0, 0] = 1.0  # the mean, which is zero for every velocity
    return squares


def _rows(n: int, points: int) -> np.ndarray:
    """Indices of the n frequencies of either sign among those of a grid."""
    if points < n:
        raise InputError(f"a grid of {n} frequencies needs at least {n} points a side; got {points}")
    return _frequencies(n) % points  # negative frequencies are stored at the end


def _times(factors: np.ndarray | Array, coefficients: Modes) -> Modes:
    return jnp.asarray(factors, coefficients.dtype) * coefficients


def _matrix(n: int, coefficients: Modes) -> Element:
    """The matrix `Σ f_m T_m`: entry (j, k) is `Σ f_m exp(2πi m₁(j + k)/n)` over the modes with m₂ = k − j."""
    j, k = np.ogrid[:n, :n]
    return at_places(jnp.fft.ifft(coefficients, axis=0, norm="forward"), (j + k) % n * n + (k - j) % n)


def _coefficients(n: int, matrix: Element) -> Modes:
    """The inverse of `_matrix`; (n + 1)/2 is one half modulo n."""
    j, m2 = np.ogrid[:n, :n]
    k = (j - m2) * (n + 1) // 2 % n
    return jnp.fft.fft(at_places(matrix, k * n + (k + m2) % n), axis=0, norm="forward")


@eqx.filter_custom_jvp
def _right_jacobian_inverse(group: SU, x: Vector, y: Vector) -> Vector:
    """Inverse of the right Jacobian, J_r(x)⁻¹ y.

    If x is diagonal with angles θ, entry (j, k) of y is divided by the mean of exp(−is(θ_j − θ_k)), 0 ≤ s ≤ 1.
    """
    angles, vectors = jnp.linalg.eigh(-1j * group.hat(x))
    half = (angles[:, None] - angles[None]).astype(vectors.dtype) / 2
    # jnp.sinc(t) is sin(πt)/(πt), which stays finite if two angles are equal.
    factors = jnp.exp(1j * half) / jnp.sinc(half / np.pi)
    turned = factors * (vectors.conj().T @ group.hat(y) @ vectors)
    return group.vee(vectors @ turned @ vectors.conj().T)


@_right_jacobian_inverse.def_jvp
def _(primals, tangents):
    group, x, y = primals
    z = _right_jacobian_inverse(group, x, y)
    _, x_dot, y_dot = tangents
    rate = jnp.zeros_like(y) if y_dot is None else y_dot
    if x_dot is not None:  # derivative of y = J(x) z; the eigenvectors themselves may not be differentiable
        rate = rate - jax.jvp(lambda p: group.right_jacobian(p, z), (x,), (x_dot,))[1]
    return z, _right_jacobian_inverse(group, x, rate)
