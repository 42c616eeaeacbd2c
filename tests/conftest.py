"""Strict numerics for every test, the recorded logs, and the spaces over which the laws of geometry are checked."""

import ctypes
import gc
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("JAX_PLATFORMS", "cpu")
CONTROLS = "PYTEST_XDIST_WORKER" not in os.environ
if CONTROLS:  # the workers inherit it: one cache for the whole run, empty at first as a new user's is
    os.environ["COVARIANT_CACHE"] = tempfile.mkdtemp(prefix="covariant-tests-")

import covariant  # before JAX, which then stores its programs in the cache folder

SOURCE = Path(covariant.__file__).parent

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from beartype.claw import beartype_packages
from jaxtyping import install_import_hook

# What the checker computes with says no shapes. A wrong type there is no `TypeError`, which would count as a refusal.
CHECKER = ("covariant.proofs.checker", "covariant.proofs._file")
beartype_packages(CHECKER)
# Types are not checked in lowering, whose inner loops run millions of times, nor in certificates: there files are read
# that may be forged, and must be refused by what users run.
UNCHECKED = ("covariant.lowering", "covariant.certificates", *CHECKER)
ROOMS = {f"covariant.{path.stem}" for path in SOURCE.iterdir() if path.suffix in ("", ".py")}
PROOFS = {f"covariant.proofs.{path.stem}" for path in (SOURCE / "proofs").iterdir()}
install_import_hook(sorted((ROOMS | PROOFS) - {"covariant.proofs", *UNCHECKED}), "beartype.beartype")

from covariant import geometry, models
from covariant.geometry import Budget, Metric

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

hypothesis.settings.register_profile("laws", derandomize=True, deadline=None, database=None, max_examples=60)
hypothesis.settings.load_profile("laws")

SUITES = {"long": 1.5, "exhaustive": 4.0}
"""Marks that a file may give its cases by a list of their names, in capitals, and that a test has which takes more than
these seconds of a core."""
SECONDS = json.loads(Path(__file__).with_name("seconds.json").read_text(encoding="utf-8"))
"""What each test takes, in seconds of a core, where it is 1 or more: `python tools/test_seconds.py` measures it."""
EVERY_RUN = ("tests/pages/", "tests/test_house.py", "tests/test_contributing.py")
"""Where tests take as long as they take: what a user runs is tried each time."""
ROOMS_OF_LAWS = ("geometry", "laws", "lowering", "metrics", "models", "proofs", "simulation")
LARGER = tuple(f"tests/{room}/" for room in ROOMS_OF_LAWS)
"""Where a long test adds a larger member to a law: it is exhaustive, since a smaller member is tried each time."""
REPOSITORY = Path(__file__).parents[1]


def pytest_unconfigure():
    if CONTROLS:
        shutil.rmtree(os.environ["COVARIANT_CACHE"], ignore_errors=True)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    """Mark as long, or exhaustive, what takes the seconds of it, and what a file says in `LONG` or `EXHAUSTIVE`: a case
    as `test[parameters]`, or parameters of any test of the file.

    Of several parameters, joined by dashes as tests show them, a name may be one or some that follow each other.
    """
    unused = set()
    for module in {item.module for item in items}:
        unused |= {(module.__name__, name) for suite in SUITES for name in getattr(module, suite.upper(), ())}
    for item in items:
        parameters = f"-{item.callspec.id}-" if hasattr(item, "callspec") else ""
        seconds = 0.0 if item.nodeid.startswith(EVERY_RUN) else SECONDS.get(item.nodeid, 0.0)
        for suite, least in SUITES.items():
            if seconds > least:
                item.add_marker(getattr(pytest.mark, suite))
            listed = getattr(item.module, suite.upper(), ())
            names = [name for name in listed if name == item.name or f"-{name}-" in parameters]
            if names:
                item.add_marker(getattr(pytest.mark, suite))
            unused -= {(item.module.__name__, name) for name in names}
        if item.nodeid.startswith(LARGER) and item.get_closest_marker("long"):
            item.add_marker(pytest.mark.exhaustive)
    items.sort(key=lambda item: "/pages/" not in item.nodeid)  # what takes longest comes first, or a worker idles
    if unused and not any("::" in argument for argument in config.args):
        raise pytest.UsageError(f"LONG or EXHAUSTIVE names parameters that no test has: {sorted(unused)}")


@pytest.fixture(scope="module", autouse=True)
def release_memory():
    """Release compiled programs after each file: they hold memory, and mappings, of which Linux allows 65 530."""
    yield
    jax.clear_caches()
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None
    if trim is not None:  # glibc keeps what was freed, a gigabyte after some files
        trim(0)


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """The folder of recorded logs; a test without it is skipped, except in CI where it must be there."""
    folder = Path(os.environ.get("COVARIANT_DATA", REPOSITORY / "../shared/data"))
    if not folder.is_dir():
        word = f"recorded logs not found in {folder}; set COVARIANT_DATA to their folder"
        if os.environ.get("CI"):
            pytest.fail(word)
        pytest.skip(word)
    return folder


def shears(q):
    """A cubic diffeomorphism of the plane, and below its exact inverse."""
    a = q[0] + 0.1 * q[1] ** 3
    return jnp.stack([a, q[1] - 0.2 * a**3])


