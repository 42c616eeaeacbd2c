"""geomstats' own tests of Riemannian metrics, unmodified, on metrics of this library.

Its `RiemannianMetricTestCase` asks of a metric what is true of every one: distances, geodesics there and back, parallel
transport, symmetries of the curvature, and that all of it takes batches. The metrics are those of closed forms and of
two robots. Hyperbolic space has the chart of geomstats' own Poincaré ball, so the two are compared besides, by its
`RiemannianMetricComparisonTestCase`. Tests that need a table of expected numbers are left out: such tables are not part
of the package.

Source: Miolane et al. 2020, Geomstats, Journal of Machine Learning Research 21(223).
"""

import inspect
import sys
from importlib.metadata import version

import geomstats.backend as gs
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from geomstats.geometry.base import VectorSpace
from geomstats.geometry.euclidean import Euclidean
from geomstats.geometry.poincare_ball import PoincareBall
from geomstats.geometry.riemannian_metric import RiemannianMetric
from geomstats.test_cases.geometry.riemannian_metric import (
    RiemannianMetricComparisonTestCase,
    RiemannianMetricTestCase,
)
from outcome import Outcome, command_line

from covariant import geometry, models
from covariant.geometry import Budget
from covariant.signals import StepCode

SIZES = {"n_points": (1, 3), "n_times": (1, 4), "n_reps": (2,), "atol": (1e-6,)}
"""What the tests are asked with: numbers of points, times and repetitions, and its usual tolerance."""
BUDGET = Budget(newton=10, steps=32)
POSTURE = {f"panda_joint{i}": angle for i, angle in ((1, 0.0), (3, 0.3), (5, 0.0), (7, 0.8))}
"""Joints of the Panda that stand still [rad]."""


class Chart(VectorSpace):
    """The coordinates (n,) in which a metric of this library is written; random points lie within `size` of 0."""

    def __init__(self, metric, dim, size):
        super().__init__(shape=(dim,), dim=dim, equip=False)
        self.size = size
        self.metric = Adapter(self, metric)

    def random_point(self, n_samples=1, bound=1.0):
        return self._random(n_samples)

    def random_tangent_vec(self, base_point=None, n_samples=1):
        count = len(base_point) if base_point is not None and base_point.ndim > 1 else n_samples
        return self._random(count)

    def _create_basis(self):
        return gs.eye(self.dim)

    def _random(self, count):
        outcome = self.size * gs.random.uniform(-1, 1, (count, self.dim)) / np.sqrt(self.dim)
        return outcome if count > 1 else outcome[0]


class Adapter(RiemannianMetric):
    """A metric of this library under the names, and with the batches, of geomstats."""

    def __init__(self, space, metric):
        super().__init__(space)
        eye = jnp.eye(space.dim)

        def on_axes(f, count):
            """A multilinear map (x, a, b, …) on all axes of its vectors, the index of the first vector first."""
            return lambda x: nested(f, count)(x, *(eye,) * count)

        def transport(x, velocity, w):
            return metric.transport_along(x, velocity, w[None], BUDGET).w[0]

        self._matrix = batched(metric)
        # The contravariant index comes first in a Christoffel symbol, and last in a Riemann tensor.
        self._slopes = batched(jax.jacfwd(metric))
        self._christoffels = batched(lambda x: jnp.moveaxis(on_axes(metric.connection, 2)(x), -1, 0))
        self._riemann = batched(lambda x: jnp.moveaxis(on_axes(metric.curvature, 3)(x), 2, 0))
        self._exp = batched(lambda x, a: metric.transport_along(x, a, a[None], BUDGET).q)
        self._shoot = batched(lambda x, y: metric.shoot(x, y, None, BUDGET))
        self._transport = batched(transport)

    def metric_matrix(self, base_point=None):
        return self._matrix(base_point)

    def inner_product_derivative_matrix(self, base_point=None):
        return self._slopes(base_point)

    def christoffels(self, base_point=None):
        return self._christoffels(base_point)

    def riemann_tensor(self, base_point=None):
        return self._riemann(base_point)

    def exp(self, tangent_vec, base_point):
        return self._exp(base_point, tangent_vec)

    def log(self, point, base_point):
        shot = self._shoot(base_point, point)
        if not np.all(shot.result == int(StepCode.OK)):
            raise ValueError("no geodesic was found between two of the points")
        return shot.velocity

    def parallel_transport(self, tangent_vec, base_point, direction=None, end_point=None):
        along = self.log(end_point, base_point) if direction is None else direction
        return self._transport(base_point, along, tangent_vec)


def nested(f, count):
    """f(x, a, b, …) for all combinations of the rows of its vectors, an axis of the result for each vector."""
    for k in range(count, 0, -1):
        f = jax.vmap(f, in_axes=tuple(0 if i == k else None for i in range(count + 1)))
    return f


