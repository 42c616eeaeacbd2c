"""What takes long of `test_metric_grid.py`."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_metric_grid import GRID, MODEL

from covariant import calibration, metrics, models
from covariant.metrics import _metric_on_grid, metric_summary
from covariant.signals import StepCode

EQUATION = metrics.Equation(rate=4.0, measurement_cov=jnp.array([[0.5]]))


DOMAIN = (jnp.array([-1.5, -jnp.inf]), jnp.array([1.5, 3.0]))


U = jnp.array([0.2])


def make(path, **changed):
    settings = {"start": 2.0, "tolerance": 1e-6, "domain": DOMAIN, "u": U, "name": "duffing", "block": 30}
    return metrics.metric_on_grid(MODEL, EQUATION, GRID, path, **(settings | changed))


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return make(tmp_path_factory.mktemp("grid") / "duffing.zarr")


@pytest.fixture(scope="module")
def store(path):
    return metrics.open_grid(path, complete=True).load()


@pytest.mark.exhaustive
def test_values_are_those_of_the_solver(store):
    index = np.random.default_rng(1).integers(0, GRID.shape, (20, 2))
    points = np.stack([axis[i] for axis, i in zip(GRID.axes, index.T, strict=True)], -1)
    solve = jax.vmap(lambda x: metrics.metric_at(MODEL, EQUATION, x, start=2.0, tolerance=1e-6, domain=DOMAIN, u=U))
    expected = jax.device_get(jax.jit(solve)(jnp.asarray(points)))._asdict()
    assert set(expected) == set(store)
    assert set(expected["result"]) >= {StepCode.OUT_OF_DOMAIN, StepCode.LEFT_DOMAIN, StepCode.OK}
    settled = expected["result"] == StepCode.OK
    # Rounding may move the steps of the integration, and with them the end of a past, but not the border.
    tolerances = {"metric": (1e-9, 1e-7), "result": (0.0, 0.0)}
    for name, values in expected.items():
        found, (close, near) = store[name].values[tuple(index.T)], tolerances.get(name, (1e-4, 1e-2))
        np.testing.assert_allclose(found[settled], values[settled], rtol=close, atol=0, err_msg=name)
        np.testing.assert_allclose(found, values, rtol=near, atol=near, err_msg=name)


@pytest.mark.exhaustive
def test_the_store_says_what_it_holds_and_where_it_comes_from(store):
    assert {name: store[name].dims[2:] for name in store} == {
        "metric": ("row", "column"),
        "error_bound": (),
        "horizon": (),
        "reconstructibility": (),
        "result": (),
    }
    assert store["horizon"].attrs["units"] == "s"
    assert store["q_dot"].attrs["units"] == "m/s"
    assert "0 ok" in store["result"].attrs["description"]
    assert store.attrs["provenance"] == {
        "model": "duffing",
        "parameters": {"damping": 0.25, "stiffness": -1.0, "cubic": 1.0},
        "equation": {"rate": 4.0, "process_cov": None, "measurement_cov": [[0.5]]},
        "start": 2.0,
        "tolerance": 1e-6,
        "domain": [[-1.5, None], [1.5, 3.0]],
        "u": [0.2],
        "source": "Sanfelice & Praly 2015, section III",
    }


@pytest.mark.exhaustive
def test_a_summary_covers_the_whole_grid(path, store, monkeypatch):
    found, known = metric_summary(path), np.isfinite(store["metric"].values).all(axis=(-2, -1))
    eigenvalues = np.linalg.eigvalsh(store["metric"].values[known])
    codes, counts = np.unique(store["result"].values, return_counts=True)
    assert found.results == {StepCode(c): n for c, n in zip(codes.tolist(), counts.tolist(), strict=True)}
    assert found.results[StepCode.OUT_OF_DOMAIN] == 18
    assert (found.low, found.high) == pytest.approx((eigenvalues.min(), eigenvalues.max()), rel=1e-12)
    assert found.error_bound == np.nanmax(store["error_bound"].values[known])
    inside = store["result"].values != StepCode.OUT_OF_DOMAIN
    assert found.reconstructibility == store["reconstructibility"].values[inside].min()
    # The same in parts, as it is read where memory does not hold the grid.
    parts = list(_metric_on_grid._regions(metrics.open_grid(path).chunk({"q": 5, "q_dot": 4})))
    assert len(parts) == 9
    monkeypatch.setattr(_metric_on_grid, "_regions", lambda store: parts)
    assert metric_summary(path) == found


@pytest.mark.exhaustive
def test_the_field_of_a_store_has_its_values_at_the_points(path, store):
    field = metrics.load_metric(path)
    points = np.stack(np.meshgrid(*GRID.axes, indexing="ij"), -1)[4:]  # two spacings off those outside the domain
    np.testing.assert_allclose(jax.jit(jax.vmap(jax.vmap(field)))(points), store["metric"].values[4:], rtol=1e-12)
    assert np.isnan(field(jnp.array([-1.8, 0.0]))).all(), "there is none outside the domain"
    between = jnp.array([0.4, 0.1])
    exact = metrics.metric_at(MODEL, EQUATION, between, start=2.0, tolerance=1e-6, domain=DOMAIN, u=U).metric
    np.testing.assert_allclose(field(between), exact, rtol=0.02)


@pytest.mark.exhaustive
def test_the_observer_of_a_store_has_its_field_its_noise_and_the_gain_of_its_equation(path):
    start = jnp.array([0.4, 0.1])
    observer = calibration.stored_observer(MODEL, path, start)
    np.testing.assert_array_equal(observer.metric(start), metrics.load_metric(path)(start))
    np.testing.assert_array_equal(observer.measurement_cov, EQUATION.measurement_cov)
    assert observer.gain == 0.25  # of an equation with a rate
    key = next(iter(MODEL.parameters))
    other = eqx.tree_at(lambda m: m.parameters[key].value, MODEL, MODEL.parameters[key].value + 1)
    with pytest.raises(ValueError, match=rf"the metric is for {key} = .*; the model has .*; compute it anew"):
        calibration.stored_observer(other, path, start)
    with pytest.raises(ValueError, match="a metric of q, q_dot; the states are q, v"):
        calibration.stored_observer(dataclasses.replace(MODEL, coordinates=("q", "v")), path, start)
    with pytest.raises(ValueError, match="a metric of 2 states; the model has 3"):
        calibration.stored_observer(models.unknown_frequency(), path, jnp.zeros(3))


@pytest.mark.exhaustive
def test_what_does_not_fit_is_refused(path, tmp_path):
    wrong = metrics.Grid(("q", "v"), ("m", "m/s"), (-1, -1), (1, 1), (4, 4))
    with pytest.raises(ValueError, match="the grid has axes q, v; the states are q, q_dot"):
        metrics.metric_on_grid(MODEL, EQUATION, wrong, tmp_path / "m.zarr")
    with pytest.raises(ValueError, match=r"holds another map: provenance\.domain"):
        make(path, domain=None)
    level = {"level": metrics.Variable((), "1", "a number")}
    metrics.map_grid(lambda x: {"level": x[0]}, wrong, tmp_path / "level.zarr", variables=level, provenance={})
    for load in (metrics.load_metric, metric_summary):
        with pytest.raises(ValueError, match=r"level\.zarr holds level and no metric of metrics\.metric_on_grid"):
            load(tmp_path / "level.zarr")


@pytest.mark.exhaustive
def test_a_store_does_not_go_on_with_an_edited_model(tmp_path):
    """One whose numbers are in the code alone, and which has the same name."""

    def design(damping, **more):
        names, table = {"coordinates": ("a", "b"), "units": ("", "")}, jnp.array([1.0, damping])
        plant = models.StateSpace(lambda t, x, u: jnp.array([x[1], -table @ x]), lambda t, x, u: x[:1], **names)
        grid = metrics.Grid(("a", "b"), ("", ""), low=(-1.0, -1.0), high=(1.0, 1.0), counts=(2, 2))
        equation = metrics.Equation(rate=1.0)
        return metrics.metric_on_grid(plant, equation, grid, tmp_path / "m.zarr", block=1, workers=1, **more)

    def stop(done, total):
        if done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        design(0.5, on_progress=stop)
    for done_before in (False, True):
        with pytest.raises(ValueError, match="holds another map: what is evaluated at a point was changed since"):
            design(0.6)
        if not done_before:
            design(0.5)
