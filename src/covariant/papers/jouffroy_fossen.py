"""Jouffroy & Fossen 2004, reproduced: the ship, the print's counter-examples, ODIN under output feedback, Theorem 3."""

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant import geometry, models
from covariant._integrate import rk4
from covariant.certificates import (
    CascadeCertificate,
    cascade,
    contraction,
    crossed_metric,
    falsify,
    feedthrough,
    tracking,
    virtual,
)
from covariant.control import Backstepping, lissajous
from covariant.models import marine, state_space
from covariant.observers import (
    AbstractObserver,
    Contracting,
    FilteredDerivative,
    InformationEKF,
    Intrinsic,
    PassiveShip,
    craft_observer,
    lyapunov_gains,
    lyapunov_rate,
    notch_gains,
    printed_rate,
    run,
)
from covariant.proofs import Box, Proof, blocks, box, prove, prove_at_corners
from covariant.riccati import Equation
from covariant.signals import Record
from covariant.simulation import observe

KP, KD, LAMBDA = 100.0, 200.0, 0.5
"""Gains of the controller of ODIN."""
PRINTED_K2 = (1.0 - KP) * np.eye(6)
"""K2 = I − K_p, as printed below (103)."""
K1, K2 = np.diag([1.7] * 3 + [3.0] * 3), np.diag([240.0] * 3 + [150.0] * 3)
"""Repaired gains of the observer (101)–(102): K2 symmetric positive definite."""
CROSS = np.diag([140.0] * 3 + [6.5] * 3)
"""Cross term of its metric."""
STAGES = 6
"""Number of times `reproduce` and the drawing that may follow report progress."""


# The ship, Example 2


def ship_eigenvalues() -> dict[str, float]:
    """Largest real part of the virtual system (53) with K1 = I and K2 as printed in (54) and as corrected.

    A supply vessel at ψ = 0, in the Bis system: lengths by L, times by √(L/g).
    """
    station = marine.Station(marine.supply_vessel(length=1.0, mass=1.0, gravity=1.0))
    found = {}
    for name, sign in (("printed", -1.0), ("corrected", 1.0)):

        def flow(x, sign=sign):
            turn = marine.yaw_rotation(jnp.zeros(()))
            copy = station.derivative(jnp.zeros(()), x, jnp.zeros(3))
            return copy - jnp.concatenate([x[:3], sign * turn.T @ x[:3]])

        values = np.linalg.eigvals(np.asarray(jax.jacfwd(flow)(jnp.zeros(6))))
        found[name] = float(values.real.max())
    return found


def ship_decay(duration: float = 600.0) -> dict[str, Any]:
    """The observer (43)–(44) of the supply vessel, moored, with gains from (48)–(50): V along a turning motion.

    `t`, `lyapunov` V (T,), the guaranteed `rate` α of `V ≤ e^(−2αt) V(0)`, that `printed` in (47) and the `fitted` one.
    """
    vessel = marine.supply_vessel(mooring=np.diag([5e4, 5e4, 5e7]))
    station = marine.Station(vessel)
    mass = np.asarray(vessel.mass)
    gains = lyapunov_gains(station, mass * 1e-2, mass * 1e-3)
    observer = PassiveShip(station, gains)
    x0 = jnp.array([0.0, 0.0, 0.3, 0.5, -0.2, 0.004])
    start = observer.init(jnp.array([10.0, -5.0, 0.4]))
    t = jnp.linspace(0.0, duration, 301)

    def push(s, x):
        return jnp.array([5e4, -3e4, 2e6]) * jnp.sin(0.02 * s + jnp.array([0.0, 1.0, 2.0]))

    x, state = observe(station.model(), observer, x0, start, t, push)
    error = np.asarray(jax.vmap(lambda e: geometry.wrap((2,), e))(x - state.x))
    p1, p2 = np.asarray(gains.stiffness), np.asarray(gains.inertia)
    value = np.einsum("ti,ij,tj->t", error[:, :3], p1, error[:, :3]) / 2
    value = value + np.einsum("ti,ij,tj->t", error[:, 3:], p2, error[:, 3:]) / 2
    fitted = -np.polyfit(np.asarray(t)[60:], np.log(value)[60:], 1)[0] / 2
    rates = {"rate": lyapunov_rate(station, gains), "printed": printed_rate(station, gains), "fitted": float(fitted)}
    return {"t": np.asarray(t), "lyapunov": value, **rates}


