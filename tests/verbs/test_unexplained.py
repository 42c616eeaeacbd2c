"""A filter says where its innovations are larger than a right model has them, and is silent where they are not."""

import numpy as np
from scipy.stats import chi2

from covariant.verbs.base.outcome import mean_quantile

RIGHT = {"measurement.std": 1e-3, "uncertainty.acceleration": 0.05, "parameters.coulomb": [0.0]}
RIGHT |= {"parameters.mass": [1.0], "parameters.length": [0.5], "parameters.viscous": [0.05]}


def test_the_quantile_is_that_of_chi_squared():
    for count in (3, 30, 600, 10_000):
        np.testing.assert_allclose(mean_quantile(count), chi2.ppf(0.999, count) / count, rtol=0.02)
