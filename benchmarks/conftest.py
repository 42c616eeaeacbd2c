"""The processor only, so that runs compare, and a table that fits a screen."""

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")


def pytest_configure(config):
    """Columns that fit a screen."""
    config.option.benchmark_columns = ["min", "median", "iqr", "rounds"]
