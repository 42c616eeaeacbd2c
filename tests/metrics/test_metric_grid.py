"""Metrics over a grid: a store holds what the solver gives at each point, and says where it comes from."""

import jax.numpy as jnp
import pytest

from covariant import metrics, models
from covariant.metrics import metric_summary

MODEL = models.duffing()
GRID = metrics.Grid(list(MODEL.coordinates), MODEL.units, (-2.0, -1.0), (1.0, 1.0), (13, 9))


def test_a_field_of_process_noise_is_recorded_by_name(tmp_path):
    def noise(x):
        return jnp.diag(1 + x**2)

    equation = metrics.Equation(process_cov=noise)

    def stop(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        metrics.metric_on_grid(MODEL, equation, GRID, tmp_path / "m.zarr", on_progress=stop)
    recorded = metrics.open_grid(tmp_path / "m.zarr").attrs["provenance"]["equation"]["process_cov"]
    assert recorded.endswith("noise")
    for load in (metrics.load_metric, metric_summary):
        with pytest.raises(ValueError, match=r"m\.zarr is not complete"):
            load(tmp_path / "m.zarr")
