"""Strict numerics for every test, the recorded logs, and the spaces over which the laws of geometry are checked."""

import ctypes
import gc
import os
import resource
import stat
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("JAX_PLATFORMS", "cpu")
REPOSITORY = Path(__file__).parents[1]


def choose_cache() -> str:
    """A folder for compiled programs: kept between runs as that of a user, unless others can write where it lies."""
    for place in (REPOSITORY, *REPOSITORY.parents):
        status = place.stat()
        writable = status.st_mode & (stat.S_IWGRP | stat.S_IWOTH) and not status.st_mode & stat.S_ISVTX
        if writable or (hasattr(os, "getuid") and status.st_uid not in (0, os.getuid())):
            return tempfile.mkdtemp(prefix="covariant-tests-")
    return str(REPOSITORY / ".cache")


# `make clean` empties it.
if "COVARIANT_CACHE" not in os.environ:
    os.environ["COVARIANT_CACHE"] = choose_cache()

import covariant  # before JAX, which then stores its programs in the cache folder

SOURCE = Path(covariant.__file__).parent

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from beartype.claw import beartype_packages
from jaxtyping import install_import_hook

# `make exhaustive` checks types and shapes of arguments in every call, which takes time that the other suites have not.
# What the checker computes with says no shapes. A wrong type there is no `TypeError`, which would count as a refusal.
CHECKER = ("scalargraph.proofs.checker", "scalargraph.proofs._file")
if os.environ.get("COVARIANT_CHECK_SHAPES"):
    beartype_packages(CHECKER)
# Types are not checked in lowering, whose inner loops run millions of times, nor in certificates: there files are read
# that may be forged, and must be refused by what users run.
UNCHECKED = ("covariant.certificates", *CHECKER)
ROOMS = {f"covariant.{path.stem}" for path in SOURCE.iterdir() if path.suffix in ("", ".py")}
PROOFS = {f"scalargraph.proofs.{path.stem}" for path in (SOURCE.parent / "scalargraph" / "proofs").iterdir()}
if os.environ.get("COVARIANT_CHECK_SHAPES"):
    install_import_hook(sorted((ROOMS | PROOFS) - {*UNCHECKED}), "beartype.beartype")

from charts import Pullback

from covariant import geometry, models
from covariant.geometry import Budget, Metric
from covariant.geometry._geodesics import Shot, Transported

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

hypothesis.settings.register_profile("laws", derandomize=True, deadline=None, database=None, max_examples=60)
hypothesis.settings.load_profile("laws")

MOST_MAPPINGS, MOST_BYTES = 40_000, 1.15e9
"""Mappings of memory and resident bytes from which compiled programs are released; Linux allows 65 530 mappings."""
SHARE = 4.0
"""Seconds of a core from which a test is named after a run: one of the core suite should be in a file `long_*.py`."""
RELEASED = {"at": 0.0}
"""Memory of this process [bytes] after programs were released the last time."""
COLLECTED: dict[str, float] = {}
"""Seconds of a core that this process took until its first test."""


def pytest_addoption(parser):
    parser.addoption("--exhaustive", action="store_true", help="run larger members and more trials of long tests, too")
    parser.addoption("--alone", action="store_true", help="measure each test with all programs that it needs")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    """Read the marks `long` and `exhaustive`, and make each file a group that one process runs.

    Every test of a file `long_*.py` is long. With arguments, a mark is for the cases of these names, as tests show
    them, or of these parameters: of several, joined by dashes, one or some that follow each other. Of a test with the
    mark `core(n)`, n cases are not long.
    """
    asked, used = set(), set()
    cases = {(item.location[0], item.originalname, item.callspec.id) for item in items if hasattr(item, "callspec")}
    for item in items:
        for suite in ("long", "exhaustive"):
            for mark in list(item.iter_markers(suite)):
                places = {(item.location[0], item.originalname, name) for name in mark.args}
                fits = {place for place in places if _is_case(item.callspec.id, place[2], place in cases)}
                asked, used = asked | places, used | fits
                if places and not fits:
                    item.own_markers.remove(mark)
        if item.get_closest_marker("exhaustive") or item.path.name.startswith("long_"):
            item.add_marker("long")
        if not item.get_closest_marker("xdist_group"):
            item.add_marker(pytest.mark.xdist_group(item.location[0]))
    _leave_to_the_long_suite(items)
    if asked - used and not any("::" in argument for argument in config.args):
        raise pytest.UsageError(f"marks name parameters that no test has: {sorted(asked - used)}")
    more = [item for item in items if item.get_closest_marker("exhaustive") and not config.option.exhaustive]
    if more:
        config.hook.pytest_deselected(items=more)
    # What takes longest comes first, or a worker idles at the end.
    items[:] = sorted((item for item in items if item not in more), key=lambda item: "/pages/" not in item.nodeid)


def _leave_to_the_long_suite(items):
    """Of the cases of a test with the mark `core(n)`, mark all but n as long: the first, the last, and some between."""
    cases: dict[tuple[str, str], list] = {}
    for item in items:
        if not item.get_closest_marker("exhaustive"):
            cases.setdefault((item.location[0], item.originalname), []).append(item)
    for tests in cases.values():
        mark = tests[0].get_closest_marker("core")
        if mark:
            last, count = len(tests) - 1, mark.args[0]
            chosen = {round(k * last / max(count - 1, 1)) for k in range(count)}
            for k in set(range(len(tests))) - chosen:
                tests[k].add_marker("long")


def _is_case(case: str, name: str, whole: bool) -> bool:
    return case == name if whole else f"-{name}-" in f"-{case}-"


