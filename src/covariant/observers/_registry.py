"""Lists the observers that `calibration` can tune, with one entry for each.

An observer is registered only here. `calibration.estimators` and `tuned_estimators`, the commands `estimate` and
`compare`, the laws in `tests/laws` and the table in `docs/observers.md` read this list.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, Literal, NamedTuple, cast

import jax.numpy as jnp
from jaxtyping import Array

from covariant._functional import Functional
from covariant._typing import Matrix, Scalar, Vector
from covariant.geometry.lie import SO3, AbstractGroup
from covariant.models import GroupSystem, MechanicalSystem, StateSpace, input_count
from covariant.models.robots import Legs
from covariant.observers.base import AbstractObserver, Covariance
from covariant.observers.constant_gain import (
    Geodesic,
    Intrinsic,
    IntrinsicForce,
    LagrangianMetric,
    MeasuredCoefficients,
    ModelCopy,
    Salcudean,
    of_mean_inertia,
)
from covariant.observers.differentiators import PLL, FilteredDerivative, HighGain, Levant, SavitzkyGolay
from covariant.observers.filters import (
    EKF,
    UKF,
    InformationEKF,
    IntrinsicKalman,
    JointKalman,
    LeggedBase,
    Riccati,
    StateEKF,
    covariance_ekf,
    information_ekf,
    legged_base,
    riccati,
)
from covariant.observers.sensors import MissingInputs, Sensor, SlowVariables
from covariant.observers.wrappers import Contacts

EDGE = 0.1
"""Standard deviation of the position of an encoder's edge, as a fraction of a tick: a typical tolerance."""


def mechanical(model: MechanicalSystem | StateSpace) -> bool:
    """Every mechanical system."""
    return model.sought.what == "velocity"


def without_loops(model: MechanicalSystem | StateSpace) -> bool:
    """Mechanical systems without closed loops."""
    return mechanical(model) and not model.manifold.redundant


def coordinates(model: MechanicalSystem | StateSpace) -> bool:
    """Mechanical systems in coordinates, not on a group, without closed loops."""
    return without_loops(model) and model.manifold.commuting


def without_contacts(model: MechanicalSystem | StateSpace) -> bool:
    """Mechanical systems without closed loops or feet."""
    return without_loops(model) and model.feet is None


def on_a_group(model: MechanicalSystem | StateSpace) -> bool:
    """Mechanical systems on a Lie group."""
    return mechanical(model) and isinstance(model.manifold, AbstractGroup)


def rotations(model: MechanicalSystem | StateSpace) -> bool:
    """Rigid bodies on SO(3)."""
    return mechanical(model) and model.manifold == SO3


def states(model: MechanicalSystem | StateSpace) -> bool:
    """Every state-space model, except bases of legged robots."""
    return model.sought.what == "state" and not on_legs(model)


def on_legs(model: Any) -> bool:
    """Bases of legged robots."""
    return model.sought.what == "state" and isinstance(model.f, Legs)


def intrinsic_kalman(
    model: MechanicalSystem,
    process: Covariance,
    measurement: Matrix,
    speed: float | Vector,
    quantum: float | tuple[float, ...] | None,
    slow: tuple[SlowVariables, ...] = (),
    sensors: tuple[Sensor, ...] = (),
    inputs: MissingInputs | None = None,
) -> IntrinsicKalman:
    """Intrinsic Kalman filter: for encoders that count ticks if their tick is known, else for Gaussian noise."""
    n = measurement.shape[0]
    velocity = jnp.diag(jnp.broadcast_to(jnp.asarray(speed, float), n) ** 2)
    made = partial(IntrinsicKalman, sensors=sensors, inputs=inputs)
    if quantum is None or not model.manifold.commuting:
        return made(model, process, measurement, velocity, slow, adaptive=True)
    # A reading is an interval here, so the only noise is that of the positions of edges. The error of a reading repeats
    # from row to row, as with a wrong model, so the filter cannot learn the size of the unknown from it.
    ticks = jnp.broadcast_to(jnp.asarray(quantum, float), n)
    return made(model, process, jnp.diag((EDGE * ticks) ** 2), velocity, slow, ticks)


class _NoForce(Functional):
    """No generalised force (n,), whatever the inputs are."""

    n: int

    def __call__(self, t: Scalar, q: Array, u: Vector) -> Vector:
        return jnp.zeros(self.n, q.dtype)


