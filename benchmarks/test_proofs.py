"""The proof of the double pendulum from its equations, and bounds of its matrix over many boxes, in processor time."""

import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from covariant.certificates import ContractionCertificate
from covariant.certificates.base._inequalities import contraction, width_bound
from scalargraph import enclose, expand, proofs

FILE = Path(__file__).parents[1] / "examples/certificates/dfki_double_pendulum.json"


@pytest.fixture(scope="module")
def shipped():
    return ContractionCertificate.load(FILE)


@pytest.mark.benchmark(group="proof: all claims of the double pendulum", timer=time.process_time)
def test_proof(benchmark, shipped):
    """From the equations on: tracing, search."""

    def work():
        found = []
        for claim in shipped.claims:
            about = shipped.error_system
            reach = claim.kind == "reach"
            matrix = width_bound(about, claim.row, claim.square) if reach else contraction(about, shipped.rate)
            found.append(proofs.prove(matrix, shipped.domain))
        return found

    for proof in benchmark.pedantic(work, rounds=1):
        assert proof.verdict == "holds"


@pytest.mark.benchmark(group="proof: second derivatives over 2048 boxes", timer=time.process_time)
def test_bounds(benchmark, shipped):
    domain = shipped.domain
    entries = contraction(shipped.error_system, shipped.rate).graph(jnp.asarray(domain.low)).entries
    graph = expand(entries, range(len(domain.low)), 2)
    ends = np.random.default_rng(0).uniform(domain.low, domain.high, (2, 2048, len(domain.low)))
    low, high = ends[0], np.minimum(ends[0] + 0.02 * (domain.high - domain.low), domain.high)
    benchmark(lambda: enclose(graph, low, high))
