"""D-optimal motions of a robot within its limits, as Fourier series: their logs determine open parameters best.

The information is that of `fit_robot`: derivatives of the torques with respect to the parameters, averaged over its
windows and weighted by the residual torque that encoder noise causes in such windows. The means of the joints and the
coefficients of the series maximise its determinant by sequential quadratic programming. The constraints are the limits
of positions, velocities and torques, each as the Kreisselmeier–Steinhauser bound of its maximum over a grid. Then the
amplitudes are scaled, on a finer grid, to the largest that keep the limits.

Source: Swevers, Ganseman, Tükel, De Schutter & Van Brussel 1997, Optimal Robot Excitation and Identification, IEEE
Transactions on Robotics and Automation 13(5); Kreisselmeier & Steinhauser 1979 for the bound.
"""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp
from jaxtyping import Array, Float

from covariant.calibration._least_squares import PRIOR
from covariant.calibration.identification._expected import ExpectedErrors, Sensing, expected_errors
from covariant.calibration.identification._fourier import FourierMotion, fourier_basis, one_sine_a_joint, resting_basis
from covariant.calibration.identification._robot_torques import (
    Torques,
    batched,
    efforts,
    in_batches,
    inverse_inputs,
    mapped,
    usual_sizes,
)
from covariant.models import MechanicalSystem, RobotFamily
from covariant.signals import AnyArray
from scalargraph.errors import InputError

COARSE, FINE, DENSE = 20, 200, 2000
"""Points in a period of the highest harmonic: on the grids of the search, the last scaling and the verification."""
SHARPNESS = 100.0
"""Sharpness ρ of the bounds `log Σ exp(ρ x) / ρ` of maxima: they exceed the maxima by a few hundredths at most."""
STEPS, TOLERANCE = 60, 1e-4
"""Largest number of steps from each start, and the change of the mean log standard error that ends a search."""
PLACES = 256
"""Number of random configurations, of which those that the motors can hold are used."""
STARTING, LARGEST = 0.7, 1.25
"""Starting amplitudes as a fraction of the largest possible ones, and the largest factor on those of the result."""
STILL = 1e-3
"""Largest speed, relative to the limit, of a joint that does not move."""
HALVINGS = 16
SLACK = 1e-3
"""Fraction of a limit that is not used, since maxima may lie between the points of the grid."""
SMALLER = 0.99
"""Factor on the amplitudes while the verification finds that a limit is exceeded."""


class JointLimits(NamedTuple):
    """Limits of the joints of a robot.

    Attributes:
        names: Names of the n coordinates.
        low, high: Ends (n,) of the positions [rad or m].
        velocity: Largest speeds (n,) [rad/s or m/s].
        effort: Largest torques or forces (n,) of the motors [N m or N].

    Example:
        >>> import numpy as np
        >>> from covariant.calibration import JointLimits
        >>> limits = JointLimits(("arm",), np.array([-1.0]), np.array([2.0]), np.array([5.0]), np.array([10.0]))
        >>> limits.used(np.array([[1.4]]), np.array([[-4.0]]), np.array([[5.0]])).round(3).tolist()
        [[0.6], [0.8], [0.5]]
    """

    names: tuple[str, ...]
    low: Float[np.ndarray, "n"]
    high: Float[np.ndarray, "n"]
    velocity: Float[np.ndarray, "n"]
    effort: Float[np.ndarray, "n"]

    @property
    def middle(self) -> Float[np.ndarray, "n"]:
        """Middle (n,) of the positions."""
        return (self.low + self.high) / 2

    @property
    def room(self) -> Float[np.ndarray, "n"]:
        """Largest distance (n,) from the middle."""
        return (self.high - self.low) / 2

    def used(self, q: np.ndarray, v: np.ndarray, torque: np.ndarray) -> Float[np.ndarray, "3 n"]:
        """Largest distance from the middle, speed and torque of each joint over rows (T, n), as fractions of limits."""
        return np.stack([np.abs(each).max(axis=0) for each in self.fractions(q, v, torque)])

    def fractions(self, q: AnyArray, v: AnyArray, torque: AnyArray) -> tuple[Any, Any, Any]:
        """Positions, velocities and torques (T, n), traced or not, as fractions of their limits, with their signs."""
        return (q - self.middle) / self.room, v / self.velocity, torque / self.effort

    def within(self, margin: float) -> "JointLimits":
        """A fraction of the limits, about the same middle."""
        reach, velocity, effort = (margin * each for each in (self.room, self.velocity, self.effort))
        return JointLimits(self.names, self.middle - reach, self.middle + reach, velocity, effort)


