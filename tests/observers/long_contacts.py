"""What takes long of `test_contacts.py`."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_contacts import ALPHA, BETA, LEG, error, held, lift_off, touch_down

import covariant
from covariant import engine, models, observers
from covariant._linalg import solve
from covariant.signals import Record, StepCode
from covariant.simulation import simulate_contacts

STEP = 1e-25


class Oracle:
    """The leg by its points of mass, scaled by the roots of their masses; functions take complex numbers."""

    roots = np.sqrt(np.array([4.0, 1.0, 0.4]))
    turning = np.sqrt(np.array([0.01, 0.004]))
    arms = np.array([[0.0, 0.0], [0.15, 0.0], [0.3, 0.15]])
    foot = np.array([0.3, 0.3])
    rates = np.array([[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 1.0, 1.0]])

    def slope(self, q, arm):
        """Derivative (2, 4) of a point at the end of two arms."""
        a = self.rates @ q
        links = np.stack([np.cos(a) * arm, np.sin(a) * arm]) @ self.rates
        return links + np.eye(4)[:2]

    def second(self, q, x, y, arm):
        a, k = self.rates @ q, (self.rates @ x) * (self.rates @ y)
        return np.array([-np.sin(a) @ (arm * k), np.cos(a) @ (arm * k)])

    def at(self, q):
        """Slope of all scaled points, inverse of the inertia, rows of the foot, A⁺."""
        points = [r * self.slope(q, arm) for r, arm in zip(self.roots, self.arms, strict=True)]
        slope = np.vstack([*points, self.turning[:, None] * self.rates])
        inverse, rows = np.linalg.inv(slope.T @ slope), self.slope(q, self.foot)
        raised = inverse @ rows.T
        return slope, inverse, rows, raised @ np.linalg.inv(rows @ raised)

    def free(self, q, x, y):
        slope, inverse, _, _ = self.at(q)
        points = [r * self.second(q, x, y, arm) for r, arm in zip(self.roots, self.arms, strict=True)]
        return inverse @ slope.T @ np.concatenate([*points, np.zeros(2)])

    def projected(self, q, a):
        _, _, rows, back = self.at(q)
        return a - back @ (rows @ a)

    def held(self, q, x, y):
        _, _, rows, back = self.at(q)
        a = self.free(q, x, y)
        return a - back @ (rows @ a - self.second(q, x, y, self.foot))

    def touch(self, q, v, spot):
        p = q
        for _ in range(3):
            a = self.rates @ p
            at = p[:2] + np.array([self.foot @ np.sin(a), -self.foot @ np.cos(a)])
            p = p - self.at(p)[3] @ (at - spot)
        return p, self.projected(p, v - self.free(q, p - q, v))


def spot_of(q):
    return np.asarray(LEG.feet(jnp.asarray(q)))[0]


@functools.cache
def states():
    """Two hundred motions at the instant of an impact, and errors of position and velocity in the parallel frame."""
    random = np.random.default_rng(1)
    angles = np.array([0.6, -1.2]) + 0.4 * random.normal(size=(200, 2))
    q = np.concatenate([random.normal(size=(200, 2)), angles], axis=1)
    return q, np.array([0.5, -1.5, 1.0, 2.0]) * random.normal(size=(200, 4)), *random.normal(size=(2, 200, 4))


def shape_operator(leaf, q, lost, a):
    """S a, with `<S a, b> = <II(a, b), n>` for the velocity n that is lost."""
    axes = jnp.eye(4)
    return leaf.raise_(q, jax.vmap(lambda b: leaf.inner(q, leaf.second_form(q, a, leaf.projected(q, b)), lost))(axes))


@jax.jit
@jax.vmap
def formulas(q, v, xi, zeta):
    leaf = held(q)
    lost, along, rate = v - leaf.projected(q, v), leaf.projected(q, xi), leaf.projected(q, zeta)
    after = leaf.projected(q, v)
    touch = rate + shape_operator(leaf, q, lost, along)
    return along, touch, rate + leaf.second_form(q, along, after)


@pytest.mark.exhaustive
def test_both_jumps_are_those_of_their_formulas():
    oracle, given = Oracle(), states()
    along, touch, lift = map(np.asarray, formulas(*map(jnp.asarray, given)))
    worst = 0.0
    for k, (q, v, xi, zeta) in enumerate(zip(*given, strict=True)):
        change = zeta - oracle.free(q, v, xi)
        p, w = oracle.touch(q + 1j * STEP * xi, v + 1j * STEP * change, spot_of(q))
        displaced, rate, w = p.imag / STEP, w.imag / STEP, w.real
        worst = max(worst, np.abs(displaced - along[k]).max())
        worst = max(worst, np.abs(rate + oracle.held(q, w, displaced) - touch[k]).max())
        # At a lift-off the motion stays, and the frame changes from that of the leaf to that of the whole space.
        x, z = oracle.projected(q, xi), oracle.projected(q, zeta)
        worst = max(worst, np.abs(z - oracle.held(q, w, x) + oracle.free(q, w, x) - lift[k]).max())
    assert worst < 1e-10
    assert np.abs(touch - np.asarray(formulas(*given[:2], 0 * given[2], given[3])[1])).max() > 1  # S is not small


@functools.cache
def hops():
    """A leg that hops four times, on torques towards one posture in the air and another one on the ground."""

    def torques(s, x, down):
        towards = jnp.where(down[0], jnp.array([0.4, -0.8]), jnp.array([0.6, -1.2]))
        return jnp.where(down[0], 100.0, 30.0) * (towards - x.q[2:]) - x.v[2:]

    start = models.Motion(jnp.array([0.0, 0.62, 0.6, -1.2]), jnp.array([0.3, 0.0, 0.0, 0.0]))
    return Record(*map(np.asarray, simulate_contacts(LEG, start, jnp.arange(0.0, 1.3, 1e-3), torques)))


def events(contact):
    change = np.diff(contact, prepend=0.0)
    return np.flatnonzero(change > 0), np.flatnonzero(change < 0)


OBSERVER = observers.Contacts(observers.Intrinsic(LEG, ALPHA, BETA, order=2, substeps=1))


def ran(record, observer=OBSERVER):
    return np.asarray(engine.run_log(observer, record, engine="c")[0].estimate)


@jax.jit
def error_after(x, estimate):
    """Errors before and after the jump of an estimate alone; the motion is on the ground."""
    leaf = held(x[:4])
    return error(LEG.space, x, estimate), error(leaf, x, jnp.concatenate(leaf.impact(*jnp.split(estimate, 2))))


@pytest.mark.exhaustive
def test_errors_grow_by_a_tenth_at_most_in_every_event():
    """Small errors of all directions, begun anew before each event."""
    record, random = hops(), np.random.default_rng(0)
    down, up = events(record.u[:, 2])
    assert len(down) >= 8
    for rows, jump in ((down, touch_down), (up, lift_off)):
        x = np.repeat(record.x[rows], 20, axis=0)
        offset = 1e-4 * random.normal(size=x.shape) * np.array([0.05] * 4 + [1.0] * 4)
        if jump is lift_off:  # on the ground an error is along the leaf
            along = jax.jit(jax.vmap(lambda q, a: held(q).projected(q, a)))
            offset[:, :4] = along(x[:, :4], offset[:, :4])
            q, v = jax.vmap(lambda q, p, w: held(q).impact(p, w))(x[:, :4], x[:, :4] + offset[:, :4], x[:, 4:])
            offset = np.concatenate([q, v + along(np.asarray(q), offset[:, 4:])], axis=1) - x
        before, after, *_ = map(np.asarray, jump(x, x + offset))
        assert (after < 1.1 * before).all()


@pytest.mark.exhaustive
def test_an_error_of_the_start_vanishes_over_the_events():
    record = hops()
    wrong = record._replace(y=record.x[:, :4].copy())
    wrong.y[0] += np.array([0.01, -0.01, 0.02, 0.02])
    off = np.abs(ran(wrong) - record.x)[:, 4:].max(axis=1)
    assert off[:100].max() > 0.3
    assert off[600:].max() < 0.01


@pytest.mark.exhaustive
def test_a_contact_that_is_known_late_costs_little():
    record = hops()
    landed = next(row for row in events(record.u[:, 2])[0] if record.t[row] > 0.8)
    truth = record.x[landed][None]
    lost = float(touch_down(truth, truth)[2][0])
    assert lost > 0.8
    for late in (1, 2, 4):
        u, row = record.u.copy(), landed + late
        u[landed:row, 2] = 0.0
        # The state before the jump that the input of this row asks for, and the truth, which is on the ground.
        estimate = ran(record._replace(u=u, y=record.x[:, :4]))[row]
        before, after = map(float, error_after(record.x[row], estimate))
        assert before > lost / 2  # what the error is without a jump
        assert after < 3.0 * lost * 1e-3 * late


@pytest.mark.exhaustive
def test_c_is_the_python_run_over_touch_downs():
    record = hops()
    noisy = record._replace(y=record.x[:, :4] + 1e-3 * np.random.default_rng(0).normal(size=(len(record.t), 4)))
    part = Record(*(np.asarray(each)[:700] for each in noisy[:3]))
    np.testing.assert_allclose(ran(part), observers.run(OBSERVER, part).estimate, atol=1e-9)


@pytest.mark.exhaustive
def test_the_covariance_of_a_filter_takes_the_jumps_of_the_errors():
    kalman = observers.Contacts(observers.IntrinsicKalman(LEG, 1e-3, 1e-6, 1.0))
    q, v, *_ = (jnp.asarray(each[0]) for each in states())
    leaf, axes = held(q), jnp.eye(4)

    @jax.jit
    def maps(q, v):
        tangent = leaf.projected(q, v)
        touch = kalman._of_errors(LEG.space, leaf, models.Motion(q, v))(jnp.eye(8))
        lift = kalman._of_errors(
            leaf, models.standing(LEG, jnp.array([False]), LEG.feet(q)).space, models.Motion(q, tangent)
        )
        along = jax.vmap(lambda a: leaf.projected(q, a), out_axes=1)(axes)
        shape = jax.vmap(lambda a: shape_operator(leaf, q, v - tangent, leaf.projected(q, a)), out_axes=1)(axes)
        bend = jax.vmap(lambda a: leaf.second_form(q, leaf.projected(q, a), tangent), out_axes=1)(axes)
        return touch, lift(jnp.eye(8)), along, shape, bend

    touch, lift, along, shape, bend = map(np.asarray, maps(q, v))
    none = np.zeros((4, 4))
    np.testing.assert_allclose(touch, np.block([[along, none], [shape, along]]), atol=1e-10)
    on_leaf = np.block([[along, none], [none, along]])
    np.testing.assert_allclose(lift @ on_leaf, np.block([[along, none], [bend, along]]), atol=1e-10)


@pytest.mark.exhaustive
def test_a_filter_is_as_good_as_it_says_through_steps():
    """The torques have white noise of which the filter knows the size; the velocity's errors are in its deviations."""
    random, rows, noise = np.random.default_rng(0), 1300, 1e-4

    @jax.jit
    def hop(pushes):
        def torques(s, x, down):
            towards = jnp.where(down[0], jnp.array([0.4, -0.8]), jnp.array([0.6, -1.2]))
            push = pushes[jnp.round(1e3 * s).astype(int)]
            return jnp.where(down[0], 100.0, 30.0) * (towards - x.q[2:]) - x.v[2:] + push

        start = models.Motion(jnp.array([0.0, 0.62, 0.6, -1.2]), jnp.array([0.3, 0.0, 0.0, 0.0]))
        return simulate_contacts(LEG, start, jnp.arange(0.0, rows) / 1e3, torques)

    def pushed(q):
        joints = solve(LEG.space(q), jnp.eye(4)[:, 2:])
        return 1e-3 * joints @ joints.T + 1e-10 * jnp.eye(4)

    kalman = observers.IntrinsicKalman(LEG, pushed, noise**2 * jnp.eye(4), 4.0, substeps=1, gate=None)
    squares, nis = [], []
    for _ in range(12):
        pushes = random.normal(size=(rows, 2))
        truth = Record(*map(np.asarray, hop(jnp.asarray(pushes))))
        u, y = truth.u.copy(), truth.y + noise * random.normal(size=truth.y.shape)
        u[:, :2] -= pushes
        run, _ = engine.run_log(observers.Contacts(kalman), Record(truth.t, u, y), engine="c")
        squares.append((((run.estimate - truth.x)[:, 4:] / run.info.velocity_std) ** 2)[200:])
        nis.append(run.info.nis[200:])
    assert (np.abs(np.mean(squares, axis=(0, 1)) - 1) < 0.15).all()
    assert abs(np.mean(nis) / 4 - 1) < 0.05