def pytest_collection_finish():
    """Of what was imported and collected nothing is garbage, so that the collector need not look at it again."""
    COLLECTED["seconds"] = sum(os.times()[:2])
    gc.collect()
    gc.freeze()
    gc.set_threshold(100_000, 20, 50)


class Clock:
    """Seconds of a core that each test takes, with the fixtures that it shares with others: who is first pays for all.

    With `--alone`, a test finds no compiled programs of the tests before it either.
    """

    def __init__(self, alone: bool):
        self.alone = alone
        self.fixtures: dict[int, float] = {}  # by identity of their definitions, which live as long as the session
        self.began = self.shared = 0.0

    @staticmethod
    def now() -> float:
        return sum(os.times()[:4])

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item, nextitem):
        if self.alone:
            jax.clear_caches()
        self.began, self.shared = self.now(), 0.0
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef, request):
        began = self.now()
        result = yield
        if fixturedef.scope != "function":
            self.fixtures[id(fixturedef)] = self.now() - began
            self.shared += self.fixtures[id(fixturedef)]
        return result

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item, call):
        if call.when == "teardown":
            used = {id(each) for defs in item._fixtureinfo.name2fixturedefs.values() for each in defs}
            own = self.now() - self.began - self.shared
            needs = own + sum(self.fixtures.get(each, 0.0) for each in used)
            item.user_properties.append(("seconds", (own + self.shared, needs)))
        return (yield)


class Summary:
    """After a run, where its seconds of a core went: by room, by file, by test; and the memory of each process."""

    def __init__(self):
        self.began = time.monotonic()
        self.rooms: dict[str, Counter[str]] = {"tests": Counter(), "seconds": Counter()}
        self.files: Counter[str] = Counter()
        self.tests: dict[str, float] = {}
        self.processes: list[tuple[float, float]] = []

    def pytest_runtest_logreport(self, report):
        seconds = dict(report.user_properties).get("seconds")
        if report.when == "teardown" and seconds:
            file = report.nodeid.partition("::")[0]
            room = "/".join(file.split("/")[1:-1]) or "house"
            self.rooms["tests"][room] += 1
            self.rooms["seconds"][room] += seconds[0]
            self.files[file] += seconds[0]
            self.tests[report.nodeid.partition("@tests/")[0]] = seconds[1]

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node, error):
        """A process of several that run the tests has ended."""
        self.processes.append(getattr(node, "workeroutput", {}).get("process", (0.0, 0.0)))

    def pytest_terminal_summary(self, terminalreporter):
        write = terminalreporter.line
        terminalreporter.section(f"{self.files.total():.0f} seconds of a core in tests")
        for room, seconds in self.rooms["seconds"].most_common():
            write(f"{seconds:7.1f} s {self.rooms['tests'][room]:6d} tests  {room}")
        write("of these, in files:")
        for file, seconds in self.files.most_common(12):
            write(f"{seconds:7.1f} s  {file}")
        over = sorted((-seconds, test) for test, seconds in self.tests.items() if seconds > SHARE)
        if over:
            write(f"with all that they need, more than {SHARE:g} each:")
        for seconds, test in over:
            write(f"{-seconds:7.1f} s  {test}")
        for before, memory in self.processes or [measure_process()]:
            write(f"a process: {before:.0f} s of a core until its first test, {memory:.2f} GB at most")
        write(f"{time.monotonic() - self.began:.0f} s in all")


def measure_process() -> tuple[float, float]:
    """Seconds of a core until the first test of this process, and its largest memory [GB]."""
    return COLLECTED.get("seconds", 0.0), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


def pytest_sessionfinish(session):
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["process"] = measure_process()


def pytest_configure(config):
    config.pluginmanager.register(Clock(config.option.alone))
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(Summary())


def resident() -> float:
    """Memory of this process [bytes], 0 where the system does not say."""
    statm = Path("/proc/self/statm")
    return int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") if statm.exists() else 0.0


def release_programs():
    jax.clear_caches()
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None
    if trim is not None:
        trim(0)  # glibc keeps what was freed, two thirds of it, and compilation takes new pages
    RELEASED["at"] = resident()


@pytest.fixture(autouse=True)
def release_memory():
    """Release compiled programs where they hold much memory. Others, such as the operations of JAX on small arrays, are
    used again by the tests that follow."""
    yield
    if resident() > max(MOST_BYTES, RELEASED["at"] + MOST_BYTES / 5):
        release_programs()


@pytest.fixture(scope="module", autouse=True)
def release_mappings():
    """Release compiled programs where they hold many mappings."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > MOST_MAPPINGS:
        release_programs()


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
        "plane, curved chart": (Pullback(geometry.Euclidean(), shears, unshears), np.zeros(2), 0.8),
        "sphere": (geometry.sphere(), np.zeros(2), 0.9),
        "sphere, curved chart": (Pullback(geometry.sphere(), shears, unshears), np.zeros(2), 0.6),
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
    fly: Callable[..., Transported]
    shoot: Callable[..., Shot]

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
"""Spaces that add little to the others; with the triple pendulum, the largest, they are exhaustive."""


def members(names) -> list:
    return [pytest.param(n, marks=pytest.mark.exhaustive) if n in (*FEW, "triple pendulum") else n for n in names]


@pytest.fixture(scope="session", params=members([*closed_forms(), *numerical_spaces()]))
def space(request, spaces) -> Space:
    """Each space in turn."""
    return spaces[request.param]


@pytest.fixture(scope="session", params=members(closed_forms()))
def closed(request, spaces) -> Space:
    """Each space with closed forms in turn."""
    return spaces[request.param]
