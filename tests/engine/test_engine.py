"""Streams and logs through compiled C: what JAX does, whatever the samples are."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models, observers
from covariant.engine import Stream, run_log, run_logs
from covariant.signals import Record

RATE = 250.0


@functools.cache
def pendulum():
    """With friction that asks for more than one substep in long steps."""
    return models.pendulum_chain(viscous=(0.1, 0.1), coulomb=(0.05, 0.02))


@functools.cache
def gated():
    intrinsic = observers.Intrinsic(pendulum(), 20.0, 200.0)
    return observers.Gated(intrinsic, pendulum(), jnp.asarray(1e-3), jnp.array([2.0, 2.0]))


@functools.cache
def record() -> Record:
    t = np.cumsum(np.random.default_rng(0).uniform(0.5, 1.5, 600)) / RATE
    t[300:] += 0.05  # a gap, which takes more substeps
    y = np.stack([0.5 * np.sin(3 * t), 3.1 + 0.2 * np.cos(5 * t)], axis=1)
    y[100:103] = np.nan
    y[200, 1] += 2.0  # an outlier
    return Record(t, 0.1 * np.sin(np.stack([t, 2 * t], axis=1)), y)


def parts(lengths) -> list[Record]:
    """The first rows of the log, as logs of their own."""
    return [Record(*(a[:count] for a in record()[:3])) for count in lengths]


def test_runs_that_do_not_belong_together_are_refused():
    intrinsic, logs = observers.Intrinsic(pendulum(), 10.0, 100.0), parts((100, 100, 100))
    for given, fault in (
        (([intrinsic] * 2, logs), "2 observers and 3 records"),
        (([], logs), "0 observers"),
        (
            ([intrinsic, observers.Intrinsic(pendulum(), 10.0, 100.0, order=2)], logs[0]),
            "observer 1 is of another kind",
        ),
        ((intrinsic, [logs[0], logs[1]._replace(u=logs[1].u[:, :1])]), "measurements and inputs must have one shape"),
    ):
        with pytest.raises(ValueError, match=fault):
            run_logs(*given)


@pytest.mark.exhaustive("jax")
@pytest.mark.parametrize("engine", ["c", "jax"])
def test_a_log_in_single_precision_is_taken_in_double(engine):
    """The type of a result depends neither on the engine nor on what is kept."""
    single = Record(*(np.asarray(a, np.float32) for a in parts((50,))[0][:3]))
    done, _ = run_log(gated(), single, engine=engine)
    assert {leaf.dtype for leaf in jax.tree.leaves(done)} == {np.dtype(float), np.dtype(np.int32)}


def test_a_short_log_stays_with_jax_and_a_fault_of_the_record_is_told():
    short = Record(*(a[:1] for a in record()[:3]))
    with pytest.raises(ValueError, match="at least two rows"):
        run_log(gated(), short)


@pytest.mark.parametrize(
    ("rate", "message"),
    [(0.0, "rate must be a positive"), (1.0, r"at least 1\.25 Hz, as an estimate starts anew after 1 s without")],
)
def test_a_rate_that_is_none_or_at_which_each_sample_would_start_anew_is_refused(rate, message):
    with pytest.raises(ValueError, match=message):
        Stream(gated(), record().y[0], rate)
