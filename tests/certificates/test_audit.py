"""The audit passes sound observers, and names the law that a spoiled one breaks."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from covariant import models
from covariant.certificates.audit import LAWS, Audit, audit
from covariant.geometry import AbstractMetric, Euclidean, christoffel, curvature, sphere
from covariant.models import Lagrangian, friction, source
from covariant.observers import (
    EKF,
    AbstractFlowObserver,
    Geodesic,
    Intrinsic,
    MechanicalState,
    Riccati,
    Salcudean,
)
from covariant.papers._errata import SLIPS, PrintedBallAndBeam, PrintedGroup
from covariant.proofs import box

ALPHA, BETA = 1.2, 0.9
FLOW = ("plant", "error", "lyapunov")
GEOMETRY = ("metric", "torsion", "transport", "curvature")
CAP = box(a=(-0.5, 0.5), b=(-0.5, 0.5))


def on_space(space, damping=0.0) -> Lagrangian:
    return Lagrangian(
        space,
        lambda q: 0.4 * q[0] + 0.3 * q[0] * q[1] - 0.2 * q[1] ** 2,
        dissipation=lambda q, v: -damping * v,
        coordinates=("a", "b"),
    )


SPHERE = on_space(sphere(), damping=0.3)
BEAM = models.ball_and_beam()
TOP = models.heavy_top((1.0, 2.0, 3.5), 2.0, viscous=0.2)


MISTAKES = ("curvature sign", "Γ(q) for Γ(q̂)", "no friction", "not a number")


def only(mistake: str, known: tuple[str, ...]) -> Array:
    """Numbers, not names, so that what has one mistake or another is compiled once."""
    return jnp.array([1.0 if name == mistake else 0.0 for name in known])


class Spoiled(AbstractFlowObserver):
    """Observer (5) with one of the `MISTAKES`, or none."""

    model: Lagrangian
    spoil: Array
    alpha: float = ALPHA
    beta: float = BETA

    def init(self, y, t=0.0):
        return MechanicalState(y, jnp.zeros_like(y), jnp.zeros((), y.dtype))

    def estimate(self, state):
        return jnp.concatenate([state.q, state.v])

    def predict(self, state, u, dt):
        raise NotImplementedError

    def correct(self, state, u, y):
        raise NotImplementedError

    def flow(self, t, state, u, y):
        q, v, _ = state
        metric, (sign, place, smooth, lost) = self.model.metric, self.spoil
        xi, s = -self.model.manifold.towards(q, y), source(self.model, t, y, u)
        drive = s - christoffel(metric, y, s, xi) + (1 - 2 * sign) * curvature(metric, y, xi, v, v)
        q_dot = v - self.alpha * xi
        v_dot = drive - self.beta * xi - christoffel(metric, q + place * (y - q), v, q_dot)
        v_dot = v_dot + (1 - smooth) * friction(self.model, t, q, v, u)
        nan = jnp.where((lost > 0) & (jnp.sum(v) > 0), jnp.nan, 1.0)
        return MechanicalState(q_dot, nan * v_dot, jnp.ones(()))


class Bent(AbstractMetric):
    """The sphere with one operation spoiled, that of a law of the geometry."""

    spoil: Array

    def __call__(self, q):
        return sphere()(q)

    def connection(self, q, x, y):
        found = (1 - 0.1 * self.spoil[0]) * sphere().connection(q, x, y)
        return found + 0.1 * self.spoil[1] * x[0] * y[::-1] * jnp.array([1.0, -1.0])

    def curvature(self, q, x, y, z):
        return (1 - 2 * self.spoil[3]) * sphere().curvature(q, x, y, z)

    def transport_along(self, p, velocity, w, budget):
        end = sphere().transport_along(p, velocity, w, budget)
        return end._replace(w=end.w + self.spoil[2] * (w - end.w))

    def shoot(self, p, q, guess, budget):
        return sphere().shoot(p, q, guess, budget)


def row(found: Audit, name: str):
    return {law.name: law for law in found.rows}[name]


@pytest.fixture(scope="module")
def beam() -> Audit:
    return audit(Intrinsic(BEAM, ALPHA, BETA))


@pytest.fixture(scope="module")
def top() -> Audit:
    """With the α of the paper, which is half of ours."""
    return audit(Intrinsic(TOP, ALPHA, BETA))


@pytest.mark.exhaustive
def test_an_intrinsic_observer_keeps_every_law(beam):
    assert beam.passed
    assert tuple(law.name for law in beam.rows) == LAWS
    assert all(law.verdict == "holds" for law in beam.rows)
    assert all(row(beam, name).deviation < 1e-13 for name in (*FLOW, "metric", "torsion", "transport"))
    assert row(beam, "curvature").deviation < 1e-9


@pytest.mark.exhaustive
def test_what_is_found_beside_the_deviations(beam):
    """The curvature −1/(1 + r²)² of the ball and beam, the rate of the gains, and both orders."""
    low, high = (float(text) for text in row(beam, "curvature").detail.split()[-3::2])
    assert -1 / (1 + 0.2**2) ** 2 < low < high < -1 / (1 + 1.2**2) ** 2 + 1e-3
    slowest = np.linalg.inv(solved_by_hand())
    assert row(beam, "lyapunov").detail == f"a rate of {np.linalg.eigvalsh(slowest)[0]:.4g} 1/s where it holds"
    for name in ("invariance", "approximation"):
        assert float(row(beam, name).detail.split()[3].rstrip(",")) == pytest.approx(2.0, abs=0.01)


def solved_by_hand():
    """`[[a, c], [c, b]]` from 2c = −1, 2αa + 2βc = 1, a − αc = βb."""
    a = (1 + BETA) / (2 * ALPHA)
    return np.array([[a, -0.5], [-0.5, (a + ALPHA / 2) / BETA]])


@pytest.mark.exhaustive
def test_the_table_says_what_the_rows_say(beam):
    lines = str(beam).splitlines()
    assert lines[0] == "Intrinsic, α = 1.2 1/s, β = 0.9 1/s²: passed: 9 laws hold"
    assert lines[1] == "24 states, 0.2 ≤ r ≤ 1.2 m, 0.2 ≤ theta ≤ 1.2 rad, velocities to ±3 (seed 0)"
    assert [line.split()[:2] for line in lines[2:]] == [["holds", name] for name in LAWS]
    assert all(len(law.point) == 4 for law in beam.rows)
    assert all(law.source and law.reason for law in beam.rows)


@pytest.mark.exhaustive
def test_a_group_observer_keeps_every_law(top):
    assert top.passed
    skipped = [law for law in top.rows if law.verdict == "skipped"]
    assert [law.name for law in skipped] == ["invariance"]
    assert "without coordinates" in skipped[0].reason
    assert np.isnan(skipped[0].deviation)
    assert all(
        law.deviation < 1e-12 for law in top.rows if law.name not in ("curvature", "invariance", "approximation")
    )
    assert str(top).splitlines()[0] == "Intrinsic, α = 1.2 1/s, β = 0.9 1/s²: passed: 8 laws hold, 1 skipped"


@pytest.mark.exhaustive
def test_the_exact_observer_is_the_same_in_another_chart():
    """A damped oscillator, known in closed form in its own coordinate and numerically in the other."""
    model = Lagrangian(
        Euclidean(), lambda q: q[0] ** 2 / 2, dissipation=lambda q, v: -0.1 * v, coordinates=("q",), units=("m",)
    )
    (law,) = audit(Geodesic(model, ALPHA, BETA), laws=("invariance",)).rows
    assert law.verdict == "holds"
    assert law.deviation < 1e-8


@pytest.mark.exhaustive
def test_the_exact_observer_keeps_the_error_law():
    assert audit(Geodesic(SPHERE, ALPHA, BETA), domain=CAP, laws=FLOW).passed


def test_friction_at_the_estimate_belongs_to_the_observer():
    assert audit(Spoiled(SPHERE, only("none", MISTAKES)), domain=CAP, laws=FLOW).passed
    assert audit(Spoiled(SPHERE, only("no friction", MISTAKES)), domain=CAP, laws=FLOW).broken == FLOW


@pytest.mark.parametrize("mistake", ["curvature sign", "Γ(q) for Γ(q̂)"])
def test_a_mistake_in_the_equations_breaks_the_error_law(mistake):
    found = audit(Spoiled(SPHERE, only(mistake, MISTAKES)), domain=CAP, laws=FLOW)
    assert found.broken == ("error", "lyapunov")
    statement = found.statement
    assert statement.verdict == "fails"
    wrong = [premise.text.partition(":")[0] for premise in statement.hypotheses if premise.verdict == "fails"]
    assert wrong == ["error", "lyapunov"]
    assert row(found, "error").deviation > 1e-2
    assert "worst at (" in row(found, "error").remark


@pytest.mark.exhaustive
def test_coefficients_at_the_wrong_point_depend_on_the_chart():
    found = audit(Spoiled(SPHERE, only("Γ(q) for Γ(q̂)", MISTAKES)), domain=CAP, laws=("invariance",))
    assert found.broken == ("invariance",)
    assert "of order 1.0" in found.rows[0].detail


@pytest.mark.long
def test_without_the_curvature_term_the_observer_is_not_the_exact_one_to_first_order():
    found = audit(Intrinsic(SPHERE, ALPHA, BETA, curvature=False), domain=CAP, laws=(*FLOW, "approximation"))
    assert found.broken == ("error", "lyapunov", "approximation")
    assert "of order 1.0" in row(found, "approximation").detail


def test_a_deviation_that_is_not_a_number_breaks_the_law():
    found = audit(Spoiled(SPHERE, only("not a number", MISTAKES)), domain=CAP, laws=FLOW)
    assert found.broken == FLOW
    assert np.isnan(row(found, "error").deviation)
    assert sum(row(found, "error").point[2:]) > 0


@pytest.mark.long("")
@pytest.mark.parametrize("sign", [1, -1])
def test_the_printed_ball_and_beam(sign):
    """Equation (14) as printed breaks the law; with the sign of (5) it keeps it."""
    found = audit(PrintedBallAndBeam(ALPHA, BETA, sign), model=BEAM, laws=(*FLOW, "invariance"))
    assert found.broken == (("error", "lyapunov") if sign > 0 else ())
    assert "no model" in row(found, "invariance").reason


@pytest.mark.exhaustive("alpha", "none", "source")
@pytest.mark.long
@pytest.mark.parametrize("slip", ["none", *SLIPS])
def test_each_slip_of_the_printed_group_observer(slip):
    """Their α is half of ours. A wrong source leaves the error law alone, but not the plant."""
    printed = PrintedGroup(TOP, ALPHA / 2, BETA, () if slip == "none" else (slip,))
    found = audit(printed, gains=(ALPHA, BETA), laws=FLOW)
    broken = {"none": (), "source": ("plant",)}.get(slip, ("error", "lyapunov"))
    assert found.broken == broken


@pytest.mark.long("metric")
@pytest.mark.parametrize("mistake", GEOMETRY)
def test_each_law_of_the_geometry_sees_its_own_mistake(mistake):
    bent = eqx.tree_at(lambda m: m.metric, SPHERE, Bent(only(mistake, GEOMETRY)))
    found = audit(Intrinsic(bent, ALPHA, BETA), domain=CAP, laws=GEOMETRY)
    # The geodesics are those of the sphere whatever is spoiled; vectors that are not carried are seen in them too.
    assert found.broken == ((mistake, "curvature") if mistake == "transport" else (mistake,))


@pytest.mark.exhaustive
def test_the_states_are_those_asked_for(beam):
    found = audit(
        Intrinsic(BEAM, ALPHA, BETA), domain=box(theta=(0.3, 0.4)), speed=0.5, seed=3, laws=("plant", "error")
    )
    assert found.domain == "24 states, 0.2 ≤ r ≤ 1.2 m, 0.3 ≤ theta ≤ 0.4 rad, velocities to ±0.5 (seed 3)"
    for law in found.rows:
        assert 0.3 <= law.point[1] <= 0.4
        assert np.abs(law.point[2:]).max() <= 0.5


def test_angles_go_around_the_circle():
    found = audit(Intrinsic(models.pendulum_chain((1.0,), (0.5,)), ALPHA, BETA), points=2, laws=())
    assert "-3.142 ≤ q1 ≤ 3.142 rad" in found.domain
    assert found.rows == ()


@pytest.mark.parametrize(
    ("observer", "options", "message"),
    [
        (EKF(BEAM, jnp.eye(2), jnp.eye(2)), {}, "EKF is no differential equation"),
        (Salcudean(TOP, 1.0, 1.0), {}, "Salcudean has no gains"),
        (Riccati(models.lorenz(), lambda x: jnp.eye(3), jnp.ones(3)), {}, "mechanical system"),
        (PrintedBallAndBeam(ALPHA, BETA), {}, "no model of its own; give model="),
        (eqx.tree_at(lambda o: o.alpha, Intrinsic(BEAM, ALPHA, BETA), -1.0), {}, "gains must be positive"),
        (Intrinsic(BEAM, ALPHA, BETA), {"gains": (ALPHA, 0.0)}, "gains must be positive"),
        (
            Intrinsic(BEAM, ALPHA, BETA),
            {"laws": ("eror",)},
            r"law 'eror'\. Did you mean 'error'\? Known: plant",
        ),
        (Intrinsic(BEAM, ALPHA, BETA), {"points": 0}, "points, speed and error must be positive"),
        (
            Intrinsic(BEAM, ALPHA, BETA),
            {"domain": box(x=(0.0, 1.0))},
            "unknown coordinate 'x'. Known: r, theta",
        ),
        (Intrinsic(Lagrangian(sphere(), jnp.sum), ALPHA, BETA), {}, "does not name its coordinates"),
        (Intrinsic(models.oscillator("r"), ALPHA, BETA), {"domain": box(r=(-2.0, -1.0))}, "only 0 of 384"),
    ],
)
def test_what_cannot_be_audited_is_refused(observer, options, message):
    with pytest.raises(ValueError, match=message):
        audit(observer, **options)


@pytest.mark.long
def test_a_second_audit_traces_nothing_again():
    calls = []

    def metric(q):
        calls.append(q)
        return jnp.eye(1, dtype=q.dtype)

    observer = Intrinsic(Lagrangian(metric, lambda q: q[0], coordinates=("q",)), ALPHA, BETA)
    audit(observer, laws=("plant",), points=3)
    traced = len(calls)
    audit(observer, laws=("plant",), points=3, seed=1)
    assert 0 < len(calls) == traced
