"""Jouffroy & Fossen 2004: the ship with either K2, ODIN under output feedback, Theorem 3, and a log at sea."""

import jax.numpy as jnp
import numpy as np
import pytest

from covariant.certificates import contraction, virtual
from covariant.papers import jouffroy_fossen as paper
from covariant.signals import Result


def test_printed_gain_of_the_ship_is_unstable_and_the_corrected_one_is_not():
    found = paper.ship_eigenvalues()
    assert found["printed"] > 0.5
    assert found["corrected"] < -0.02


def test_ship_obeys_the_rate_of_its_lyapunov_function():
    found = paper.ship_decay(300.0)
    bound = np.exp(-2 * found["rate"] * found["t"]) * found["lyapunov"][0]
    assert (found["lyapunov"] <= bound * (1 + 1e-9)).all()
    assert found["fitted"] >= found["rate"] >= found["printed"] > 0


def test_printed_gain_of_odin_makes_the_observer_diverge():
    values = paper.odin_eigenvalues()
    assert values["printed"] > 0.1
    assert values["repaired"] < -0.1
    # Drag that is quadratic vanishes at rest: without it and with a gain on the position alone the rate is that of K2.
    assert values["identity"] < 0
    loop = paper.odin_loop(paper.PRINTED_K2, 12.0)
    assert (loop.observer > 0.3).all()  # it does not shrink, while the repaired one is at 1e-4 by then


def test_identity_is_only_semidefinite_in_the_lyapunov_metric():
    """In diag(K2, M), the best that can be said of any K2: drag is a square, so it has no slope at rest."""
    for k2 in (np.eye(6), paper.K2):
        subject = virtual(paper.odin_observer(k2), paper.crossed_metric(paper.marine.odin(), k2, np.zeros((6, 6))))
        values = np.linalg.eigvalsh(contraction(subject, 0.0)(jnp.zeros(len(subject.names))))
        assert values[0] > -1e-9
        np.testing.assert_allclose(values[:6], 0.0, atol=1e-9)
        assert np.linalg.eigvalsh(contraction(subject, 1e-3)(jnp.zeros(len(subject.names))))[0] < 0


@pytest.fixture(scope="module")
def certificate():
    return paper.odin_certificate(paper.RATE)


def test_repaired_observer_of_odin_is_proved_to_contract(certificate):
    assert all(proof.verdict == "holds" for proof in certificate)
    free = paper.wide(paper.odin_box())
    assert {"z_roll", "z_pitch", "surge", "yaw_rate"} <= set(free.names)
    assert np.rad2deg(free.high[free.names.index("z_pitch")]) > 40.0
    sampled = paper.odin_sampled_rate()
    assert sampled >= paper.RATE
    assert "fails" in {proof.verdict for proof in paper.odin_certificate(1.1 * sampled)}


def test_closed_loop_of_odin_converges_faster_than_certified():
    loop = paper.odin_loop()
    assert loop.observer[-1] < 1e-6 * loop.observer[0]
    assert loop.tracking[-1] < 1e-5 * loop.tracking[0]
    assert paper.tail_rate(loop.t, loop.observer) >= paper.RATE / 2
    assert paper.tail_rate(loop.t, loop.tracking) >= paper.RATE / 2


def test_a_pitch_of_ninety_degrees_is_no_event_on_the_group():
    turning = paper.somersault()
    steep = np.abs(turning["pitch"]) > np.deg2rad(80.0)
    assert np.rad2deg(np.abs(turning["pitch"]).max()) > 89.0
    assert (np.diff(steep.astype(int)) == 1).sum() >= 3
    before, after = turning["error"][:-40], turning["error"][40:]
    assert (after < before)[before > 1e-6].all()  # smaller than two seconds before, through the vertical too
    assert turning["error"][-1] < 1e-8
    assert paper.tail_rate(turning["t"], turning["error"], 1e-6) > 1.0


def test_theorem_3_on_odin_is_stable_under_refinement_and_depends_on_units_as_printed():
    coarse, fine = (paper.odin_cascade(attempts=n, starts=s) for n, s in ((4_000, 32), (12_000, 64)))
    for a, b in zip(coarse.constants, fine.constants, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-2)
    assert fine.verdict == "holds"
    assert fine.constants.weighted
    assert fine.depends_on_units
    np.testing.assert_allclose(fine.constants.c3, 50.0, rtol=1e-6)  # the smallest of K_pΛ
    np.testing.assert_allclose(fine.constants.c4, 187.5, rtol=1e-6)  # the largest of M and K_p


@pytest.fixture(scope="module")
def log():
    return paper.sea()


def test_log_has_the_rates_and_gaps_it_says(log):
    y, t = np.asarray(log.record.y), np.asarray(log.record.t)
    assert not np.isnan(y[:, 2]).any()
    assert np.isnan(y[:, 0]).mean() > 0.9
    assert np.isnan(y[(t >= 400) & (t < 460), :2]).all()
    assert not np.isnan(y[0]).any()


def test_velocities_at_sea_are_those_the_page_shows(log):
    table = paper.sea_table(log)
    passive, kalman, derived = (table[k] for k in ("passive observer", "extended Kalman filter", "filtered derivative"))
    for row in (passive, kalman):
        assert row["surge"] < derived["surge"]
        assert row["sway"] < derived["sway"]
    assert kalman["surge"] <= 1.1 * passive["surge"]  # it knows the densities of all noises
    assert Result.OK == 0
    assert jnp.isfinite(jnp.asarray(list(passive.values()))).all()


def test_virtual_system_of_odin_contracts_at_a_point_as_its_matrix_says():
    subject = virtual(paper.odin_observer(), paper.crossed_metric(paper.marine.odin(), paper.K2, paper.CROSS))
    z = jnp.zeros(len(subject.names))
    assert np.linalg.eigvalsh(contraction(subject, paper.RATE)(z))[0] > 0
