"""The likelihood of logs is that of a plainly written Kalman filter, and its derivatives are those of its values."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from covariant import models
from covariant.calibration.identification import (
    ErrorModel,
    NoiseLevels,
    Rows,
    Unknowns,
    _likelihood as likelihoods,
    error_model,
    from_later,
    gather,
    held_out_rows,
    kalman,
    total_loss,
)
from covariant.calibration.identification._error_model import Walk
from covariant.calibration.identification._likelihood import Likelihood, logarithms
from covariant.signals import Record

STIFFNESS, VISCOUS, GAIN, LOAD = 4.0, 0.3, 1.5, 0.4
NUMBERS = np.array([STIFFNESS, VISCOUS, GAIN, LOAD])
NOISE = NoiseLevels(jnp.array(0.05), jnp.array([2e-3]), jnp.array([0.2]), 0.3)


def mass(q, one):
    return one * jnp.eye(1)


def energy(q, stiffness, load):
    return stiffness * q[0] ** 2 / 2 - load * q[0]


def drive(t, q, u, gain):
    return gain * u


def friction(q, v, viscous):
    return -viscous * v


def oscillator(values) -> tuple[models.Lagrangian, float]:
    """A unit mass on a spring with friction, a drive and a constant load; and no lag of its inputs."""
    stiffness, viscous, gain, load = values
    model = models.Lagrangian(
        models.Parametric(mass, one=1.0),
        models.Parametric(energy, stiffness=stiffness, load=load),
        models.Parametric(drive, gain=gain),
        models.Parametric(friction, viscous=viscous),
        coordinates=("q",),
    )
    return model, 0.0


def unknowns(free: tuple[bool, ...] = (True, True, True, False)) -> Unknowns:
    manifold = oscillator(NUMBERS)[0].manifold
    return Unknowns(oscillator, jnp.asarray(NUMBERS), free, jnp.arange(4)[None], manifold)


class Swing(NamedTuple):
    """A log of the oscillator, with its true velocities (T,)."""

    record: Record
    velocity: np.ndarray


def swing(seed: int = 0, rows: int = 500, jitter: float = 0.3) -> Swing:
    """A driven oscillator with uneven stamps, a Gauss–Markov force, single missing rows, a hole and a gap."""
    rng = np.random.default_rng(seed)
    dt = 0.02 * (1 + jitter * rng.uniform(-1, 1, rows))
    dt[rows // 2] = 0.5  # a gap in the stamps, after which a stretch begins
    t = np.concatenate([[0.0], np.cumsum(dt)])[:-1]
    u = np.sin(2.1 * t) + np.sin(5.3 * t)
    x, force, path = np.array([0.5, 0.0]), 0.0, []
    for k in range(rows):
        path.append(x)
        system = np.zeros((3, 3))
        system[:2] = [[0, 1, 0], [-STIFFNESS, -VISCOUS, GAIN * u[k] + LOAD + force]]
        x = (expm(system * dt[k]) @ [*x, 1.0])[:2]
        decay = np.exp(-dt[k] / 0.3)
        force = decay * force + 0.2 * np.sqrt(1 - decay**2) * rng.normal()
    q, v = np.array(path).T
    y = q + 2e-3 * rng.normal(size=rows)
    y[rng.choice(np.arange(1, rows // 2), 20, replace=False)] = np.nan
    y[120:140] = np.nan
    return Swing(Record(t, u[:, None], y[:, None]), v)


def rows_of(log: Swing) -> Rows:
    rows = gather(oscillator(NUMBERS)[0].manifold, [log.record], [log.velocity[:, None]])
    return jax.tree.map(jnp.asarray, rows)


def problem(log: Swing, noise: NoiseLevels = NOISE, numbers: Unknowns | None = None) -> Likelihood:
    return Likelihood(numbers or unknowns(), rows_of(log), jnp.asarray(4), noise, jnp.asarray(5.0))


class Innovations(NamedTuple):
    """Innovations (T,) of a filter and their standard deviations; NaN where nothing was read."""

    innovation: np.ndarray
    std: np.ndarray


def plain_filter(log: Swing, values: np.ndarray, noise: NoiseLevels, speed: float) -> Innovations:
    """The textbook filter of position, velocity and force, with a force that is constant over a step, at its mean."""
    stiffness, viscous, gain, load = values
    t, u, y = (np.asarray(each) for each in log.record[:3])
    white, std, size, time = (float(np.squeeze(np.asarray(each))) for each in noise[:4])
    usual, fresh = np.median(np.diff(t)), True
    innovations, stds = np.full((2, len(t)), np.nan)
    x = cov = None
    for k in range(len(t)):
        h = t[k] - t[k - 1] if k else 0.0
        fresh = k == 0 or h > 5 * usual
        if fresh:
            # The prior of a stretch: the reading within a hundred of its deviations, and the velocity of the reference.
            x = np.array([y[k, 0], log.velocity[k], 0.0])
            cov = np.diag([(100 * std) ** 2, speed**2, size**2])
        else:
            generator = np.zeros((3, 3))
            generator[:2] = [[0, 1, 0], [-stiffness, -viscous, gain * u[k - 1, 0] + load]]
            exact = expm(generator * h)
            decay = np.exp(-h / time)
            mean = time / h * (1 - decay)
            transition = np.zeros((3, 3))
            transition[:2, :2], transition[2, 2] = exact[:2, :2], decay
            generator[:2, 2] = 0.0, 1.0
            transition[:2, 2] = mean * expm(generator * h)[:2, 2]
            x = transition @ x + [*exact[:2, 2], 0.0]
            added = np.diag([0.0, 0.0, size**2 * (1 - decay**2)])
            # Van Loan 1978: white noise over a step, by one exponential.
            rates, noisy = generator[:2, :2], np.diag([0.0, white**2])
            both = expm(h * np.block([[-rates, noisy], [np.zeros((2, 2)), rates.T]]))
            added[:2, :2] = both[2:, 2:].T @ both[:2, 2:]
            cov = transition @ cov @ transition.T + added
        if np.isnan(y[k, 0]):
            continue
        variance = cov[0, 0] + std**2
        innovations[k], stds[k] = y[k, 0] - x[0], np.sqrt(variance)
        gains = cov[:, 0] / variance
        x, cov = x + gains * innovations[k], cov - np.outer(gains, cov[0])
    return Innovations(innovations, stds)


def pseudo_huber(e: np.ndarray) -> np.ndarray:
    """Half the square of a small e, and three times the size of a large one."""
    return 9 * (np.sqrt(1 + (e / 3) ** 2) - 1)


@pytest.mark.parametrize("z", [np.zeros(4), np.array([0.05, -0.3, 0.02, 0.1])])
def test_the_loss_is_that_of_a_plain_filter_through_holes_and_uneven_stamps(z):
    log = swing()
    numbers = unknowns()
    expected = plain_filter(log, np.asarray(numbers.values(jnp.asarray(z))), NOISE, 5.0)
    seen = np.isfinite(expected.innovation)
    e = expected.innovation[seen] / expected.std[seen]
    assert 0.5 < np.std(e) < 5
    assert np.abs(e).max() < 5, "none is an outlier to the filter"
    blocks = problem(log).blocks(z)
    np.testing.assert_allclose(np.sum(blocks.loss), np.sum(pseudo_huber(e) + np.log(expected.std[seen])), rtol=3e-6)
    # Noise is judged by the Gaussian likelihood of the same innovations, twice its negative logarithm.
    loss, _ = total_loss(logarithms(NOISE, 1, 1), [blocks.rest.system], None, jnp.asarray(5.0), 100.0)
    np.testing.assert_allclose(loss, np.sum(e**2 + 2 * np.log(expected.std[seen])), rtol=3e-6)


def test_a_number_that_walks_is_as_a_force_that_does():
    """The load is a force: its walk and that of an unknown force of the same size have the same likelihood."""
    log, drift = swing(), 0.3
    walking = dataclasses.replace(unknowns(), walks=(Walk(3, drift, drift),))
    force = NOISE._replace(force=jnp.array([drift * LOAD]), force_time=jnp.inf)
    as_force = problem(log, force).blocks(np.zeros(4))
    as_number = problem(log, NOISE._replace(force=jnp.zeros(1)), walking).blocks(np.zeros(4))
    np.testing.assert_allclose(np.sum(as_number.loss), np.sum(as_force.loss), rtol=1e-6)
    np.testing.assert_allclose(np.sum(as_number.z, axis=0)[:3], np.sum(as_force.z, axis=0)[:3], rtol=1e-3)
    # From the rows after each they are estimated alike too.
    late = [
        from_later(each.rest.system, noise, jnp.asarray(5.0))
        for each, noise in ((as_force, force), (as_number, NOISE._replace(force=jnp.zeros(1))))
    ]
    np.testing.assert_allclose(late[1][1][20:-20], late[0][1][20:-20], rtol=1e-3)
    assert np.sum(problem(log, NOISE._replace(force=jnp.zeros(1))).blocks(np.zeros(4)).loss) > np.sum(as_force.loss) + 9


def test_noise_without_wiggles_or_forces_searches_the_other_kinds():
    likelihood = problem(swing())
    kept = likelihood.blocks(np.zeros(4)).rest
    bounds = np.repeat(np.log([[1e-6, 10.0]]), 6, axis=0)
    names = ("acceleration", "measurement", "force", "force_time", "wiggle")
    full, without_wiggle, quiet = (
        {
            name: float(np.squeeze(getattr(likelihood.likelier(kept, bounds, 3, without)[0].noise, name)))
            for name in names
        }
        for without in ((), ("wiggle",), ("wiggle", "forces"))
    )
    assert min(full.values()) > 1e-7
    assert without_wiggle["wiggle"] < 1e-11 < min(without_wiggle[name] for name in names[:4])
    assert max(quiet["acceleration"], quiet["force"], quiet["wiggle"]) < 1e-11 < quiet["measurement"]


def loss_and_score(likelihood: Likelihood, z: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    blocks = likelihood.blocks(z)
    return float(np.sum(blocks.loss)), np.sum(blocks.z, axis=0), blocks.information


def check_derivatives(likelihood: Likelihood, z: np.ndarray, held: np.ndarray) -> None:
    """The score and the information of the numbers that are not held against central differences."""
    free = np.flatnonzero(~held)
    _, score, information = loss_and_score(likelihood, z)
    step = 1e-4
    ends = [[loss_and_score(likelihood, z + way * step * np.eye(4)[j]) for way in (1, -1)] for j in free]
    slope = np.array([(up[0] - down[0]) / (2 * step) for up, down in ends])
    curvature = np.array([(up[1] - down[1])[free] / (2 * step) for up, down in ends])
    # The information is that of Gauss and Newton: it leaves out that the values are exp and sinh of the unknowns.
    bends = np.where(np.asarray(likelihood.unknowns.positive), 1.0, np.tanh(z)) * score
    size = np.sqrt(np.diagonal(information))[free]
    np.testing.assert_allclose(score[free] / size, slope / size, atol=1e-4)
    both = (each / np.outer(size, size) for each in (curvature - np.diag(bends[free]), information[np.ix_(free, free)]))
    np.testing.assert_allclose(*both, atol=1e-4)


THROUGH_GAINS = np.array([True, True, False, False])
"""Stiffness and friction change the transition, and so the gains of the filter; drive and load are forces alone."""


def beside_the_truth() -> tuple[Likelihood, np.ndarray]:
    return problem(swing()), np.array([0.02, 0.1, 0.01, 0.03])


def test_score_and_information_are_derivatives_of_the_loss():
    likelihood, z = beside_the_truth()
    check_derivatives(likelihood, z, THROUGH_GAINS)


def test_score_of_numbers_that_change_the_gains_is_right_within_a_fraction_of_the_standard_errors():
    """Stiffness and friction change the gains too, which the score takes as given: this is nothing on average."""
    likelihood, z = beside_the_truth()
    blocks = likelihood.blocks(z)
    score, size = np.sum(blocks.z, axis=0), np.sqrt(np.diagonal(blocks.information))
    for j in np.flatnonzero(THROUGH_GAINS):
        up, down = (loss_and_score(likelihood, z + way * 1e-4 * np.eye(4)[j])[0] for way in (1, -1))
        assert abs(score[j] - (up - down) / 2e-4) < 0.3 * size[j]


def test_slopes_of_the_wrong_sign_would_be_seen():
    class Wrong(Unknowns):
        def linearised(self, z, run, rows, steps):
            system = super().linearised(z, run, rows, steps)
            return system._replace(slopes=-system.slopes)

    likelihood, z = beside_the_truth()
    likelihood = likelihood._replace(unknowns=Wrong(**vars(likelihood.unknowns)))
    with pytest.raises(AssertionError):
        check_derivatives(likelihood, z, THROUGH_GAINS)


def test_what_readings_are_off_together_is_a_process_of_its_own():
    """Against the density of all readings at once: a mass that drifts freely, read with an error that is forgotten."""
    rng, count, h, time = np.random.default_rng(2), 25, 0.1, 0.3
    step, noise, size, white = np.array([[1.0, h], [0.0, 1.0]]), 0.02, 0.5, 0.7
    residual = 0.4 * rng.normal(size=count)
    system = ErrorModel(
        jnp.asarray(np.tile(step, (count, 1, 1))),
        jnp.zeros((count, 2)),
        jnp.zeros((count, 2, 0)),
        jnp.tile(jnp.array([[0.0], [1.0]]), (count, 1, 1)),
        jnp.tile(jnp.array([False, True]), (count, 1)),
        *jnp.zeros((2, count, 2)),
        jnp.tile(jnp.eye(1, 2), (count, 1, 1)),
        jnp.zeros((count, 1, 0)),
        jnp.asarray(residual[:, None]),
        jnp.ones((count, 1), bool),
        jnp.full(count, h),
        jnp.arange(count) == 0,
    )
    levels = NoiseLevels(*map(jnp.asarray, (white, [noise], 0.0, np.inf, [size], time)))
    added = white**2 * np.array([[h**3 / 3, h**2 / 2], [h**2 / 2, h]])
    cov = np.zeros((count, 2, count, 2))
    now = np.diag([noise**2, 4.0])
    for k in range(count):
        now = step @ now @ step.T + added if k else now
        for i, part in enumerate(np.linalg.matrix_power(step, j) @ now for j in range(count - k)):
            cov[k + i, :, k] = part
            cov[k, :, k + i] = part.T
    lag = h * np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    whole = cov[:, 0, :, 0] + size**2 * np.exp(-lag / time) + noise**2 * np.eye(count)
    expected = np.linalg.slogdet(whole)[1] + residual @ np.linalg.solve(whole, residual)
    np.testing.assert_allclose(jnp.sum(kalman(system, levels, 2.0).loss), expected, rtol=1e-9)


@pytest.mark.parametrize("readings", [11, 12])
def test_few_rows_are_no_judge(readings):
    t = np.arange(0.0, 10.0, 0.02)
    y = np.cos(t)[:, None]
    y[np.flatnonzero(t >= t[-1] * 2 / 3)[readings:]] = np.nan
    rows = gather(models.oscillator().manifold, [Record(t, np.zeros((500, 1)), y)], [-np.sin(t)[:, None]])
    if readings >= 12:
        assert held_out_rows(rows, [t], np.zeros(1, bool)).any()
        return
    with pytest.raises(ValueError, match="11 rows with all positions"):
        held_out_rows(rows, [t], np.zeros(1, bool))


def test_noise_of_readings_is_seen_however_slow_the_motion_is():
    """Where it is taken for less, a search takes the rest for friction."""
    rng, t = np.random.default_rng(0), np.arange(3000) * 0.01
    for std, every in ((1e-4, 1), (0.05, 1), (0.05, 2), (0.05, 3)):
        y = np.sin(2 * t) + std * rng.normal(size=len(t))
        y[np.arange(len(t)) % every > 0] = np.nan  # positions come at fewer rows than inputs
        manifold = oscillator(NUMBERS)[0].manifold
        rows = gather(manifold, [Record(t, np.zeros((3000, 1)), y[:, None])], [2 * np.cos(2 * t)[:, None]])
        system = error_model(unknowns(), jnp.zeros(4), rows.start, rows, jnp.asarray(1))
        noise, _ = likelihoods.first_noise(unknowns(), rows, system, None)
        np.testing.assert_allclose(noise.measurement, std, rtol=0.15)