class ExcitationPlan(NamedTuple):
    """Settings of a motion to design.

    Attributes:
        duration: Length [s], a whole number of periods.
        frequency: Frequency [Hz] of the first harmonic.
        harmonics: Number of harmonics, at least 2.
        margin: Fraction of the limits that is used.
        starts: Number of starts of the search.
        seed: Seed of the random starts.

    Example:
        >>> from covariant.calibration import ExcitationPlan
        >>> ExcitationPlan(duration=10.0, frequency=0.2).harmonics
        5
    """

    duration: float = 20.0
    frequency: float = 0.2
    harmonics: int = 5
    margin: float = 0.9
    starts: int = 3
    seed: int = 0


class DesignedMotion(NamedTuple):
    """A motion, which starts and ends each period at rest.

    Attributes:
        motion: The motion.
        expected: What a log of it is expected to show.
        used: Largest positions, velocities and torques (3, n) as fractions of the limits.
    """

    motion: FourierMotion
    expected: ExpectedErrors
    used: Float[np.ndarray, "3 n"]


class Excitation(NamedTuple):
    """A motion whose log determines parameters of a robot, and a simple reference motion to compare it with.

    Attributes:
        designed: The motion.
        reference: One sine for each joint, as large as its limits of position and velocity allow, and all scaled
            together to the limits of torque.
    """

    designed: DesignedMotion
    reference: DesignedMotion


def design_excitation(
    family: RobotFamily,
    limits: JointLimits,
    sensing: Sensing,
    plan: ExcitationPlan,
    half: float,
    progress: Callable[[float], object] = lambda _: None,
) -> Excitation:
    """Design a motion whose log determines the open parameters of a robot best.

    Collisions of links with each other or with anything else are not checked.

    Args:
        family: The robot as a function of its p open parameters, at whose first values the motion is designed.
        limits: Limits of its joints.
        sensing: Noise and rate of the log.
        plan: Duration, harmonics, and the effort of the search.
        half: Half width [s] of the shortest window of the fit.
        progress: Called with the fraction of the work that is done.

    Returns:
        The motion, and what a log of it is expected to show, compared with one sine for each joint.

    Raises:
        ValueError: The motors cannot hold the robot still anywhere within the limits, or move a joint, or the duration
            is too short for a fit.

    Example:
        >>> import numpy as np
        >>> from covariant import models
        >>> from covariant.calibration import ExcitationPlan, JointLimits, Sensing, design_excitation
        >>> family = models.robot_family("double_pendulum", ["armature"])
        >>> one = np.ones(2)
        >>> limits = JointLimits(("shoulder", "elbow"), -one, one, 5 * one, np.array([2.0, 1.0]))
        >>> plan = ExcitationPlan(duration=4.0, frequency=0.5, harmonics=2, starts=1)
        >>> found = design_excitation(family, limits, Sensing(1e-4 * one, 0 * one, 200.0), plan, 0.05)
        >>> bool(np.all(found.used <= 0.9)), found.expected.errors.shape
        (True, (2,))
    """
    problem = _Problem.of(family, limits, sensing, plan, half)
    evaluate = _compiled(problem)
    places = problem.places()
    inner = problem.limits
    reference = one_sine_a_joint(plan.frequency, plan.harmonics, places[0], inner.room, inner.velocity)
    reference = problem.enlarged(reference, problem.farthest(reference))
    found = []
    for k in range(plan.starts):

        def report(step: int, k: int = k) -> None:
            progress((k + min(step / STEPS, 1.0)) / plan.starts)

        report(0)
        start = problem.start(places[k % len(places)], k)
        motion = problem.motion(_maximise_information(problem, evaluate, start, report))
        if problem.used(motion.scaled(0.0), problem.limits, FINE).max() >= 1:  # its middle is no place to hold
            motion = problem.motion(start)
        motion = problem.enlarged(motion, LARGEST)
        found.append(problem.judge(motion, limits))
    designed = min(found, key=lambda each: each.expected.size)
    still = designed.used[1] < STILL
    if still.any():
        joint = int(np.argmax(still))
        raise InputError(
            f"effort: weight and friction leave no torque to move joint {limits.names[joint]!r}; give a larger effort"
        )
    return Excitation(designed, problem.judge(reference, limits))


