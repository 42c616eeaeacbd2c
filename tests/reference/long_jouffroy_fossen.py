"""Jouffroy & Fossen 2004: the ship with either K2, ODIN under output feedback, Theorem 3, and a log at sea."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant.certificates import contraction, crossed_metric, feedthrough, virtual
from covariant.models import marine
from covariant.papers import jouffroy_fossen as paper
from covariant.report import write_article
from covariant.simulation import Backstepping, follow


@pytest.fixture(scope="module")
def steps():
    """What was reported of the progress."""
    return []


@pytest.fixture(scope="module")
def reproduced(steps):
    return paper.reproduce(steps.append)


@pytest.mark.exhaustive
def test_each_step_is_reported_once(reproduced, steps):
    assert len(steps) == len(set(steps)) == paper.STAGES


@pytest.mark.exhaustive
def test_printed_gain_of_the_ship_is_unstable_and_the_corrected_one_is_not(reproduced):
    found = reproduced["ship"]["eigenvalues"]
    assert found["printed"] == pytest.approx(0.60, abs=0.01)
    assert found["corrected"] == pytest.approx(-0.52, abs=0.01)


@pytest.mark.exhaustive
def test_ship_obeys_the_rate_of_its_lyapunov_function(reproduced):
    found = paper.ship_decay()
    bound = np.exp(-2 * found["rate"] * found["t"]) * found["lyapunov"][0]
    assert (found["lyapunov"] <= bound * (1 + 1e-9)).all()
    assert found["fitted"] >= found["rate"] >= found["printed"] > 0
    assert reproduced["ship"]["fitted"] >= reproduced["ship"]["rate"] > 0


@pytest.mark.exhaustive
def test_theorem_2_as_printed_says_the_opposite(reproduced):
    for case in reproduced["theorem2"].values():
        assert (case["printed"] < 0) != (case["true"] < 0)
        assert case["proof"] == ("holds" if case["true"] < 0 else "fails")


@pytest.mark.exhaustive
def test_printed_gain_of_odin_is_unstable_and_its_observer_does_not_converge(reproduced):
    values = reproduced["odin"]["eigenvalues"]
    assert values["printed"] == pytest.approx(2.3, abs=0.05)
    assert values["identity"] < 0
    assert values["repaired"] < -0.5
    loop = paper.odin_loop(paper.PRINTED_K2, 12.0)
    assert (loop.observer > 0.3).all()  # it does not shrink, while the repaired one is at 1e-4 by then


@pytest.mark.exhaustive
def test_without_a_cross_term_the_metric_is_only_semidefinite(reproduced):
    """In diag(K2, M), the best that can be said of any K2: drag is a square, so it has no slope at rest."""
    for k2 in (np.eye(6), paper.K2):
        error_system = virtual(paper.odin_observer(k2), crossed_metric(marine.odin(), k2, np.zeros((6, 6))))
        forms, rest = [contraction(error_system, rate) for rate in (0.0, 1e-3)], jnp.zeros(len(error_system.names))
        at_rest = jax.jit(lambda z, forms=forms: [form(z) for form in forms])(rest)
        values = np.linalg.eigvalsh(at_rest[0])
        np.testing.assert_allclose(values[:6], 0.0, atol=1e-9)
        assert values[6] > 0.1
        assert np.linalg.eigvalsh(at_rest[1])[0] < 0
    for name in ("identity, no cross term", "repaired, no cross term"):
        assert abs(reproduced["odin"]["sampled"][name]) < 1e-9


@pytest.mark.exhaustive
def test_repaired_observer_of_odin_is_proved_to_contract(reproduced):
    found = reproduced["odin"]
    assert found["certified"]["verdict"] == "holds"
    free = paper.odin_box().free
    assert {"z_roll", "z_pitch", "zdot_yaw", "surge", "yaw_rate"} <= set(free.names)
    assert np.rad2deg(free.high[free.names.index("z_pitch")]) > 40.0
    assert found["sampled"]["repaired"] >= found["certified"]["rate"]


@pytest.mark.exhaustive
def test_closed_loop_of_odin_converges_faster_than_certified(reproduced):
    loop = paper.odin_loop()
    assert loop.observer[-1] < 1e-6 * loop.observer[0]
    assert loop.tracking[-1] < 1e-5 * loop.tracking[0]
    for rate in reproduced["odin"]["loop"].values():
        assert rate >= paper.RATE / 2


def test_with_a_quaternion_controller_and_observer_pass_a_pitch_of_ninety_degrees():
    """(87): the representation singularity can be avoided by quaternions."""
    turning = paper.somersault()
    steep = np.abs(turning["pitch"]) > np.deg2rad(80.0)
    assert np.rad2deg(np.abs(turning["pitch"]).max()) > 89.0
    assert (np.diff(steep.astype(int)) == 1).sum() >= 3
    for name in ("observer", "tracking"):
        error = turning[name]
        assert (error[50:] < 0.2 * error[:-50])[error[:-50] > 1e-8].all()  # over any 5 s, through the vertical too
        assert error[-1] < 1e-8
        assert paper.tail_rate(turning["t"], error) > 0.6


@pytest.mark.exhaustive
def test_in_euler_angles_the_same_loop_ends_at_a_pitch_of_ninety_degrees():
    path = follow(lambda t: jnp.stack([jnp.sin(0.1 * t), jnp.cos(0.2 * t), 5.0, 0.0, 0.3 * t, 0.0]))
    controller = Backstepping(marine.odin(), path, paper.KP, paper.KD, paper.LAMBDA)
    first = np.array([0.5, 0.5, 5.5, 0.2, -0.4, 0.2, *[0.0] * 6])
    t = np.linspace(0.0, 8.0, 81)
    x, tracking, observer = paper.closed_loop(controller, paper.odin_observer(), first, first + 0.1, t)
    last = np.flatnonzero(np.isfinite(x).all(axis=1))[-1]
    assert x[last, 4] > np.deg2rad(85.0)
    assert t[last] < 5.6  # π/2 is reached at 5.24 s
    assert max(tracking[last], observer[last]) < 0.1  # until then it had converged
    assert not np.isfinite(x[-1]).any()


@pytest.mark.exhaustive
def test_theorem_3_on_odin_is_stable_under_refinement_and_depends_on_units_as_printed(reproduced):
    fine = reproduced["theorem3"]
    coarse = paper.odin_cascade(attempts=4_000, starts=32, units=False).constants
    for name, value in fine["constants"].items():
        np.testing.assert_allclose(getattr(coarse, name), value, rtol=1e-2)
    assert fine["weighted"]
    assert math.isfinite(fine["kappa"])
    assert len({fine["printed"], *fine["units"].values()}) == 2
    c = fine["constants"]
    np.testing.assert_allclose(c["c3"], 50.0, rtol=1e-6)  # the smallest of K_pΛ and K_d
    np.testing.assert_allclose([2 * c["c1"], 2 * c["c2"], c["c4"]], [8.0, 187.5, 187.5], rtol=1e-6)  # of M and K_p
    assert fine["closed_form"] == {"c1": 4.0, "c2": 93.75, "c3": 50.0, "c4": 187.5}  # printed beside the sampled ones
    np.testing.assert_allclose(fine["bound"], 4 * c["c3"] * c["lambda_q"] / c["c4"] ** 2, rtol=1e-12)


@pytest.mark.parametrize(("pitch", "printed"), [(0.0, math.hypot(12.5, 25.5)), (0.5, 30.83)])
def test_gamma_1_is_the_norm_of_the_coupling(pitch, printed):
    """At level attitude J is the identity and γ1 that of the paper, which drops Jᵀ: elsewhere it is larger."""
    jacobians = jax.jit(feedthrough(paper.odin_controller()))
    eta = jnp.zeros(6).at[3].set(pitch).at[4].set(pitch)
    b, itself = jacobians(jnp.concatenate([eta, jnp.zeros(6)]))
    level = np.block([[np.zeros((6, 12))], [np.diag(100 / np.diag(marine.odin().mass)), np.zeros((6, 6))]])
    level[6:, 6:] = np.diag(200 / np.diag(marine.odin().mass)) + 0.5 * np.eye(6)
    exact = np.linalg.norm(b, 2)
    assert not itself.any()
    if pitch == 0.0:
        np.testing.assert_allclose(exact, np.linalg.norm(level, 2), rtol=1e-12)
    else:
        assert exact > np.linalg.norm(level, 2)
    np.testing.assert_allclose(exact, printed, rtol=1e-3)


@pytest.fixture(scope="module")
def log():
    return paper.sea()


def test_log_has_the_rates_and_gaps_it_says(log):
    y, t = np.asarray(log.record.y), np.asarray(log.record.t)
    assert not np.isnan(y[:, 2]).any()
    assert np.isnan(y[:, 0]).mean() > 0.9
    assert np.isnan(y[(t >= 400) & (t < 460), :2]).all()
    assert not np.isnan(y[0]).any()
    again = np.asarray(paper.sea().record.y)
    np.testing.assert_array_equal(again, y)  # seeded


@pytest.mark.exhaustive
def test_velocities_at_sea_are_those_the_page_shows(reproduced):
    table = reproduced["sea"]
    passive, kalman, derived = (table[k] for k in ("passive observer", "extended Kalman filter", "filtered derivative"))
    for row in (passive, kalman):
        assert row["surge"] < derived["surge"] / 3
        assert row["sway"] < derived["sway"] / 3
    assert kalman["surge"] < passive["surge"] < 0.03  # the filter knows the densities of all noises
    assert passive["cost"] < kalman["cost"]


@pytest.mark.exhaustive
def test_page_and_words_come_from_the_numbers(reproduced, tmp_path):
    words = "\n".join(str(part) for part in paper.summary(reproduced))
    assert "K2 as printed in (54)" in words
    assert "Mt holds" in words
    picture = tmp_path / "empty.png"
    paper.draw_odin(paper.odin_loop(), picture)
    page = write_article(paper.TITLE, paper.page(reproduced, (picture, picture)), tmp_path / "page.html")
    text = page.read_text(encoding="utf-8")
    assert "ODIN under output feedback" in text
    assert "extended Kalman filter" in text