@pytest.mark.exhaustive
def test_a_log_has_a_column_of_contacts(tmp_path):
    """As a file of a model says it: the observer of a model with feet goes through its contacts."""
    model = tmp_path / "leg.toml"
    model.write_text(
        'system = "hopping_leg"\n[columns]\nq = ["x", "z", "hip", "knee"]\nu = ["tau_hip", "tau_knee", "foot"]\n'
    )
    record = hops()
    part = Record(record.t[:700], record.u[:700], record.x[:700, :4])
    result = covariant.estimate(model, part, alpha=60.0, beta=1800.0)
    assert np.abs(result.velocity - record.x[:700, 4:])[400:].max() < 0.01
    with pytest.raises(ValueError, match="has feet: no certificate covers impacts"):
        covariant.certify(model, velocity=1.0, error=0.1, alpha=60.0, beta=1800.0)


@pytest.mark.exhaustive
def test_a_missing_position_in_the_air_is_coasted_as_without_contacts():
    """On no leaf nothing tells of it, and nothing is refused."""
    leg = models.hopping_leg()
    observer = observers.Contacts(observers.ModelCopy(leg, 20.0, 200.0, substeps=1))
    q = jnp.array([0.0, 0.6, 0.5, -1.0])
    step = jax.jit(lambda y: observer.step(observer.init(q), jnp.zeros(3), y, jnp.asarray(0.01))[1].result)
    assert int(step(q)) == StepCode.OK
    assert int(step(q.at[3].set(jnp.nan))) == StepCode.COASTED