# Theorem 2 as printed


class Scalar(NamedTuple):
    """`x' = ax + bu`, z = x, `u = gx̂`, with the observer gain k: a counter-example in numbers."""

    a: float
    b: float
    g: float
    k: float

    @property
    def printed(self) -> float:
        """The printed Jacobian `a + bg − k` [1/s]: "contracting" where negative."""
        return self.a + self.b * self.g - self.k

    @property
    def true(self) -> float:
        """What the observer's error obeys, `a − k` [1/s]."""
        return self.a - self.k

    def observer(self) -> Contracting:
        model = models.StateSpace(
            lambda t, x, u: self.a * x + self.b * u,
            lambda t, x, u: x,
            coordinates=("x",),
            inputs=1,
        )
        return Contracting(model, jnp.array([[self.k]]), jnp.zeros(1))

    def proof(self, rate: float) -> Proof:
        """Does the virtual system contract at `rate` [1/s], over |x|, |u|, |z| ≤ 1?"""
        subject = virtual(self.observer(), jnp.eye(1))
        size = len(subject.names)
        return prove(contraction(subject, rate), Box(subject.names, subject.units, -np.ones(size), np.ones(size)))


COUNTEREXAMPLES = {
    "called contracting, diverges": Scalar(1.0, 1.0, -10.0, 0.0),
    "called contracting, diverges slowly": Scalar(1.0, 1.0, -3.0, 0.5),
    "called not contracting, converges": Scalar(-1.0, 1.0, 5.0, 0.0),
}
"""Systems on which (16) and (20) as printed say the opposite of what happens."""


# ODIN, section IV


def odin_path():
    """A motion in all six degrees of freedom: a slow Lissajous figure, rolling and pitching by 0.3 and 0.4 rad."""
    return lissajous(
        centre=(0.0, 0.0, 5.0, 0.0, 0.0, 0.0),
        amplitude=(4.0, 3.0, 1.0, 0.3, 0.4, 1.0),
        frequency=(0.1, 0.2, 0.15, 0.12, 0.17, 0.08),
        phase=(0.0, 0.5, 1.0, 0.3, 0.0, 0.7),
    )


def odin_controller() -> Backstepping:
    """The paper's controller (94) with K_p = 100, K_d = 200, Λ = 0.5."""
    return Backstepping(marine.odin(), odin_path(), KP, KD, LAMBDA)


def odin_observer(k2: Float[np.ndarray, "6 6"] = K2) -> Contracting:
    """The paper's observer (101)–(102) with this K2."""
    return craft_observer(marine.odin(), K1, k2)


class Loop(NamedTuple):
    """Stamps (T,) [s], and norms (T,) of the tracking error (η̃, s) and of the observer's error."""

    t: np.ndarray
    tracking: np.ndarray
    observer: np.ndarray


@eqx.filter_jit
def _odin_loop(controller: Backstepping, observer: Contracting, t: Array):
    plant = state_space(controller.craft)
    x0 = jnp.array([1.0, -1.0, 4.0, 0.1, -0.1, 0.3, *[0.0] * 6])
    start = observer.init(x0[:6])
    off = jnp.array([0.3, -0.2, 0.2, 0.05, 0.05, -0.1, 0.2, 0.1, -0.1, 0.05, -0.05, 0.1])
    start = start._replace(x=x0 + off)
    x, state = observe(plant, observer, x0, start, t, controller=controller, rtol=1e-9, atol=1e-12, max_steps=100_000)
    eta = x[:, :6]
    e = jax.vmap(controller.error)(t, eta)
    s = x[:, 6:] - jax.vmap(controller.virtual_velocity)(t, eta)
    return jnp.concatenate([e, s], axis=1), x - state.x


