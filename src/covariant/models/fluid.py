"""The ideal fluid in the plane, periodic in both directions, as free motion on the group SU(n).

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
from covariant._typing import Element, Scalar, Vector
from covariant.geometry.lie import SU, AbstractInertia
from covariant.models._mechanical import GroupSystem
from covariant.models._parameters import Parameter

Modes = Complex[Array, "N N"]
"""Fourier coefficients f_m of a real field at [m₁, m₂] modulo N, the order of `jnp.fft.fft2`; the mean f_0 is not used.

Frequencies run from −(N − 1)/2 to (N − 1)/2."""

Grid = Float[Array, "P P"]
"""Values of a real field at the points 2π(i, j)/P."""


def ideal_fluid(n: int, viscosity: float = 0.0) -> GroupSystem:
    """The fluid with the n² − 1 modes |m₁|, |m₂| ≤ (n − 1)/2; `viscosity` ν [m²/s] is its dissipation.

    Velocities are coordinates of `lie.SU(n)`; `velocity_coordinates` gives those of a stream function. The energy of
    the system is ½∫|u|²dx, that is, energy per unit density. It has no inputs. Raises `ValueError` unless n is odd and
    at least 3, and ν ≥ 0.
    """
    if not isinstance(n, int) or n < 3 or n % 2 == 0:
        raise ValueError(f"ideal_fluid: n must be an odd integer of 3 or more; got {n!r}")
    if not viscosity >= 0:
        raise ValueError(f"ideal_fluid: the viscosity must not be negative; got {viscosity!r}")
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
    """Velocity (n² − 1,) [1/s] of the fluid whose stream function has these coefficients (n, n) [m²/s]."""
    return SU(n).vee(_unit(n) * _matrix(n, stream))


def stream_modes(n: int, v: Vector) -> Modes:
    """Coefficients (n, n) [m²/s] of the stream function of a velocity (n² − 1,): inverse of `velocity_coordinates`."""
    return _coefficients(n, SU(n).hat(v) / _unit(n))


def vorticity_modes(n: int, v: Vector) -> Modes:
    """Coefficients (n, n) [1/s] of the vorticity of a velocity (n² − 1,)."""
    return _times(-_wave_numbers_squared(n), stream_modes(n, v))


def stream_function(n: int, v: Vector, points: int) -> Grid:
    """Values (points, points) [m²/s] of the stream function; raises `ValueError` for fewer points than n."""
    return field(stream_modes(n, v), points)


def vorticity(n: int, v: Vector, points: int) -> Grid:
    """Values (points, points) [1/s] of the vorticity; raises `ValueError` for fewer points than n."""
    return field(vorticity_modes(n, v), points)


def field(modes: Modes, points: int) -> Grid:
    """Values of a field at 2π(i, j)/points; raises `ValueError` for fewer points than frequencies."""
    rows = _rows(modes.shape[0], points)
    padded = jnp.zeros((points, points), modes.dtype).at[rows[:, None], rows].set(modes)
    return jnp.fft.ifft2(padded, norm="forward").real


def modes(n: int, values: Grid) -> Modes:
    """The n × n lowest coefficients of a field on a grid; raises `ValueError` for fewer points than n."""
    rows = _rows(n, values.shape[0])
    return jnp.fft.fft2(values, norm="forward")[rows[:, None], rows]


def carry(n: int, g: Element, tracer: Modes) -> Modes:
    """Coefficients (n, n) of a passive tracer, such as a dye, after the motion g, given those before it.

    The tracer obeys `a_t = −{ψ, a}`, so `X_a ↦ g⁻¹ X_a g`.

    Without viscosity the vorticity is such a tracer.
    """
    return _coefficients(n, g.conj().T @ _matrix(n, tracer) @ g)


def enstrophy(n: int, v: Vector) -> Scalar:
    """Enstrophy `½∫ω²dx` [m²/s²] of a velocity (n² − 1,)."""
    return (2 * np.pi) ** 2 / 2 * jnp.sum(jnp.abs(vorticity_modes(n, v)) ** 2)


def casimirs(n: int, v: Vector) -> Float[Array, "k"]:
    """`(2π)²/n · tr Ωᵏ` for k = 2, …, n, with Ω = Σ ω_m T_m: the discrete counterpart of `∫ωᵏdx` [m²/sᵏ].

    These n − 1 numbers determine the coadjoint orbit of the vorticity; without viscosity all of them are conserved.
    """
    values = jnp.linalg.eigvalsh(_matrix(n, vorticity_modes(n, v)))
    return (2 * np.pi) ** 2 / n * jnp.sum(values[:, None] ** jnp.arange(2, n + 1, dtype=values.dtype)[None], axis=0)


class ParticleMaps(SU):
    """SU(n) in the coordinates of `lie.SU`, for large n: the logarithm's derivative takes n³ operations, not n⁶."""

    def right_jacobian_inverse(self, x: Vector, y: Vector) -> Vector:
        return _right_jacobian_inverse(SU(self.n), x, y)