class _Point(NamedTuple):
    """Objective at unknowns x and its gradient; slack (3 n,) of the limits and its Jacobian."""

    value: float
    slope: np.ndarray
    slack: np.ndarray
    slack_slope: np.ndarray


def _maximise_information(
    problem: "_Problem", evaluate: Callable[..., _Point], start: np.ndarray, report: Callable[[int], None]
) -> np.ndarray:
    """The unknowns with the most information that sequential quadratic programming reaches from a start."""
    from scipy.optimize import minimize

    window = problem.expected(problem.motion(start)).window.arrays(problem.points, problem.plan.frequency)
    steps = itertools.count(1)
    last: list[tuple[np.ndarray, _Point]] = []

    def at(x: np.ndarray) -> _Point:
        """Compute all four at once: they share the motion, and SLSQP asks for them at the same x."""
        if not last or not np.array_equal(last[0][0], x):
            last[:] = [(x.copy(), evaluate(x, window))]
        return last[0][1]

    result = minimize(
        lambda x: at(x).value,
        start,
        jac=lambda x: at(x).slope,
        method="SLSQP",
        constraints={"type": "ineq", "fun": lambda x: at(x).slack, "jac": lambda x: at(x).slack_slope},
        options={"maxiter": STEPS, "ftol": TOLERANCE},
        callback=lambda _: report(next(steps)),
    )
    return result.x if np.isfinite(result.x).all() else start


