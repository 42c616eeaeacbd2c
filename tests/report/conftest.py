"""Synthetic reports: sines with noise, an overshoot at the start, a gap, and labels that try to be markup."""

import jax
import numpy as np
import pytest

from covariant.report import EstimateReport

LABELS = ("intrinsic <b>&", "EKF $x", "_filtered</script>")


def synthetic(n: int = 3, samples: int = 400, labels: tuple[str, ...] = LABELS) -> EstimateReport:
    """A report on n coordinates: 20 s of motion of order one, measured with 0.01 rad of noise, NaN from 8 s to 9 s."""
    rng = np.random.default_rng(0)
    t = np.linspace(0.0, 20.0, samples)
    phase = t[:, None] + np.arange(n)
    q, v = np.sin(phase), np.cos(phase)
    y = q + 0.01 * rng.standard_normal(q.shape)
    estimates = {}
    for k, label in enumerate(labels, start=1):
        overshoot = 30 * np.exp(-5 * t)[:, None]
        noise = 0.02 * k * rng.standard_normal((samples, 2 * n))
        estimates[label] = np.hstack([q, v + overshoot]) + noise
    innovation = {label: y - x[:, :n] for label, x in estimates.items()}
    distance = {label: np.linalg.norm(e, axis=1) for label, e in list(innovation.items())[:2]}
    missing = (t > 8) & (t < 9)
    y[missing] = np.nan
    for d in distance.values():
        d[missing] = 0.0
    return EstimateReport(
        title="Log <i>17</i> & friends",
        coordinates=tuple("θφψabcd"[:n]),
        units=("rad",) * n,
        t=t,
        q_measured=y,
        estimates=estimates,
        innovation=innovation,
        distance=distance,
        v_reference=v,
        v_reference_label="zero-phase <reference>",
        rows=[{"observer": label, "RMS [rad/s]": 0.0123 * (k + 1)} for k, label in enumerate(labels)],
        best=1,
        notes=("Gains α = 12 1/s & β = 36 1/s².",),
    )


@pytest.fixture
def make():
    return synthetic


@pytest.fixture(params=[1, 3], ids=["n=1", "n=3"])
def report(request) -> EstimateReport:
    return synthetic(request.param)


def diverged(estimates):
    estimates = {label: x.copy() for label, x in estimates.items()}
    list(estimates.values())[1][50:] = 1e300
    list(estimates.values())[2][50:] = np.inf
    return {"estimates": estimates}


def alone(estimates):
    first = dict(list(estimates.items())[:1])
    return {"estimates": first, "innovation": {}, "distance": {}, "v_reference": None, "rows": (), "notes": ()}


DEGENERATE = {
    "no_reference": lambda r: {"v_reference": None},
    "two_samples": lambda r: {name: jax.tree.map(lambda x: x[:2], getattr(r, name)) for name in OVER_TIME},
    "equal_distances": lambda r: {"distance": {label: np.full_like(d, 0.3) for label, d in r.distance.items()}},
    "zero_distances": lambda r: {"distance": {label: np.zeros_like(d) for label, d in r.distance.items()}},
    "nothing_finite": lambda r: jax.tree.map(
        lambda x: np.full_like(x, np.nan), {"q_measured": r.q_measured, "estimates": r.estimates}
    ),
    "diverged": lambda r: diverged(r.estimates),
    "alone": lambda r: alone(r.estimates),
}
OVER_TIME = ("t", "q_measured", "v_reference", "estimates", "innovation", "distance")


@pytest.fixture(params=DEGENERATE)
def degenerate(request) -> EstimateReport:
    report = synthetic(1)
    return report._replace(**DEGENERATE[request.param](report))