def odin_loop(k2: Float[np.ndarray, "6 6"] = K2, duration: float = 60.0) -> Loop:
    """The true plant, J' included, under (94) and (101)–(102), from errors of a metre and some degrees."""
    t = jnp.linspace(0.0, duration, round(10 * duration) + 1)
    e, error = _odin_loop(odin_controller(), odin_observer(k2), t)
    tracking, observer = (np.linalg.norm(np.asarray(a), axis=1) for a in (e, error))
    return Loop(np.asarray(t), tracking, observer)


def odin_box(pitch: float = 0.7, roll: float = 0.7, rate: float = 0.2, speed: float = 0.5, spin: float = 0.3) -> Box:
    """Variables of the observer's virtual system: attitude [rad], its rates [rad/s], estimated velocities.

    Position and yaw do not enter, and are held at zero; so are the input and the estimated position.
    """
    subject = virtual(odin_observer(), np.eye(12))
    wide = {"z_roll": roll, "z_pitch": pitch, "zdot_roll": rate, "zdot_pitch": rate, "zdot_yaw": rate}
    wide |= dict.fromkeys(("surge", "sway", "heave"), speed) | dict.fromkeys(
        ("roll_rate", "pitch_rate", "yaw_rate"), spin
    )
    high = np.array([wide.get(name, 0.0) for name in subject.names])
    return Box(subject.names, subject.units, -high, high)


def odin_certificate(rate: float, domain: Box | None = None, boxes: int = 200_000) -> list[Proof]:
    """Does the repaired observer contract at `rate` [1/s] of squared lengths, in the metric with the cross term?

    Translation and rotation are apart, and proved apart. Velocities enter as the slope 2|ν| of the drag alone, so those
    that are not negative stand for all; there the drag is a square, and its slope linear.
    """
    domain = odin_box() if domain is None else domain
    names = marine.odin().velocities
    low = np.where(np.isin(domain.names, names), 0.0, domain.low)
    square = np.diag(marine.odin().damping(jnp.ones(6)))
    ahead = eqx.tree_at(lambda c: c.damping, marine.odin(), lambda nu: jnp.diag(jnp.asarray(square) * nu))
    subject = virtual(craft_observer(ahead, K1, K2), crossed_metric(ahead, K2, CROSS))
    matrix = contraction(subject, rate)
    parts = blocks(matrix, domain)
    return [
        proof
        for part in parts
        for proof in prove_at_corners(
            matrix.then(lambda whole, part=part: whole[part][:, part]),
            domain._replace(low=low),
            (*names, "zdot_roll", "zdot_pitch", "zdot_yaw"),
            boxes=boxes,
        )
    ]


def odin_sampled_rate(k2: np.ndarray = K2, cross: np.ndarray = CROSS, domain: Box | None = None) -> float:
    """Least rate [1/s] found over the set: at most 0 for K2 = I without a cross term, whatever drag acts elsewhere."""
    subject = virtual(odin_observer(k2), crossed_metric(marine.odin(), k2, cross))
    return falsify(subject, domain or odin_box(), 0.0).margin


def odin_eigenvalues() -> dict[str, float]:
    """Largest real part of the frozen observer error at rest, level, for the printed K2, for I and for the repair."""
    found = {}
    for name, k2 in (("printed", PRINTED_K2), ("identity", np.eye(6)), ("repaired", K2)):
        observer = odin_observer(k2)

        def flow(x, observer=observer):
            return observer.virtual(jnp.zeros(()), x, jnp.zeros(6), jnp.zeros(6))

        found[name] = float(np.linalg.eigvals(np.asarray(jax.jacfwd(flow)(jnp.zeros(12)))).real.max())
    return found


