"""Synthetic reports: sines with noise, an overshoot at the start, a gap, and labels that try to be markup."""

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


def _no_reference(report):
    return report._replace(v_reference=None)


def _two_samples(report):
    first = {
        field: {k: x[:2] for k, x in getattr(report, field).items()}
        for field in ("estimates", "innovation", "distance")
    }
    return report._replace(
        t=report.t[:2], q_measured=report.q_measured[:2], v_reference=report.v_reference[:2], **first
    )


def _equal_distances(report):
    return report._replace(distance={label: np.full_like(d, 0.3) for label, d in report.distance.items()})


def _zero_distances(report):
    return report._replace(distance={label: np.zeros_like(d) for label, d in report.distance.items()})


def _nothing_finite(report):
    lost = {label: np.full_like(x, np.nan) for label, x in report.estimates.items()}
    return report._replace(q_measured=np.full_like(report.q_measured, np.nan), estimates=lost)


def _diverged(report):
    estimates = {label: x.copy() for label, x in report.estimates.items()}
    list(estimates.values())[1][50:] = 1e300
    list(estimates.values())[2][50:] = np.inf
    return report._replace(estimates=estimates)


def _alone(report):
    label, x = next(iter(report.estimates.items()))
    return report._replace(estimates={label: x}, innovation={}, distance={}, v_reference=None, rows=(), notes=())


@pytest.fixture(
    params=[_no_reference, _two_samples, _equal_distances, _zero_distances, _nothing_finite, _diverged, _alone],
    ids=lambda change: change.__name__.strip("_"),
)
def degenerate(request) -> EstimateReport:
    return request.param(synthetic(1))