class _Problem(NamedTuple):
    """The robot, its limits with the margin, and the map from unknowns x to a motion."""

    # The unknowns are the mean positions, relative to the middle and in units of `room` of each joint, then the
    # coefficients of the series in the basis of motions that start at rest, in units of the amplitude of each joint.

    family: RobotFamily
    model: MechanicalSystem
    torques: Torques
    limits: JointLimits
    sensing: Sensing
    plan: ExcitationPlan
    half: float
    basis: Float[np.ndarray, "h m"]
    amplitude: Float[np.ndarray, "n"]
    sizes: Float[np.ndarray, "p"]

    @classmethod
    def of(
        cls, family: RobotFamily, limits: JointLimits, sensing: Sensing, plan: ExcitationPlan, half: float
    ) -> "_Problem":
        model: Any = family.file.model
        inner = limits.within(plan.margin)
        idle = np.linalg.norm(inverse_inputs(model).force, axis=0) == 0
        if idle.any():
            name = limits.names[int(np.argmax(idle))]
            raise InputError(f"no motor moves joint {name!r}: lock it, or give it a motor")
        # The speed that a middle harmonic has at the largest amplitude.
        omega = 2 * np.pi * plan.frequency * (plan.harmonics + 1) / 2
        amplitude = np.minimum(inner.room, inner.velocity / omega)
        torques = Torques.of(family)
        basis = resting_basis(plan.harmonics)
        problem = cls(family, model, torques, inner, sensing, plan, half, basis, amplitude, np.ones(0))
        plain = one_sine_a_joint(plan.frequency, plan.harmonics, problem.places()[0], inner.room, inner.velocity)
        q, v, a = plain.at(problem.times(COARSE))
        torque = in_batches(efforts, model, q, v, a)
        return problem._replace(sizes=usual_sizes(family, torque[:, 0], torque[:, 1], v, a)[0])

    @property
    def points(self) -> int:
        """Points of the grid of the search."""
        return COARSE * self.plan.harmonics

    def times(self, points: int) -> Float[np.ndarray, "k"]:
        """Uniform times over a period, `points` of them in a period of the highest harmonic."""
        count = points * self.plan.harmonics
        return np.arange(count) / count / self.plan.frequency

    def motion(self, x: np.ndarray) -> FourierMotion:
        n = len(self.amplitude)
        coefficients = self.basis @ x[n:].reshape(-1, n) * self.amplitude
        return FourierMotion(self.plan.frequency, self.limits.middle + self.limits.room * x[:n], coefficients)

    def coordinates(self, motion: FourierMotion) -> np.ndarray:
        means = (motion.centre - self.limits.middle) / self.limits.room
        return np.concatenate([means, (self.basis.T @ motion.coefficients / self.amplitude).ravel()])

    def judge(self, motion: FourierMotion, limits: JointLimits) -> DesignedMotion:
        """A motion with its expected errors and the parts of limits that it uses."""
        return DesignedMotion(motion, self.expected(motion), self.used(motion, limits))

    def expected(self, motion: FourierMotion) -> ExpectedErrors:
        return expected_errors(self.family, self.derivatives, motion, self.sensing, self.plan.duration, self.half)

    def derivatives(self, *columns: np.ndarray) -> Float[np.ndarray, "K n p"]:
        """Derivatives of the torques in the parameters at rows (q, v, a, u), as many at a time as in the search."""
        slopes = self.torques.slopes(np.zeros(len(self.family.names)))
        return batched(lambda *part: slopes(*part)[0], columns, self.points)

    def used(self, motion: FourierMotion, limits: JointLimits, points: int = DENSE) -> Float[np.ndarray, "3 n"]:
        """Largest positions, velocities and torques as fractions of limits."""
        q, v, a = motion.at(self.times(points))
        return limits.used(q, v, in_batches(efforts, self.model, q, v, a)[:, 0])

    def enlarged(self, motion: FourierMotion, most: float) -> FourierMotion:
        """The motion with the largest amplitudes, up to a factor, with which all limits are kept."""
        low, high = 0.0, most
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            feasible = self.used(motion.scaled(middle), self.limits, FINE).max() <= 1 - SLACK
            low, high = (middle, high) if feasible else (low, middle)
        while self.used(motion.scaled(low), self.limits).max() > 1:
            low *= SMALLER
        return motion.scaled(low)

    def farthest(self, motion: FourierMotion) -> float:
        """Factor of the amplitudes beyond which positions leave their limits, whatever the motors can do."""
        q = motion.at(self.times(COARSE))[0] - motion.centre
        return float(np.min(2 * self.limits.room / np.maximum(np.abs(q).max(axis=0), 1e-300)))

    def places(self) -> Float[np.ndarray, "k n"]:
        """Configurations that the motors can hold: the middle if they can, then random ones; at least one."""
        rng = np.random.default_rng(self.plan.seed)
        inner = self.limits
        samples = rng.uniform(-1.0, 1.0, (PLACES, len(inner.room)))
        places = inner.middle + inner.room * np.concatenate([np.zeros_like(samples[:1]), samples / 2, samples])
        still = np.zeros_like(places)
        held = np.abs(in_batches(efforts, self.model, places, still, still)[:, 0]) / inner.effort
        load = held.max(axis=1)
        best = int(np.argmin(load))
        if load[best] >= 1:
            joint = int(np.argmax(held[best]))
            raise InputError(
                f"effort: the motors cannot hold the joints still anywhere within their limits; at best, joint "
                f"{inner.names[joint]!r} takes {held[best, joint] * inner.effort[joint]:.3g}, and "
                f"{inner.effort[joint]:.3g} may be used; give a larger effort, or another region"
            )
        possible = places[load < (1 + load[best]) / 2]
        return possible if load[0] < (1 + load[best]) / 2 else np.concatenate([places[best : best + 1], possible])

    def start(self, place: np.ndarray, k: int) -> np.ndarray:
        """Unknowns of a random motion within the limits, about a place."""
        rng = np.random.default_rng((self.plan.seed, k))
        z = rng.normal(size=(self.basis.shape[1], len(place)))
        motion = self.motion(np.concatenate([(place - self.limits.middle) / self.limits.room, z.ravel()]))
        return self.coordinates(self.enlarged(motion, 1.0).scaled(STARTING))