def odin_cascade(
    pitch: float = 0.5, attempts: int = 20_000, starts: int = 64, proved: bool = False
) -> CascadeCertificate:
    """Theorem 3 for ODIN over attitudes up to `pitch` in roll and pitch and the velocities of `odin_box`."""
    controller = odin_controller()
    plant = tracking(controller)
    high = [0.0, 0.0, 0.0, pitch, pitch, 0.0] + [0.0] * 6 + [0.5] * 3 + [0.3] * 3
    plant_box = Box(plant.names, plant.units, -np.array(high), np.array(high))
    craft = controller.craft
    heavy = crossed_metric(craft, K2, CROSS)
    mass = float(craft.mass[0, 0])
    subject = virtual(odin_observer(), lambda z, x: heavy(z, x) / mass)  # V_obs per unit of mass
    tilts: dict[str, tuple[float, float]] = dict.fromkeys(("coupling_roll", "coupling_pitch"), (-pitch, pitch))
    names = [f"{kind}_{name}" for kind in ("coupling", "asked") for name in craft.coordinates]
    coupling_box = box(**{name: tilts.get(name, (0.0, 0.0)) for name in names})
    both = state_space(craft).units
    return cascade(
        (plant, plant_box),
        (subject, odin_box(pitch=pitch, roll=pitch)),
        (feedthrough(controller), coupling_box),
        units=(both, both),
        attempts=attempts,
        starts=starts,
        proved=proved,
    )


@eqx.filter_jit
def _somersault(t: Array):
    system = marine.odin_on_group()
    observer = Intrinsic(system, 8.0, 16.0)
    x0 = models.Motion(system.group.identity(), jnp.zeros(6))
    start = observer.init(system.group.exp(jnp.array([0.3, -0.2, 0.2, 0.1, 0.15, -0.2])))
    start = start._replace(v=jnp.array([0.2, 0.1, -0.1, 0.1, -0.2, 0.1]))

    def torque(s, x):
        return jnp.array([5.0, 0.0, 0.0, 0.0, 150.0, 0.0])

    x, state = observe(system, observer, x0, start, t, torque, rtol=1e-9, atol=1e-12)
    error = jax.vmap(system.group.between)(x.q, state.q)
    return jnp.arcsin(jnp.clip(-x.q[:, 2, 0], -1.0, 1.0)), jnp.concatenate([error, state.v - x.v], axis=1)


def somersault(duration: float = 16.0) -> dict[str, np.ndarray]:
    """ODIN on SE(3), turned over its own nose by a constant torque, and the observer of its group beside it.

    Stamps `t` [s], `pitch` (T,) [rad], and the norm of the observer's `error` (T,). Its law is s² + 8s + 16
    beside the drag; with s² + 2s + 1 the gains are too low for this speed, and an error remains.
    """
    t = np.linspace(0.0, duration, round(20 * duration) + 1)
    pitch, error = _somersault(jnp.asarray(t))
    return {"t": t, "pitch": np.asarray(pitch), "error": np.linalg.norm(np.asarray(error), axis=1)}


# Dynamic positioning


class Sea(NamedTuple):
    """A log of dynamic positioning: north, east and heading with noise, gaps and wave motion, and the truth.

    `record` has the commanded force (T, 3), the measurement (T, 3) with NaN where there is none, and the true state.
    `observers`: the estimators compared on it, by their key in the results.
    """

    record: Record
    station: marine.Station
    observers: dict[str, AbstractObserver]


STEP, DURATION, GAPS = 0.1, 1200.0, ((400.0, 460.0), (800.0, 830.0))
"""Sampling time of the compass, length of the log and the gaps of GNSS [s]."""
GNSS, COMPASS = 0.5, math.radians(0.1)
"""Standard deviations of a position [m] and of a heading [rad]."""