def tracking_loop(model: MechanicalSystem, bandwidth: float | Scalar) -> IntrinsicForce:
    """Phase-locked loop of third order on the group of a model: that of `PLL`, with errors by the logarithm.

    It follows a free body of the inertia 1, and takes what it does not explain for a force that lasts.
    """
    n, group = len(model.velocities), cast(AbstractGroup, model.manifold)
    names = {"velocities": model.velocities, "units": model.velocity_units, "inputs": input_count(model, n)}
    free = GroupSystem(group, jnp.eye(n), force=_NoForce(n), **names)
    return IntrinsicForce(free, bandwidth, jnp.square(bandwidth), bandwidth)  # α = 2ζω for ζ = ½


class Entry(NamedTuple):
    """An observer with the data needed to construct it for a model.

    Attributes:
        name: Name on the command line.
        observer: Class of the observer.
        make: Function that constructs the observer, `make(model, *numbers)`, with the numbers of `tuned_by`.
        tuned_by: Numbers that the observer needs. For a mechanical system `calibration.tuned_estimators` computes them.
            "gains" are α [1/s] and β [1/s²]; "gains and force" add the rate [1/s] at which a force is learnt; of
            "gains and speed" each may be (n,), and a bound of the speeds may follow. "noise" are the process
            covariance (n, n), the measurement covariance (n, n) and the standard deviation of the initial velocity;
            "noise or ticks" add one tick of the encoders or None, the slow states that are estimated,
            a tuple of `SlowVariables`, the further sensors, a tuple of `Sensor`, and the behaviour of missing inputs, a
            `MissingInputs` or None.
            For filters without a model: "bandwidth" is the bandwidth [rad/s] of a linear filter; "window" are a window
            [samples] and the degree of a polynomial; "motion" are the standard deviation [rad/s²] and the correlation
            time [s] of the accelerations, and the standard deviation of a sample; "jerk" is a bound on the jerk
            [rad/s³]; "loop" is the bandwidth [rad/s] of a loop on a group.
            For a state-space model, "state noise" is its `StateNoise`.
        about: Short description of the observer.
        when: When to choose it.
        source: Where it was published.
        fits: Function that says whether the observer can be constructed for a model; any mechanical system by default.
        promises: Laws that the tests check in addition to those of every observer. "error law": to first order the
            error in a parallel frame obeys `ξ' = ζ − αξ`, `ζ' = −βξ` on every model that it fits; "coordinate-free":
            the estimate is the same in all coordinates, up to the accuracy of its geodesics. None by default.

    Example:
        >>> from covariant import models, observers
        >>> entry = next(e for e in observers.REGISTRY if e.name == "pll")
        >>> entry.observer.__name__, entry.tuned_by, entry.fits(models.oscillator())
        ('PLL', 'bandwidth', True)
        >>> entry.construct(models.oscillator(), 20.0).bandwidth.item()
        20.0
        >>> [entry.name for entry in observers.REGISTRY if entry.fits(models.duffing())]
        ['covariance-ekf', 'information-ekf', 'riccati']
    """

    name: str
    observer: type[AbstractObserver]
    make: Callable[..., AbstractObserver]
    tuned_by: Literal[
        "gains",
        "gains and force",
        "gains and speed",
        "noise",
        "noise or ticks",
        "bandwidth",
        "window",
        "motion",
        "jerk",
        "loop",
        "state noise",
    ]
    about: str
    when: str
    source: str
    fits: Callable[[Any], bool] = mechanical
    promises: tuple[Literal["error law", "coordinate-free"], ...] = ()

    def construct(self, model: MechanicalSystem | StateSpace, *numbers: Any) -> AbstractObserver:
        """The observer for a model; if the model has feet, wrapped in `Contacts`.

        Args:
            model: The model.
            numbers: The numbers of `tuned_by`.

        Returns:
            The observer.
        """
        observer = self.make(model, *numbers)
        return Contacts(observer) if self.knows_model and model.feet is not None else observer

    @property
    def has_gate(self) -> bool:
        """Whether it has a gate of its own, based on its covariance; other observers are wrapped in a `Gated`."""
        return "gate" in self.observer.__dataclass_fields__

    @property
    def knows_model(self) -> bool:
        """Whether the observer predicts with the model, instead of using positions alone."""
        return self.tuned_by not in ("bandwidth", "window", "motion", "jerk", "loop")