def _compiled(problem: _Problem) -> Callable[..., _Point]:
    """Compile objective, slack and their derivatives as a function of the unknowns and of the arrays of a window."""
    # JAX differentiates each row of the motion by itself, forwards; the unknowns act on all rows linearly.
    plan, n, model = problem.plan, len(problem.amplitude), problem.model
    basis = fourier_basis(problem.times(COARSE), plan.frequency, plan.harmonics) @ problem.basis
    inverse = inverse_inputs(model)
    back, directly = inverse.force, np.concatenate([inverse.position, inverse.rate, 0 * inverse.rate], axis=1)
    slopes = problem.torques.slopes(np.zeros(len(problem.family.names)))
    objective, slack = jax.jit(jax.value_and_grad(_objective, argnums=(0, 1))), jax.jit(_slack)
    slack_slopes = jax.jit(jax.jacrev(_slack))

    def to_unknowns(rows: np.ndarray) -> np.ndarray:
        """From derivatives (…, K, 3 n) in the rows (q, v, a) to those in the unknowns."""
        parts = np.stack(np.split(rows, 3, axis=-1), axis=-3)
        coefficients = np.einsum("dkm,...dki->...mi", basis, parts) * problem.amplitude
        means = parts[..., 0, :, :].sum(axis=-2) * problem.limits.room
        return np.concatenate([means, coefficients.reshape(*coefficients.shape[:-2], -1)], axis=-1)

    def evaluate(x: np.ndarray, window: tuple[Array, ...]) -> _Point:
        q, v, a = basis @ (x[n:].reshape(-1, n) * problem.amplitude)
        q = q + problem.limits.middle + problem.limits.room * x[:n]
        torque, inertia, d_torque, d_inertia = map(np.asarray, mapped(_dynamics, model, q, v, a))
        regressor, d_regressor = map(np.asarray, slopes(q, v, a, inverse.apply(torque, q, v)))
        d_rows, d_inputs = np.split(d_regressor, [3 * n], axis=-1)
        value, (by_regressor, by_inertia) = objective(regressor * problem.sizes, inertia, window)
        by_regressor = np.asarray(by_regressor) * problem.sizes
        rows = np.einsum("kjp,kjpr->kr", by_regressor, d_rows)
        rows += np.einsum("kjp,kjpm,mi,kir->kr", by_regressor, d_inputs, back, d_torque, optimize=True)
        rows += np.einsum("kjp,kjpm,mr->kr", by_regressor, d_inputs, directly, optimize=True)
        rows += np.einsum("kij,kijr->kr", by_inertia, d_inertia)
        fractions = np.stack(problem.limits.fractions(q, v, torque))
        # Derivatives (3, n, 3, K, n) of each bound in positions, velocities and torques.
        by_fraction = np.asarray(slack_slopes(fractions))
        sizes = problem.limits.room, problem.limits.velocity, problem.limits.effort
        by_q, by_v, by_torque = (by_fraction[:, :, d] / size for d, size in enumerate(sizes))
        bounds = np.concatenate([by_q, by_v, np.zeros_like(by_q)], axis=-1)
        bounds += np.einsum("cikj,kjr->cikr", by_torque, d_torque)
        jacobian = to_unknowns(bounds.reshape(3 * n, *bounds.shape[2:]))
        return _Point(float(value), to_unknowns(rows), np.asarray(slack(fractions)).ravel(), jacobian)

    return evaluate


def _dynamics(model: MechanicalSystem, q: Array, v: Array, a: Array) -> tuple[Array, Array, Array, Array]:
    """Torques (n,) and inertia matrix (n, n) in a row, and their derivatives (…, 3 n) in it."""

    def both(row: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        place, *rest = jnp.split(row, 3)
        found = efforts(model, place, *rest)[0], model.space(place)
        return found, found

    slopes, values = jax.jacfwd(both, has_aux=True)(jnp.concatenate([q, v, a]))
    return *values, *slopes


def _objective(regressor: Array, inertia: Array, window: tuple[Array, ...]) -> Array:
    """Mean log standard error of the parameters in their usual sizes, up to a constant: −log det / 2p."""
    transfer, weight, accelerations, beyond = window
    count, p = len(regressor), regressor.shape[2]
    spectrum = jnp.fft.rfft(regressor, axis=0)
    averaged = jnp.fft.irfft(spectrum * transfer[:, None, None].astype(spectrum.dtype), n=count, axis=0)
    variance = jnp.mean(inertia**2 @ accelerations, axis=0) + beyond
    information = weight * jnp.einsum("kjp,j,kjq->pq", averaged, 1 / variance, averaged)
    return -jnp.linalg.slogdet(information + jnp.eye(p) / PRIOR**2)[1] / (2 * p)


def _slack(fractions: Array) -> Array:
    """Lower bound (3, n) of the unused part of each limit, from the fractions (3, K, n) that the rows use."""
    both = jnp.concatenate([fractions, -fractions], axis=1)
    return 1.0 - logsumexp(SHARPNESS * both, axis=1) / SHARPNESS