class Laplacian(AbstractInertia):
    """The inertia `−Δ`, |m|² on mode m, in coordinates of `lie.SU(n)`, scaled so that energies are physical.

    The dot product of coordinates is `2 tr(Xᴴ Y)`, that is n³/8π² Σ f̄_m g_m, hence the factor 32π⁴/n³.
    """

    n: int = eqx.field(static=True)

    def __call__(self, x: Vector) -> Vector:
        return self.scale * _filtered(self.n, _nonzero_squares(self.n), x)

    def solve(self, mu: Vector) -> Vector:
        x = self._nearly_solved(mu)
        # A transform makes the same rounding error at every step, which accumulates: without this correction a thousand
        # steps change the Casimirs by some 1e-12.
        return x + self._nearly_solved(mu - self(x))

    def _nearly_solved(self, mu: Vector) -> Vector:
        return _filtered(self.n, 1 / _nonzero_squares(self.n), mu) / self.scale

    @property
    def scale(self) -> float:
        """The factor in front of |m|²."""
        return 32 * np.pi**4 / self.n**3


class Viscosity(eqx.Module):
    """Dissipation `(g, v) -> (n² − 1,)` that adds νΔω to the rate of the vorticity."""

    n: int = eqx.field(static=True)
    viscosity: Float[Array, ""]

    def __call__(self, g: Element, v: Vector) -> Vector:
        inertia = Laplacian(self.n)
        return -self.viscosity.astype(v.dtype) / inertia.scale * inertia(inertia(v))


def _no_force(t, g, u):
    return jnp.zeros(g.shape[0] ** 2 - 1, g.real.dtype)


def _unit(n: int) -> complex:
    """The factor s of X_f = s Σ f_m T_m, with `−2i s² sin(2π(m×l)/n) -> −(m×l) s`."""
    return -1j * n / (4 * np.pi)


def _frequencies(n: int) -> np.ndarray:
    return np.rint(np.fft.fftfreq(n, 1 / n)).astype(int)


def _wave_numbers_squared(n: int) -> np.ndarray:
    squares = _frequencies(n) ** 2.0
    return squares[:, None] + squares


def _filtered(n: int, factors: np.ndarray, x: Vector) -> Vector:
    """x with its modes multiplied by real factors."""
    return SU(n).vee(_matrix(n, _times(factors, _coefficients(n, SU(n).hat(x)))))


def _nonzero_squares(n: int) -> np.ndarray:
    squares = _wave_numbers_squared(n)
    squares[0, 0] = 1.0  # the mean, which no velocity has
    return squares


def _rows(n: int, points: int) -> np.ndarray:
    """Indices of the n frequencies of either sign among those of a grid."""
    if points < n:
        raise ValueError(f"a grid of {n} frequencies needs at least {n} points a side; got {points}")
    return _frequencies(n) % points


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
    """J_r(x)⁻¹ y: where x is diagonal with angles θ, entry (j, k) of y divided by the mean of exp(−is(θ_j − θ_k)),
    0 ≤ s ≤ 1."""
    angles, vectors = jnp.linalg.eigh(-1j * group.hat(x))
    half = (angles[:, None] - angles[None]).astype(vectors.dtype) / 2
    factors = jnp.exp(1j * half) / jnp.sinc(half / np.pi)
    turned = factors * (vectors.conj().T @ group.hat(y) @ vectors)
    return group.vee(vectors @ turned @ vectors.conj().T)


@_right_jacobian_inverse.def_jvp
def _(primals, tangents):
    group, x, y = primals
    z = _right_jacobian_inverse(group, x, y)
    _, x_dot, y_dot = tangents
    rate = jnp.zeros_like(y) if y_dot is None else y_dot
    if x_dot is not None:  # from y = J(x) z; the eigenvectors themselves may have no derivative
        rate = rate - jax.jvp(lambda p: group.right_jacobian(p, z), (x,), (x_dot,))[1]
    return z, _right_jacobian_inverse(group, x, rate)