def unshears(q):
    b = q[1] + 0.2 * q[0] ** 3
    return jnp.stack([q[0] - 0.1 * b**3, b])


def closed_forms() -> dict:
    """Spaces with closed forms: (metric, centre of the box that points are drawn from, its half width)."""
    mixed = geometry.Product((geometry.sphere(), geometry.hyperbolic()), (2, 2))
    return {
        "euclidean": (geometry.Euclidean(), np.zeros(3), 3.0),
        "plane, curved chart": (geometry.Pullback(geometry.Euclidean(), shears, unshears), np.zeros(2), 0.8),
        "sphere": (geometry.sphere(), np.zeros(2), 0.9),
        "sphere, curved chart": (geometry.Pullback(geometry.sphere(), shears, unshears), np.zeros(2), 0.6),
        "small 3-sphere": (geometry.sphere(0.5), np.zeros(3), 0.3),
        "hyperbolic": (geometry.hyperbolic(), np.zeros(2), 0.6),
        "torus": (geometry.FlatTorus(jnp.array([2 * np.pi, 1.0])), np.zeros(2), 4.0),
        "sphere x hyperbolic": (mixed, np.zeros(4), 0.6),
    }


def numerical_spaces() -> dict:
    """Spaces known by their matrix alone."""
    rotors = {"rotor_inertia": (0.02, 0.01), "gear": (3.0, 5.0)}
    triple = models.pendulum_chain((1.0, 0.5, 0.7), (1.0, 0.8, 0.6), com=(0.5, 0.4, 0.6), inertia=(0.1, 0.05, 0.0))
    return {
        "numeric sphere": (Metric(geometry.sphere()), np.zeros(2), 0.6),
        "numeric hyperbolic": (Metric(geometry.hyperbolic()), np.zeros(2), 0.5),
        "ball and beam": (models.ball_and_beam().metric, np.array([0.3, 0.0]), 0.8),
        "oscillator in r": (models.oscillator("r").metric, np.ones(1), 0.5),
        "double pendulum": (models.pendulum_chain(**rotors).metric, np.array([0.2, 0.9]), 0.4),
        "double pendulum, absolute": (models.pendulum_chain(angles="absolute").metric, np.array([0.2, 0.9]), 0.4),
        "triple pendulum": (triple.metric, np.array([0.2, 0.9, -0.5]), 0.3),
    }


SAMPLES = 12

BUDGET = Budget(steps=12)
"""Enough eighth-order steps for the numerical geodesics of the samples to be exact to 1e-12."""


class Space(NamedTuple):
    """A metric, points and vectors (SAMPLES, n) to try it on, and its operations, batched and compiled once."""

    metric: geometry.AbstractMetric
    p: np.ndarray
    q: np.ndarray
    velocity: np.ndarray
    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    w: np.ndarray
    matrix: Callable
    christoffel: Callable
    curvature: Callable
    fly: Callable[..., geometry.Transported]
    shoot: Callable[..., geometry.Shot]

    def inner(self, p, x, y):
        return np.einsum("ki,kij,kj->k", x, self.matrix(p), y)

    def norm(self, p, x):
        return np.sqrt(self.inner(p, x, x))


def make_space(metric, centre, width) -> Space:
    """Points in the box, with the seams in front: equal points, points a hair apart, and the middle of the chart.

    Velocities stay below half a period of the torus.
    """
    n = len(centre)
    rng = np.random.default_rng(100 + n)
    p, q = centre + width * rng.uniform(-1, 1, (2, SAMPLES, n))
    q[0] = p[0]
    q[1] = p[1] + 1e-9 * rng.normal(size=n)
    p[2] = centre
    velocity = min(width, 0.45) * rng.uniform(-1, 1, (SAMPLES, n))
    velocity[0] = 0.0
    velocity[1] *= 1e-9
    operations = (
        metric.__call__,
        metric.connection,
        metric.curvature,
        lambda p, v, w: geometry.transport_along(metric, p, v, w, BUDGET),
        lambda p, q: geometry.shoot(metric, p, q, None, BUDGET),
    )
    compiled = (jax.jit(jax.vmap(operation)) for operation in operations)
    return Space(metric, p, q, velocity, *rng.normal(size=(4, SAMPLES, n)), *compiled)


@pytest.fixture(scope="session")
def spaces() -> dict[str, Space]:
    """Every space by name; what one test compiles the next one uses."""
    return {name: make_space(*entry) for name, entry in (closed_forms() | numerical_spaces()).items()}


FEW = ("sphere, curved chart", "small 3-sphere", "numeric hyperbolic", "ball and beam", "double pendulum, absolute")
"""Spaces that add little to the others; with the triple pendulum, the largest, they are for long runs."""


def members(names) -> list:
    return [pytest.param(n, marks=pytest.mark.long) if n in (*FEW, "triple pendulum") else n for n in names]


@pytest.fixture(scope="session", params=members([*closed_forms(), *numerical_spaces()]))
def space(request, spaces) -> Space:
    """Each space in turn."""
    return spaces[request.param]


@pytest.fixture(scope="session", params=members(closed_forms()))
def closed(request, spaces) -> Space:
    """Each space with closed forms in turn."""
    return spaces[request.param]
