"""Extended and unscented Kalman filter of FilterPy on the same model, with the noise that is found for the library's.

Their numbers are not searched again: what differs between the two programs is their code. Without FilterPy, which
`benchmarks/velocity/requirements.txt` names, they are left out.
"""

import importlib.util
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.velocity.cases import Case
from benchmarks.velocity.estimators import AbstractEstimator, Estimate, Numbers
from benchmarks.velocity.estimators.differences import readings
from covariant.models import Motion, advance


class FilterPy(AbstractEstimator):
    """A filter of FilterPy; its noise is that of an unexplained acceleration, independent in every interval."""

    knows_model, source = True, "Labbe, FilterPy 1.4.5"

    def __init__(self, kind: str):
        self.kind, self.name, self.numbers_of = kind, f"filterpy-{kind}", kind

    def fits(self, case: Case) -> bool:
        return super().fits(case) and case.model.feet is None

    def run(self, case: Case, numbers: Sequence[Numbers], rows: np.ndarray) -> list[Estimate]:
        t, y = readings(case, rows)
        u, n = np.asarray(case.loaded.record.u), y.shape[1]

        @jax.jit
        def ahead(x, u, begin, h):
            q, v = advance(case.model, begin, Motion(x[:n], x[n:]), u, h, 2)
            return jnp.concatenate([q, v])

        return [self._follow(case, one["acceleration_std"], t, y, u, ahead) for one in numbers]

    def _follow(self, case: Case, std: float, t: np.ndarray, y: np.ndarray, u: np.ndarray, ahead: Any) -> Estimate:
        filter_ = self._filter(y.shape[1])
        n = y.shape[1]
        filter_.x = np.concatenate([y[0], np.zeros(n)])
        noise = np.broadcast_to(np.asarray(case.loaded.file.typical_std) ** 2, n)
        speed = np.sqrt(np.nanmean(case.v[case.tune] ** 2, axis=0))
        filter_.P, filter_.R = np.diag([*noise, *speed**2]), np.diag(noise)
        v, deviation = np.zeros((2, len(t), n))
        # Quick enough for one run: the derivative is compiled once.
        slope = jax.jit(jax.jacfwd(ahead))
        for k in range(1, len(t)):
            h = t[k] - t[k - 1]
            pushed = np.concatenate([h * h / 2 * np.eye(n), h * np.eye(n)])
            filter_.Q = std**2 * pushed @ pushed.T + 1e-18 * np.eye(2 * n)
            now = (u[k - 1], t[k - 1], h)
            if self.kind == "ekf":
                filter_.F = np.asarray(slope(filter_.x, *now))
                filter_.P = filter_.F @ filter_.P @ filter_.F.T + filter_.Q
                filter_.x = np.asarray(ahead(filter_.x, *now))
                filter_.update(y[k], lambda x: np.eye(n, 2 * n), lambda x: x[:n])
            else:
                filter_.predict(fx=lambda x, dt, now=now: np.asarray(ahead(x, *now)))
                filter_.update(y[k])
            v[k], deviation[k] = filter_.x[n:], np.sqrt(np.diag(filter_.P)[n:])
        return Estimate(v, deviation)

    def _filter(self, n: int) -> Any:
        from filterpy.kalman import ExtendedKalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter

        if self.kind == "ekf":
            return ExtendedKalmanFilter(2 * n, n)
        points = MerweScaledSigmaPoints(2 * n, 0.1, 2.0, 3.0 - 2 * n)
        return UnscentedKalmanFilter(2 * n, n, 1.0, lambda x: x[:n], lambda x, dt: x, points)


ESTIMATORS = [FilterPy(kind) for kind in ("ekf", "ukf")] if importlib.util.find_spec("filterpy") else []