def sea(seed: int = 0) -> Sea:
    """A supply vessel in waves of 0.8 m (standard deviation), with slowly varying forces, under PD control.

    Compass at 10 Hz, GNSS at 1 Hz with gaps of 60 and 30 s.
    """
    waves = marine.Waves((0.8, 0.8, 0.8), (0.1, 0.1, 0.1), (0.8, 0.8, math.radians(1.0)))
    station = marine.Station(marine.supply_vessel(), waves, bias_time=1000.0)
    model = station.model(noise=True)
    random = np.random.default_rng(seed)
    t = np.arange(round(DURATION / STEP) + 1) * STEP
    slow = np.array([3e4, 3e4, 1e6]) / math.sqrt(1000.0 / 2)  # N/√s and N m/√s: 30 kN and 1 MN m in the long run
    noise = random.normal(size=(len(t), 6)) / math.sqrt(STEP) * np.concatenate([np.ones(3), slow])
    mass = np.diag(np.asarray(station.ship.mass))

    def goal(s):
        return jnp.where(s < 600.0, jnp.zeros(3), jnp.array([20.0, -10.0, math.radians(30.0)]))

    def step(x, sample):
        now, drive = sample
        eta, nu = x[:3], x[3:6]
        error = geometry.wrap((2,), eta - goal(now))
        wanted = -jnp.asarray(mass) * (0.05**2 * (marine.yaw_rotation(eta[2]).T @ error) + 2 * 0.8 * 0.05 * nu)
        tau = jnp.clip(wanted, -jnp.array([3e5, 3e5, 1e7]), jnp.array([3e5, 3e5, 1e7]))
        u = jnp.concatenate([tau, drive])
        return rk4(lambda s, x: model.f(s, x, u), now, x, STEP, 1), (x, tau)

    x0 = jnp.zeros(station.order).at[12:15].set(jnp.array([2e4, -1e4, 5e5]))
    _, (x, tau) = jax.lax.scan(step, x0, (jnp.asarray(t), jnp.asarray(noise)))
    x = np.asarray(x)
    y = np.asarray(jax.vmap(station.output)(jnp.asarray(x)))
    y = y + random.normal(size=y.shape) * np.array([GNSS, GNSS, COMPASS])
    silent = np.arange(len(t)) % round(1 / STEP) != 0
    for begin, end in GAPS:
        silent |= (t >= begin) & (t < end)
    y[silent, :2] = np.nan
    observers = {
        "passive observer": passive_observer(station),
        "extended Kalman filter": sea_filter(station, y[0]),
        "filtered derivative": FilteredDerivative(0.1, (2,)),
    }
    return Sea(Record(t, np.asarray(tau), y, x), station, observers)


def passive_observer(station: marine.Station) -> PassiveShip:
    """The observer as it is tuned for the log."""
    return PassiveShip(station, notch_gains(station, (0.1, 0.1, 0.2)), memory=2.0)


def sea_filter(station: marine.Station, y0: np.ndarray) -> InformationEKF:
    """The extended Kalman filter that knows the densities of all noises of the log."""
    part, order = station.parts, station.order
    q = np.zeros(order)
    q[part["waves"]][3:] = np.asarray(station.waves.intensity) ** 2 if station.waves else 0.0
    q[part["bias"]] = (np.array([3e4, 3e4, 1e6]) ** 2) * 2 / 1000.0
    q[part["nu"]] = np.array([1e-6, 1e-6, 1e-9])
    variances = np.full(order, 1.0)
    variances[part["eta"]] = np.array([1.0, 1.0, 1e-3])
    variances[part["nu"]] = np.array([0.1, 0.1, 1e-4])
    variances[part["waves"]] = np.array([1.0, 1.0, 1e-3] * 2)
    variances[part["bias"]] = np.array([1e9, 1e9, 1e12])
    density = STEP * np.diag([GNSS**2, GNSS**2, COMPASS**2])
    start = jnp.zeros(order).at[:3].set(jnp.asarray(y0))
    return InformationEKF(
        station.model(),
        Equation(process_cov=jnp.diag(jnp.asarray(q)), measurement_cov=jnp.asarray(density)),
        start,
        jnp.diag(1 / jnp.asarray(variances)),
        substeps=5,  # its information changes fast where waves are fast; with one it is off by half
    )


def sea_errors(log: Sea) -> dict[str, Float[np.ndarray, "T 3"]]:
    """Errors of surge, sway [m/s] and yaw rate [rad/s] by three estimators; row k has used measurements up to row k."""
    record = log.record
    truth = np.asarray(record.x)[:, 3:6]
    passive, kalman, filtered = (np.asarray(run(o, record).estimate) for o in log.observers.values())
    derived = filtered[:, 3:]
    heading = np.asarray(record.x)[:, 2]
    turned = np.stack(
        [
            np.cos(heading) * derived[:, 0] + np.sin(heading) * derived[:, 1],
            -np.sin(heading) * derived[:, 0] + np.cos(heading) * derived[:, 1],
            derived[:, 2],
        ],
        axis=1,
    )
    estimates = (passive[:, 3:6], kalman[:, 3:6], turned)
    return {name: estimate - truth for name, estimate in zip(log.observers, estimates, strict=True)}