def batched(f):
    """A function of vectors for any batch of them that broadcasts, compiled; in and out NumPy."""
    compiled = jax.jit(jax.vmap(f))

    def call(*vectors):
        shape = np.broadcast_shapes(*(np.shape(a)[:-1] for a in vectors))
        rows = [np.broadcast_to(a, (*shape, np.shape(a)[-1])).reshape(-1, np.shape(a)[-1]) for a in vectors]
        return jax.tree.map(lambda part: np.asarray(part).reshape((*shape, *part.shape[1:])), compiled(*rows))

    return call


def robot(name, **arguments):
    return models.robots.load(name, **arguments).space


SPACES = {
    "euclidean": lambda: Chart(geometry.Euclidean(), 3, 1.0),
    "torus": lambda: Chart(geometry.FlatTorus(jnp.full(2, 2 * jnp.pi)), 2, 0.7),
    "sphere": lambda: Chart(geometry.sphere(), 3, 0.6),
    "hyperbolic": lambda: Chart(geometry.hyperbolic(), 3, 0.6),
    "product": lambda: Chart(
        geometry.Product((geometry.sphere(), geometry.hyperbolic(0.5), geometry.Euclidean()), (2, 2, 1)), 5, 0.6
    ),
    "scara": lambda: Chart(robot("scara"), 4, 0.6),
    "panda": lambda: Chart(robot("panda", lock=POSTURE), 3, 0.5),
}


def pytest_generate_tests(metafunc):
    for name, sizes in SIZES.items():
        if name in metafunc.fixturenames:
            metafunc.parametrize(name, sizes)


@pytest.mark.usefixtures("each_space")
class TestMetric(RiemannianMetricTestCase):
    """Every test that needs no table, on each of `SPACES`."""


@pytest.mark.usefixtures("each_pair")
class TestComparison(RiemannianMetricComparisonTestCase):
    """The same on each of `PAIRS`, one of ours and one of theirs."""


@pytest.fixture(scope="class", params=SPACES)
def each_space(request):
    gs.random.seed(1)
    request.cls.space = SPACES[request.param]()


PAIRS = {
    "euclidean": (lambda: Chart(geometry.Euclidean(), 3, 1.0), lambda: Euclidean(3)),
    "poincare ball": (lambda: Chart(geometry.hyperbolic(), 3, 0.6), lambda: PoincareBall(3)),
}


@pytest.fixture(scope="class", params=PAIRS)
def each_pair(request):
    gs.random.seed(1)
    request.cls.space, request.cls.other_space = (make() for make in PAIRS[request.param])


LACKING = ("curvature_derivative", "injectivity_radius", "parallel_transport")
"""What geomstats does not have for its own spaces, and so cannot compare."""


TABLES = "they compare with tables of expected numbers, which are not part of the package"
ABSENT = "geomstats does not have these for its own spaces"


class Selection:
    """Leaves out the tests that need a table of expected numbers, and comparisons with what is `LACKING`; counts."""

    def __init__(self, outcome: Outcome):
        self.outcome, self.counts = outcome, {}

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, config, items):
        tables = [i for i in items if not set(inspect.signature(i.function).parameters) <= {"self", *SIZES}]
        others = [i for i in items if i not in tables]
        absent = [i for i in others if i.cls.__name__ == "TestComparison" and any(name in i.name for name in LACKING)]
        for name, left, why in (("tests with tables", tables, TABLES), ("comparisons", absent, ABSENT)):
            self.outcome.left_out(name, len(left), why)
        out = {*tables, *absent}
        config.hook.pytest_deselected(items=[*out])
        items[:] = [item for item in items if item not in out]

    def pytest_runtest_logreport(self, report):
        """Count a case where it ran, or where it failed before it ran."""
        if report.when != "call" and report.outcome != "failed":
            return
        where, name = report.nodeid.split("::")[-2:]
        labels = name.partition("[")[2].rstrip("]").split("-")
        [space] = {*SPACES, *PAIRS} & {*labels}
        kind = "robots" if space in ROBOTS else "comparison" if where == "TestComparison" else "spaces"
        ran, passed = self.counts.get((kind, space), (0, 0))
        self.counts[kind, space] = ran + 1, passed + (report.outcome == "passed")
        self.outcome.case(f"{where}.{name}", report.outcome == "passed")


ROBOTS = ("scara", "panda")


def main() -> int:
    """Run all of them."""
    jax.config.update("jax_enable_x64", True)
    arguments = command_line()
    outcome = Outcome(f"geomstats {version('geomstats')}")
    options = ["-q", "-p", "no:cacheprovider", "-c", "/dev/null", "--rootdir", ".", "-o", "markers=random\nvec"]
    selection = Selection(outcome)
    code = pytest.main([*options, __file__], plugins=[selection])
    rows = [(kind, space, ran, passed) for (kind, space), (ran, passed) in sorted(selection.counts.items())]
    outcome.table("Tests of Riemannian metrics", ("kind", "space", "cases", "passed"), rows)
    for kind, least in (("spaces", 70), ("robots", 40)):
        count = sum(row[2] for row in rows if row[0] == kind)
        outcome.case(f"at least {least} cases on {kind}: {count} ran", count >= least)
    outcome.write(arguments.out)
    return code


if __name__ == "__main__":
    sys.exit(main())
