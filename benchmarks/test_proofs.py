"""The shipped proof of the double pendulum by NumPy and by compiled C, in processor time; the trees are the same."""

import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from covariant.certificates import ContractionCertificate
from covariant.certificates.base._inequalities import contraction, width_bound
from scalargraph import enclose, expand, proofs
from scalargraph.compiler import EXACT, compiled
from scalargraph.intervals._c_intervals import source
from scalargraph.proofs._tests_in_c import source as tests_source

FILE = Path(__file__).parents[1] / "examples/certificates/dfki_double_pendulum.json"
ENGINES = ("numpy", "c")


@pytest.fixture(scope="module")
def shipped():
    """The certificate, with C that was compiled before."""
    domain = proofs.box(x=(0.0, 1.0))
    assert proofs.prove(lambda z: jnp.reshape(1 + z[0], (1, 1)), domain, engine="c").verdict == "holds"
    return ContractionCertificate.load(FILE)


@pytest.mark.benchmark(group="proof: all claims of the double pendulum, 599 boxes", timer=time.process_time)
@pytest.mark.parametrize("engine", ENGINES)
def test_proof(benchmark, shipped, engine):
    """From the equations on: tracing, derivatives, search."""

    def work():
        found = []
        for claim in shipped.claims:
            about = shipped.error_system
            reach = claim.kind == "reach"
            matrix = width_bound(about, claim.row, claim.square) if reach else contraction(about, shipped.rate)
            found.append(proofs.prove(matrix, shipped.domain, engine=engine))
        return found

    for proof, claim in zip(benchmark.pedantic(work, rounds=1), shipped.claims, strict=True):
        assert proof.verdict == "holds"
        assert all(np.array_equal(a, b) for a, b in zip(proof.levels, claim.proof.levels, strict=True))


@pytest.mark.benchmark(group="proof: second derivatives over 2048 boxes", timer=time.process_time)
@pytest.mark.parametrize("engine", ENGINES)
def test_bounds(benchmark, shipped, engine):
    domain = shipped.domain
    entries = contraction(shipped.error_system, shipped.rate).graph(jnp.asarray(domain.low)).entries
    graph = expand(entries, range(len(domain.low)), 2)
    ends = np.random.default_rng(0).uniform(domain.low, domain.high, (2, 2048, len(domain.low)))
    low, high = ends[0], np.minimum(ends[0] + 0.02 * (domain.high - domain.low), domain.high)
    benchmark(lambda: enclose(graph, low, high, engine))


@pytest.mark.benchmark(group="proof: compilation of the C, once on a machine")
def test_compilation(benchmark, monkeypatch):
    """In elapsed time, since the compiler is a process of its own."""
    monkeypatch.setenv("COVARIANT_CACHE", "off")
    texts = source(), tests_source()
    benchmark.pedantic(lambda: [compiled(text, EXACT, lambda path: path) for text in texts], rounds=1)