def sea_cost(log: Sea) -> dict[str, float]:
    """Time of a sample [µs], of the compiled loop on this machine."""
    found = {}
    for name, observer in log.observers.items():
        jax.block_until_ready(run(observer, log.record).estimate)
        began = time.perf_counter()
        jax.block_until_ready(run(observer, log.record).estimate)
        found[name] = 1e6 * (time.perf_counter() - began) / len(log.record.t)
    return found


SETTLED = 100.0
"""Seconds of the log that do not count."""


def sea_table(log: Sea) -> dict[str, dict[str, float]]:
    """Velocity errors (RMSE) after the first 100 s, and in the gaps of GNSS."""
    t = np.asarray(log.record.t)
    gap = np.zeros(len(t), bool)
    for begin, end in GAPS:
        gap |= (t >= begin) & (t < end)
    found = {}
    for name, error in sea_errors(log).items():
        rms = np.sqrt(np.mean(error[t > SETTLED] ** 2, axis=0))
        worst = np.sqrt(np.mean(np.sum(error[gap, :2] ** 2, axis=1)))
        found[name] = {"surge": float(rms[0]), "sway": float(rms[1]), "yaw_rate": float(rms[2]), "gaps": float(worst)}
    return found


# Everything together


def reproduce(progress: Callable[[str], None] = lambda stage: None) -> dict[str, Any]:
    """Everything of the paper that is a number.

    Keys: `ship` (eigenvalues of (53) with either K2, guaranteed and fitted rates), `theorem2` (what the print says of
    the counter-examples, what is true, and the verdict of the proof), `odin` (eigenvalues and sampled rates with three
    K2, the certified rate and its set, the rates of the closed loop), `somersault` (on SE(3), through a
    pitch of 90°), `theorem3` (constants and verdicts), `sea`
    (velocity errors of three estimators), and `seconds`.
    """
    began = time.perf_counter()
    progress("the ship")
    decay = ship_decay()
    results: dict[str, Any] = {
        "ship": {"eigenvalues": ship_eigenvalues(), **{k: decay[k] for k in ("rate", "printed", "fitted")}},
    }
    progress("Theorem 2")
    results["theorem2"] = {
        name: {"printed": case.printed, "true": case.true, "proof": case.proof(0.1).verdict}
        for name, case in COUNTEREXAMPLES.items()
    }
    progress("ODIN")
    proofs = odin_certificate(RATE)
    fitted = odin_loop()
    results["odin"] = {
        "eigenvalues": odin_eigenvalues(),
        "sampled": {
            "identity, no cross term": odin_sampled_rate(np.eye(6), np.zeros((6, 6))),
            "repaired, no cross term": odin_sampled_rate(K2, np.zeros((6, 6))),
            "repaired": odin_sampled_rate(),
        },
        "certified": {
            "rate": RATE,
            "verdict": "holds" if all(proof.verdict == "holds" for proof in proofs) else "undecided",
            "boxes": sum(proof.boxes for proof in proofs),
            "domain": str(odin_box().free),
        },
        "loop": {"tracking": tail_rate(fitted.t, fitted.tracking), "observer": tail_rate(fitted.t, fitted.observer)},
    }
    progress("Theorem 3")
    turning = somersault()
    results["somersault"] = {
        "largest_pitch": math.degrees(float(np.abs(turning["pitch"]).max())),
        "times_past_80_degrees": int((np.diff((np.abs(turning["pitch"]) > math.radians(80.0)).astype(int)) == 1).sum()),
        "error_first": float(turning["error"][0]),
        "error_last": float(turning["error"][-1]),
    }
    found = odin_cascade()
    results["theorem3"] = {
        "constants": found.constants._asdict(),
        "gamma1_squared": found.constants.gamma1**2,
        "bound": found.constants.bound,
        "printed": found.printed,
        "weighted": found.constants.weighted,
        "kappa": found.kappa,
        "units": found.units,
    }
    progress("dynamic positioning")
    log = sea()
    results["sea"] = sea_table(log)
    for name, microseconds in sea_cost(log).items():
        results["sea"][name]["cost"] = round(microseconds, 2)
    results["seconds"] = round(time.perf_counter() - began, 1)
    return results


