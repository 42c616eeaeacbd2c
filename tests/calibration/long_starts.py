"""What takes long of `test_starts.py`."""

from pathlib import Path

import numpy as np
import pytest
from plain import rk4

from covariant.verbs import fit, init, simulate

CART, POLE, COM, INERTIA, VISCOUS, COULOMB = 0.57, 0.23, 0.32, 0.0079, (1.2, 0.002), (0.6, 0.001)


RATE, SUBSTEPS = 100.0, 5


def cart_pole(path: Path, late: float = 0.0, sign: float = 1.0, seconds: float = 12.0, seed: int = 0) -> Path:
    """Write the log of a pole on a cart, by its equations written here a second time: stamps, positions and force."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, seconds, 1 / RATE)
    phases = 2 * np.pi * np.outer(t, [0.4, 0.9, 1.7, 2.6]) + rng.uniform(0, 6, 4)
    force = 2 * np.sin(phases).sum(axis=1)

    def rate(x: np.ndarray, u: float) -> np.ndarray:
        _, angle, v, w = x
        side = POLE * COM * np.cos(angle)
        inertia = np.array([[CART + POLE, side], [side, INERTIA + POLE * COM**2]])
        friction = np.array(VISCOUS) * x[2:] + np.array(COULOMB) * np.arctan(100 * x[2:])
        driven = np.array([u + POLE * COM * np.sin(angle) * w**2, -POLE * 9.81 * COM * np.sin(angle)])
        return np.concatenate([[v, w], np.linalg.solve(inertia, driven - friction)])

    x, rows, h = np.array([0.0, 0.3, 0.0, 0.0]), [], 1 / RATE / SUBSTEPS
    for u in force:
        rows.append(x[:2])
        for _ in range(SUBSTEPS):
            x = rk4(lambda x, u=u: rate(x, u), x, h)
    q = np.array(rows) + rng.normal(size=(len(t), 2)) * (2e-4, 5e-4)
    q = np.stack([np.interp(t - late, t, column) for column in q.T], axis=1)
    table = np.column_stack([t, q, sign * force])
    np.savetxt(path, table, "%.7g", ",", header="t,cart [m],pole [rad],force [N]", comments="")
    return path


def drafted(folder: Path, **log) -> tuple[Path, Path]:
    """The model file that `init` drafts, and the log."""
    path = cart_pole(folder / "log.csv", **log)
    return init(path).save(folder / "cart.toml"), path


FITTED = ("cart_mass", "com", "inertia", "viscous", "coulomb")


KNOWN = {"parameters.pole_mass": POLE, "inputs.between": "held"}


@pytest.mark.exhaustive
def test_guesses_of_the_draft_end_at_the_truth_and_the_place_that_won_is_said(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    model, log = drafted(tmp_path)
    result = fit(model, log, FITTED, overrides=KNOWN, anyway=True)
    truth = np.array([CART, COM, INERTIA, *VISCOUS, *COULOMB])
    assert result.columns["determined"].all()
    assert np.all(np.abs(result.values - truth) < 4 * result.standard_errors), (result.values, result.standard_errors)
    assert result.better
    assert result.summary["start"].startswith("The search from ")
    assert result.summary["start"] in str(result)


@pytest.mark.exhaustive
def test_numbers_that_stand_for_each_other_are_not_called_determined(tmp_path, monkeypatch):
    """Only both masses together, the moment of the pole, and its inertia about the pivot are shown: three of four."""
    monkeypatch.chdir(tmp_path)
    model, log = drafted(tmp_path)
    result = fit(model, log, ("cart_mass", "pole_mass", "com", "inertia"), overrides=held_friction(), anyway=True)
    rows = {row["name"]: row for row in result.summary["parameters"]}
    for name in ("pole_mass", "com", "inertia"):
        assert not rows[name]["determined"], rows
    cart = rows["cart_mass"]
    assert cart["standard_error"] is None or abs(cart["after"] - CART) < 4 * cart["standard_error"]
    total = rows["cart_mass"]["after"] + rows["pole_mass"]["after"]
    np.testing.assert_allclose(total, CART + POLE, rtol=0.01)


def held_friction() -> dict:
    return {"parameters.viscous": list(VISCOUS), "parameters.coulomb": list(COULOMB), "inputs.between": "held"}


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ({"sign": -1.0}, 'logged with the other sign; .* u = "-1"'),
        ({"late": 0.03}, r"about 0\.03 s later .* delay = 0\.03"),
    ],
)
def test_a_log_that_is_misread_is_doubted_and_nothing_is_written(tmp_path, monkeypatch, fault, words):
    monkeypatch.chdir(tmp_path)
    model, log = drafted(tmp_path, **fault)
    overrides = held_friction() | {"parameters.pole_mass": POLE}
    result = fit(model, log, ("cart_mass", "com", "viscous[0]"), overrides=overrides, anyway=True)
    assert (result.better, result.exit_code) == (False, 1)
    assert not result.columns["determined"].any()
    with pytest.raises(ValueError, match=words):
        result.save(tmp_path / "fitted.toml")
    assert not (tmp_path / "fitted.toml").exists()


MACHINES = {
    "oscillator": ({"stiffness": 2.3}, {}, {"q0": 1.0, "rate": 50.0, "duration": 20.0}),
    "pendulum_chain": (
        {"com": [0.4], "inertia": [0.05], "viscous": [0.08], "coulomb": [0.03]},
        {"mass": [0.7], "length": [0.5]},
        {"q0": 1.0, "amplitude": 1.5, "rate": 100.0, "duration": 15.0},
    ),
}


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", MACHINES)
def test_guesses_off_by_up_to_ten_times_end_within_four_standard_errors(name):
    truth, known, motion = MACHINES[name]
    rng = np.random.default_rng([3, *map(ord, name)])
    given = {f"parameters.{key}": value for key, value in known.items()} | {"inputs.between": "held"}
    true = given | {f"parameters.{key}": value for key, value in truth.items()}
    guesses = {
        key: (np.array(value) * 10 ** rng.uniform(-1, 1, np.shape(value))).tolist() for key, value in truth.items()
    }
    log = simulate(name, noise=2e-4, seed=3, overrides=true, **motion).record
    guess = given | {f"parameters.{key}": value for key, value in guesses.items()}
    result = fit(name, log, list(truth), overrides=guess, anyway=True)
    assert result.better
    assert result.columns["determined"].all()
    off = (result.values - np.concatenate([np.atleast_1d(value) for value in truth.values()])) / result.standard_errors
    assert np.abs(off).max() < 4, off