REGISTRY = (
    Entry(
        name="intrinsic",
        observer=Intrinsic,
        make=Intrinsic,
        tuned_by="gains",
        about="explicit, errors to first order",
        when="the default: cheap, locally the full error law",
        source="Aghannan & Rouchon 2003, (5); on a group Maithripala, Berg & Dayawansa 2004, (17)",
        promises=("error law",),
    ),
    Entry(
        name="intrinsic2",
        observer=Intrinsic,
        make=partial(Intrinsic, order=2),
        tuned_by="gains",
        about="`Intrinsic(order=2)`: the same with ξ = e − ½B(e, e)",
        when="larger errors at little cost",
        source="an addition to Aghannan & Rouchon 2003, (5)",
        promises=("error law",),
    ),
    Entry(
        name="intrinsic-force",
        observer=IntrinsicForce,
        make=IntrinsicForce,
        tuned_by="gains and force",
        about="`Intrinsic` with an estimate of an unknown constant force: integral action, three poles",
        when="loads, friction or masses that the model does not know; in the loop of a controller",
        source="an addition to Aghannan & Rouchon 2003, (5); Johnson 1971 for the state of the force",
    ),
    Entry(
        name="geodesic",
        observer=Geodesic,
        make=Geodesic,
        tuned_by="gains",
        about="geodesic error, parallel transport; the same in all coordinates",
        when="large initial errors if the gain is not low; curved charts",
        source="Aghannan & Rouchon 2003, (2)",
        promises=("error law", "coordinate-free"),
    ),
    Entry(
        name="lagrangian-metric",
        observer=LagrangianMetric,
        make=LagrangianMetric,
        tuned_by="gains",
        about="the model, and an implicit step along the geodesic to each sample; the same in all coordinates",
        when="a large first error at high gain, few samples, long gaps",
        source="Sanfelice & Praly 2015, (3), in the lifted kinetic-energy metric; Rockafellar 1976 for the step",
        promises=("coordinate-free",),
    ),
    Entry(
        name="measured-coefficients",
        observer=MeasuredCoefficients,
        make=MeasuredCoefficients,
        tuned_by="gains and speed",
        about="high gain, the model at the measured configuration, clipped speeds",
        when="convergence from all first errors, proved for all coordinates together; dense samples",
        source="an addition; Esfandiari & Khalil 1992 for high gain and saturation",
        fits=coordinates,
    ),
    Entry(
        name="copy",
        observer=ModelCopy,
        make=ModelCopy,
        tuned_by="gains",
        about="the model with output injection",
        when="high gain on nearly flat metrics",
        source="Aghannan & Rouchon 2003, (15)",
    ),
    Entry(
        name="intrinsic-kalman",
        observer=IntrinsicKalman,
        make=intrinsic_kalman,
        tuned_by="noise or ticks",
        about="error and covariance in the parallel frame, with reset and gate; the same in all coordinates",
        when="known noise, large initial errors, gaps and outliers: the most accurate",
        source="Ge, van Goor & Mahony 2025, extended to second-order systems",
    ),
    Entry(
        name="ekf",
        observer=EKF,
        make=partial(EKF, adaptive=True),
        tuned_by="noise",
        about="extended Kalman filter, square-root form; on SO(3) the multiplicative, on SE(3) the left-invariant one",
        when="known noise, large initial uncertainty",
        source="Gelb 1974, 6.1; Lefferts, Markley & Shuster 1982; Barrau & Bonnabel 2017, 3",
        fits=without_contacts,
    ),
    Entry(
        name="ukf",
        observer=UKF,
        make=partial(UKF, adaptive=True),
        tuned_by="noise",
        about="unscented Kalman filter, square-root form; on a group its points are drawn in the frame",
        when="known noise, strong nonlinearity between few samples",
        source="Julier & Uhlmann 2004; Brossard, Barrau & Bonnabel 2020",
        fits=without_contacts,
    ),
    Entry(
        name="filtered-derivative",
        observer=FilteredDerivative,
        make=lambda model, bandwidth: FilteredDerivative(bandwidth, model.circles),
        tuned_by="bandwidth",
        about="difference of two samples, low-pass filtered; knows no model",
        when="there is no model: the least effort",
        source="common practice",
        fits=coordinates,
    ),
    Entry(
        name="pll",
        observer=PLL,
        make=lambda model, bandwidth: PLL(bandwidth, circles=model.circles),
        tuned_by="bandwidth",
        about="phase-locked loop, the α-β tracking loop of drives; knows no model",
        when="there is no model, and speeds are steady",
        source="Gardner 2005; Kalata 1984",
        fits=coordinates,
    ),
    Entry(
        name="pll3",
        observer=PLL,
        make=lambda model, bandwidth: PLL(bandwidth, 0.5, 3, circles=model.circles),
        tuned_by="bandwidth",
        about="`PLL(order=3)`: the α-β-γ tracking loop, which follows accelerations; knows no model",
        when="there is no model, and accelerations last",
        source="Gardner 2005; Kalata 1984",
        fits=coordinates,
    ),
    Entry(
        name="high-gain",
        observer=HighGain,
        make=lambda model, bandwidth: HighGain(bandwidth, circles=model.circles),
        tuned_by="bandwidth",
        about="high-gain differentiator of third order, three equal poles; knows no model",
        when="there is no model, and speeds change",
        source="Vasiljevic & Khalil 2008; Khalil & Praly 2014",
        fits=coordinates,
    ),
    Entry(
        name="levant",
        observer=Levant,
        make=lambda model, jerk: Levant(jerk, circles=model.circles),
        tuned_by="jerk",
        about="Levant's exact differentiator of second order, sampled without chatter; knows no model",
        when="there is no model, little noise, and a bound on the jerk",
        source="Levant 2003; Koch, Reichhartinger, Horn & Fridman 2020",
        fits=coordinates,
    ),
    Entry(
        name="savitzky-golay",
        observer=SavitzkyGolay,
        make=lambda model, window, order: SavitzkyGolay(window, order, model.circles),
        tuned_by="window",
        about="slope of a parabola or cubic through the latest samples; knows no model",
        when="there is no model, and memory for a window",
        source="Savitzky & Golay 1964, one-sided",
        fits=coordinates,
    ),
    Entry(
        name="joint-kalman",
        observer=JointKalman,
        make=lambda model, std, time, noise: JointKalman(std, time, noise, model.circles),
        tuned_by="motion",
        about="Kalman filter of every coordinate by itself, its acceleration coloured noise; knows no model",
        when="there is no model, but an idea of the motion: the best linear filter for it",
        source="Singer 1970; Bar-Shalom, Li & Kirubarajan 2001",
        fits=coordinates,
    ),
    Entry(
        name="tracking-loop",
        observer=IntrinsicForce,
        make=tracking_loop,
        tuned_by="loop",
        about="phase-locked loop of third order for poses and attitudes, by the logarithm; knows no model",
        when="there is no model of a body",
        source="Gardner 2005, in a parallel frame as by Aghannan & Rouchon 2003, (5)",
        fits=on_a_group,
    ),
    Entry(
        name="salcudean",
        observer=Salcudean,
        make=of_mean_inertia,
        tuned_by="gains",
        about="a Lyapunov design for a rigid body",
        when="what the others are compared with",
        source="Salcudean 1991",
        fits=rotations,
    ),
    Entry(
        name="covariance-ekf",
        observer=StateEKF,
        make=covariance_ekf,
        tuned_by="state noise",
        about="extended Kalman filter with sampled measurements, covariance in Joseph form, and a gate for outliers",
        when="the default: it knows how certain each state is",
        source="Gelb 1974, 6.1",
        fits=states,
    ),
    Entry(
        name="information-ekf",
        observer=InformationEKF,
        make=information_ekf,
        tuned_by="state noise",
        about="extended Kalman filter in information form, measurements as in continuous time",
        when="dense samples, and states that are unknown at first",
        source="Sanfelice & Praly 2015, (13)–(14)",
        fits=states,
    ),
    Entry(
        name="riccati",
        observer=Riccati,
        make=riccati,
        tuned_by="state noise",
        about="correction through the contraction metric that a Riccati equation gives at the estimate",
        when="a gain that depends on the estimate alone, and not on how it got there",
        source="Sanfelice & Praly 2015, (11)",
        fits=states,
    ),
    Entry(
        name="legged-base",
        observer=LeggedBase,
        make=legged_base,
        tuned_by="state noise",
        about="an IMU integrated, with feet that stand as anchors; a foot that is off is anchored anew at once",
        when="the velocity of a robot on legs, without flags of contact, masses or torques",
        source="Hartley, Ghaffari, Eustice & Grizzle 2020, in the axes of the base",
        fits=on_legs,
    ),
)
"""The observers that the verbs know by name, with what each needs and when to choose it.

The first entry that fits a model is the default choice. Use it to loop over all observers for a model, as
`calibration.tuned_estimators` does.
"""