RATE = 0.8
"""Certified rate of ODIN's observer [1/s], of squared lengths."""


def tail_rate(t: np.ndarray, error: np.ndarray, floor: float = 1e-7) -> float:
    """Slope of −log error over time [1/s], over the later half of the time it takes to reach the floor."""
    end = int(np.argmax(error < floor)) or len(t)
    later = slice(end // 2, end)
    return -float(np.polyfit(t[later], np.log(error[later]), 1)[0])


def draw(path: Path) -> tuple[Path, Path]:
    """ODIN under output feedback with either K2, and (`_sea`) three estimators of a ship's velocity."""
    return draw_odin(path), draw_sea(path.with_stem(f"{path.stem}_sea"))


def draw_odin(path: Path) -> Path:
    """Errors of the observer and of the tracking of ODIN, with K2 as repaired and as printed."""
    from covariant.report import new_figure, save_figure

    titles = ("Observer error |x̃| of ODIN", "Tracking error |(η̃, s)|")
    figure, axes = new_figure(1, 2, panel=(5.4, 3.6), titles=titles)
    for label, k2, duration in (("K2 as repaired", K2, 60.0), ("K2 = I − Kp, as printed", PRINTED_K2, 12.0)):
        loop = odin_loop(k2, duration)
        for ax, error in zip(axes[0], (loop.observer, loop.tracking), strict=True):
            ax.semilogy(loop.t, np.where(error > 1e-10, error, np.nan), label=label)
    t = np.array([0.0, 30.0])
    axes[0, 0].semilogy(t, np.exp(-RATE / 2 * t), "k:", label=f"certified: e^(−{RATE / 2:g} t)")
    for ax in axes[0]:
        ax.set(xlabel="t [s]", xlim=(0.0, 30.0), ylim=(1e-10, 1e2))
    axes[0, 0].set_ylabel("norm [m, rad, m/s, rad/s]")
    axes[0, 0].legend(fontsize=8)
    return save_figure(figure, path)


def draw_sea(path: Path) -> Path:
    """The log at sea, and what three estimators make of its velocity."""
    from covariant.report import new_figure, save_figure

    log = sea()
    t, truth = np.asarray(log.record.t), np.asarray(log.record.x)
    errors = sea_errors(log)
    figure, axes = new_figure(3, 1, panel=(8.4, 2.2), titles=("North", "Surge velocity", "Error of surge velocity"))
    y = np.asarray(log.record.y)[:, 0]
    axes[0, 0].plot(t, y, ".", markersize=1.5, color="0.6", label="GNSS, 1 Hz")
    axes[0, 0].plot(t, truth[:, 0], label="ship without wave motion")
    axes[0, 0].set_ylabel("[m]")
    axes[1, 0].plot(t, truth[:, 3], color="0.5", linewidth=2, label="truth")
    for name, error in reversed(errors.items()):
        (line,) = axes[2, 0].plot(t, error[:, 0], linewidth=0.9, label=name)
        axes[1, 0].plot(t, truth[:, 3] + error[:, 0], linewidth=0.9, color=line.get_color(), label=name)
    for ax in axes[:, 0]:
        for begin, end in GAPS:
            ax.axvspan(begin, end, color="0.93", zorder=0)
    for ax in axes[1:, 0]:
        ax.set_ylabel("[m/s]")
    axes[0, 0].legend(fontsize=7, loc="upper left")
    axes[1, 0].legend(fontsize=7, loc="upper left", ncols=2)
    axes[2, 0].set(xlabel="t [s], no GNSS where grey", ylim=(-0.4, 0.4))
    return save_figure(figure, path)


def summary(results: dict[str, Any]) -> list[str | list[dict[str, str]]]:
    """Lines and tables, for a person."""
    ship, odin, three = results["ship"], results["odin"], results["theorem3"]
    c = three["constants"]
    return [
        f"Ship (53): largest real part {ship['eigenvalues']['printed']:+.3f} with K2 as printed in (54), "
        f"{ship['eigenvalues']['corrected']:+.3f} as corrected; Q ≥ αP guarantees {ship['rate']:.2e} 1/s, (47) in SI "
        f"units {ship['printed']:.2e} 1/s, {ship['fitted']:.2e} 1/s was measured",
        "Theorem 2: what the print says, and what happens",
        [
            {
                "system": name,
                "printed Jacobian [1/s]": f"{case['printed']:+.2f}",
                "true error [1/s]": f"{case['true']:+.2f}",
                "proof of contraction": case["proof"],
            }
            for name, case in results["theorem2"].items()
        ],
        "ODIN, observer (101)–(102)",
        [
            {"K2": name, "largest real part at rest [1/s]": f"{value:+.3f}"}
            for name, value in odin["eigenvalues"].items()
        ],
        [{"metric": name, "least rate found [1/s]": f"{rate:.2e}"} for name, rate in odin["sampled"].items()],
        f"Certified rate of squared lengths: {odin['certified']['rate']:g} 1/s ({odin['certified']['verdict']}, "
        f"{odin['certified']['boxes']} boxes) over {odin['certified']['domain']}; measured rates of the errors: "
        f"observer {odin['loop']['observer']:.3f} 1/s, tracking {odin['loop']['tracking']:.3f} 1/s",
        f"On SE(3), turned over its nose: pitch up to {results['somersault']['largest_pitch']:.1f}°, past 80° "
        f"{results['somersault']['times_past_80_degrees']} times; the error of the group's observer falls from "
        f"{results['somersault']['error_first']:.2g} to {results['somersault']['error_last']:.1e}",
        "Theorem 3 on ODIN, K_p = 100, K_d = 200, Λ = 0.5",
        [{name: f"{value:.4g}" for name, value in c.items()}],
        f"(72) as printed: γ1² = {three['gamma1_squared']:.4g}, bound {three['bound']:.4g}: "
        f"{'holds' if three['printed'] else 'fails'}; weighted: {'holds' if three['weighted'] else 'fails'} with "
        f"κ > {three['kappa']:.4g}; in other units as printed: "
        + ", ".join(f"{name} {'holds' if ok else 'fails'}" for name, ok in three["units"].items()),
        f"Dynamic positioning, velocity errors (RMSE) after {SETTLED:g} s",
        sea_rows(results["sea"]),
    ]


def sea_rows(table: dict[str, dict[str, float]]) -> list[dict[str, str]]:
    """Table rows of the comparison at sea."""
    return [
        {
            "estimator": name,
            "surge [m/s]": f"{row['surge']:.4f}",
            "sway [m/s]": f"{row['sway']:.4f}",
            "yaw rate [deg/s]": f"{math.degrees(row['yaw_rate']):.4f}",
            "in the gaps [m/s]": f"{row['gaps']:.4f}",
            "a sample [µs]": f"{row['cost']:.1f}",
        }
        for name, row in table.items()
    ]


def write_page(results: dict[str, Any], figures: tuple[Path, ...], path: Path) -> Path:
    """One page with the tables, the figures and what they show; returns the path."""
    from covariant.report import write_article

    ship, _, theorem2, _, eigen, sampled, certified, turned, _, constants, verdicts, _, table = summary(results)
    return write_article(
        "Jouffroy & Fossen 2004, reproduced",
        [
            "# The ship",
            str(ship) + ".",
            "# Theorem 2",
            "The print differentiates the input's dependence on the estimate. It acts on the plant too, and cancels: "
            "what has to contract is the virtual system, at fixed input and measurement.",
            theorem2,
            "# ODIN under output feedback",
            "K2 = I − K_p makes the true error unstable. A symmetric positive definite K2 makes it converge; but drag "
            "that is quadratic vanishes at rest, so that the metric diag(K2, M) proves no rate there. With a cross "
            "term it does.",
            eigen,
            sampled,
            str(certified) + ".",
            figures[0],
            str(turned) + ".",
            "# Theorem 3",
            constants,
            str(verdicts) + ".",
            "# Dynamic positioning",
            "A supply vessel in waves, pushed by slowly varying forces, its compass at 10 Hz and GNSS at 1 Hz with two "
            "gaps. The filter knows the densities of all noises; the passive observer has constant gains and a proof; "
            "the filtered derivative knows nothing and takes waves for motion.",
            table,
            figures[1],
        ],
        path,
    )
