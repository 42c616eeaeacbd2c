"""What any solution of the Riccati equation obeys, for every state-space model: it solves the equation, it is a tensor,
it forgets how it was started, and windows compose."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import linalg

from covariant import models
from covariant.metrics import Equation, metric_at
from covariant.metrics._solution import Solution
from covariant.metrics._window import Window, window_at
from covariant.models import StateSpace

TIME = jnp.zeros(())


NONE = np.zeros(0)


class Case(NamedTuple):
    """A model, states whose past stays in reach, Q, R, the sizes of the states, the span of their past, and the input.

    `tolerance` of the solutions. It is coarser for Lorenz, whose past is lost to chaos backward within two seconds.
    `still`: an equilibrium and its input, or None where little or nothing is seen at rest.
    """

    model: StateSpace
    x: np.ndarray
    process_cov: np.ndarray
    measurement_cov: np.ndarray
    size: np.ndarray
    span: float
    u: np.ndarray = NONE
    tolerance: float = 1e-9
    still: tuple[np.ndarray, np.ndarray] | None = None


def van_der_pol():
    return StateSpace(
        lambda t, x, u: jnp.stack([x[1], (1 - x[0] ** 2) * x[1] - x[0]]), lambda t, x, u: x[:1], coordinates=("q", "v")
    )


def bioreactor():
    """Biomass and substrate, with Haldane's kinetics; per hour: Bequette 1998, Process dynamics, module 8."""

    def f(t, x, u):
        growth = 0.53 * x[1] / (0.12 + x[1] + 0.4545 * x[1] ** 2)
        return jnp.stack([growth * x[0] - u[0] * x[0], u[0] * (4.0 - x[1]) - growth * x[0] / 0.4])

    return StateSpace(f, lambda t, x, u: x[1:], coordinates=("biomass", "substrate"), inputs=1)


def steady_bioreactor(substrate=1.0):
    growth = 0.53 * substrate / (0.12 + substrate + 0.4545 * substrate**2)
    return np.array([0.4 * (4.0 - substrate), substrate]), np.array([growth])


def induction_motor():
    """Currents [A], rotor fluxes [Wb] and speed [rad/s], of very different sizes: Marino, Peresada & Valigi 1993."""
    resistances, inductance, mutual, inertia = np.array([0.18, 0.15]), 0.0699, 0.068, 0.0586
    coupling = mutual / inductance
    leakage = inductance - coupling * mutual

    def f(t, x, u):
        current, flux, speed = x[:2], x[2:4], x[4]
        turned = jnp.stack([-flux[1], flux[0]])
        flux_rate = resistances[1] / inductance * (mutual * current - flux) + speed * turned
        current_rate = (u - resistances[0] * current - coupling * flux_rate) / leakage
        return jnp.concatenate([current_rate, flux_rate, (coupling / inertia * (turned @ current))[None]])

    return StateSpace(f, lambda t, x, u: x[:2], coordinates=("ia", "ib", "fa", "fb", "speed"), inputs=2)


def make_case(model, x, process_cov, measurement_cov, size, span, **more) -> Case:
    """From numbers and lists: of covariances their diagonals, and one size of all states or one of each."""
    x, r = np.array(x), np.asarray(measurement_cov)
    sizes = np.broadcast_to(np.asarray(size, float), x.shape[1:])
    q = np.diag(np.broadcast_to(np.asarray(process_cov, float), sizes.shape))
    return Case(model, x, q, r if r.ndim else np.full((1, 1), r), sizes, span, **more)


FAR = np.sqrt(72.0)
CASES = {
    "unknown frequency": make_case(models.unknown_frequency(), [[0.5, 1.2, 0.8], [0.0, 1.0, 1.5]], 0.5, 1.0, 1.0, 20.0),
    "van der Pol": make_case(van_der_pol(), [[1.0, 0.5], [-1.5, 0.3]], 1.0, 1.0, 1.0, 12.0, still=(np.zeros(2), NONE)),
    "Lorenz": make_case(
        *(models.lorenz(), [[-8.96698, -2.81122, 33.95637]], 100.0, 0.01, 40.0, 0.8),
        tolerance=1e-4,
        still=(np.array([FAR, FAR, 27.0]), NONE),
    ),
    "Duffing": make_case(
        *(models.duffing(), [[1.0, 0.5], [-0.5, 0.3]], 1.0, 0.1, 4.0, 8.0),
        u=np.array([0.2]),
        still=(np.array([1.2, 0.0]), np.array([1.2**3 - 1.2])),
    ),
    "bioreactor": make_case(
        *(bioreactor(), [[1.2, 1.0]], 0.1, 0.01, 8.0, 13.0),
        u=np.array([0.3]),
        still=steady_bioreactor(),
    ),
    "induction motor": make_case(
        *(induction_motor(), [[12.0, -40.0, 1.1, 0.4, 180.0], [5.0, 10.0, 0.5, 0.8, 50.0]]),
        *([1e4, 1e4, 10.0, 10.0, 1e5], [[1e-2, 3e-3], [3e-3, 1e-2]], [1e4, 1e4, 20.0, 20.0, 2e3], 0.045),
        u=np.array([100.0, 50.0]),
    ),
}


class Chart(NamedTuple):
    """Coordinates z = unit · lower(upper(x / size)) with two triangular cubic maps, which have exact inverses."""

    unit: jax.Array
    upper: jax.Array
    lower: jax.Array
    gain: jax.Array


def to_chart(chart, size, x):
    a = x / size
    a = a.at[:-1].add(chart.upper * a[1:] ** 3)
    rows = [a[0]]
    for k in range(1, len(a)):
        rows.append(a[k] + chart.lower[k - 1] * a[k - 1] ** 3)
    return chart.unit * jnp.stack(rows)


def from_chart(chart, size, z):
    b = z / chart.unit
    a = [b[0]]
    for k in range(1, len(b)):
        a.append(b[k] - chart.lower[k - 1] * a[k - 1] ** 3)
    xi = [a[-1]]
    for k in range(len(b) - 2, -1, -1):
        xi.insert(0, a[k] - chart.upper[k] * xi[0] ** 3)
    return size * jnp.stack(xi)


def in_chart(model, chart, size):
    """The model in the coordinates z, with its output times `gain`."""

    def back(z):
        return from_chart(chart, size, z)

    def f(t, z, u):
        x = back(z)
        return jax.jvp(lambda y: to_chart(chart, size, y), (x,), (model.f(t, x, u),))[1]

    return StateSpace(f, lambda t, z, u: chart.gain * model.h(t, back(z), u), inputs=model.inputs)


class Task(NamedTuple):
    """One solution to compute: at x with input u, in a chart, from a starting metric (in that chart)."""

    x: jax.Array
    u: jax.Array
    start: jax.Array
    chart: Chart


class Answer(NamedTuple):
    """The solution in its own chart, and the metric carried back to x."""

    solution: Solution
    metric: jax.Array


@eqx.filter_jit
def solve(model, tolerance, tasks, size, process_cov, measurement_cov) -> Answer:
    def one(task):
        chart = task.chart
        jacobian = jax.jacfwd(lambda x: to_chart(chart, size, x))

        def noise(z):
            j = jacobian(from_chart(chart, size, z))
            return j @ process_cov @ j.T

        equation = Equation(process_cov=noise, measurement_cov=chart.gain**2 * measurement_cov)
        z = to_chart(chart, size, task.x)
        found = metric_at(
            in_chart(model, chart, size), equation, z, start=task.start, tolerance=tolerance, u=task.u, max_steps=1000
        )
        j = jacobian(task.x)
        return Answer(found, j.T @ found.metric @ j)

    return jax.vmap(one)(tasks)


@eqx.filter_jit
def windows(model, x, lengths, u, process_cov, measurement_cov):
    equation = Equation(process_cov=process_cov, measurement_cov=measurement_cov)
    one = jax.vmap(lambda x, length: window_at(model, equation, x, length, 600, u), (None, 0))
    return jax.vmap(one, (0, None))(x, lengths)


def distances(a, b):
    """Affine-invariant distances of two stacks of metrics, by numpy."""
    half = np.linalg.inv(np.linalg.cholesky(np.asarray(a)))
    return np.sqrt((np.log(np.linalg.eigvalsh(half @ np.asarray(b) @ half.swapaxes(-1, -2))) ** 2).sum(-1))


SHARES = np.array([0.3, 0.45, 0.6, 0.75])
"""Lengths of windows as shares of the span; the first and the second make the fourth."""
STEP = 1e-3
"""Step of the finite differences along the motion, as a share of the span."""


class Found(NamedTuple):
    """What the laws are about, for one model: answers by name, each for every state, and windows of several lengths."""

    case: Case
    answers: dict[str, Answer]
    windows: Window
    before: Window


def plain(case, **more):
    n = len(case.size)
    chart = Chart(case.size, np.zeros(n - 1), np.zeros(n - 1), np.ones(()))
    return chart._replace(**more)


def all_at_once(case, groups):
    """Answers by name for {name: (states, input, start, chart)}: one program, run once."""
    tasks = [Task(x, u, start, chart) for states, u, start, chart in groups.values() for x in states]
    stacked = jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf, float) for leaf in leaves]), *tasks)
    found = solve(
        case.model, case.tolerance, stacked, *map(jnp.asarray, (case.size, case.process_cov, case.measurement_cov))
    )
    ends = np.cumsum([len(group[0]) for group in groups.values()])
    return {
        name: jax.tree.map(lambda leaf, end=end, group=group: np.asarray(leaf[end - len(group[0]) : end]), found)
        for (name, group), end in zip(groups.items(), ends, strict=True)
    }


@pytest.fixture(scope="module", params=CASES)
def found(request) -> Found:
    case = CASES[request.param]
    n, rng = len(case.size), np.random.default_rng(5)
    start = np.diag(1 / case.size**2)
    cubic = plain(case, upper=rng.uniform(-0.3, 0.3, n - 1), lower=rng.uniform(-0.3, 0.3, n - 1))
    units = plain(case, unit=case.size * 1000.0 ** rng.integers(-1, 2, n))
    noise = jnp.asarray(case.process_cov), jnp.asarray(case.measurement_cov)

    def windows_before(x):
        found = windows(case.model, jnp.asarray(x), jnp.asarray(case.span * SHARES), jnp.asarray(case.u), *noise)
        return jax.tree.map(np.asarray, found)

    near = windows_before(case.x)
    earlier = near.x[:, 0]
    rate = np.stack([case.model.f(TIME, jnp.asarray(x), jnp.asarray(case.u)) for x in case.x])
    groups = {
        "itself": (case.x, case.u, start, plain(case)),
        "low start": (case.x, case.u, 1e-3 * start, plain(case)),
        "high start": (case.x, case.u, 1e3 * start, plain(case)),
        "cubic chart": (case.x, case.u, start, cubic),
        "other units": (case.x, case.u, start, units),
        "louder output": (case.x, case.u, start, plain(case, gain=np.array(37.0))),
        "earlier": (earlier, case.u, start, plain(case)),
        **{f"{k:+d}": (case.x + k * STEP * case.span * rate, case.u, start, plain(case)) for k in (-2, -1, 1, 2)},
    }
    if case.still is not None:
        groups["at rest"] = (case.still[0][None], case.still[1], start, plain(case))
    return Found(case, all_at_once(case, groups), near, windows_before(earlier))


def star(near, far):
    """Redheffer's star product: the window that is `far` followed by `near`."""
    mix = np.linalg.inv(np.eye(len(near.spread)) + near.spread @ far.information)
    transition = far.transition @ mix @ near.transition
    information = near.information + near.transition.T @ far.information @ mix @ near.transition
    spread = far.spread + far.transition @ mix @ near.spread @ far.transition.T
    return transition, information, spread


@pytest.mark.exhaustive("induction motor")
@pytest.mark.long("Duffing", "Lorenz", "induction motor", "van der Pol", "bioreactor", "unknown frequency")
def test_windows_compose(found):
    """The window of 0.3 of the span, after that of 0.45 before it, is the window of 0.75."""
    half = 1 / found.case.size
    for k in range(len(found.case.x)):
        near, far, whole = (
            jax.tree.map(lambda leaf, k=k, j=j: leaf[k, j], which)
            for which, j in ((found.windows, 0), (found.before, 1), (found.windows, 3))
        )
        np.testing.assert_allclose(half * far.x, half * whole.x, rtol=0, atol=1e-5)
        scales = (np.outer(half, 1 / half), np.outer(1 / half, 1 / half), np.outer(half, half))
        for one, other, scale in zip(star(near, far), whole[1:], scales, strict=True):
            a, b = one * scale, other * scale
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-5 * np.abs(b).max())


@pytest.mark.long("Lorenz", "van der Pol", "bioreactor", "unknown frequency")
@pytest.mark.exhaustive("induction motor")
def test_the_metric_is_a_fixed_point(found):
    """Lemma 4.3: the window maps the metric at its beginning to the metric at its end."""
    for k, earlier in enumerate(found.answers["earlier"].metric):
        window = jax.tree.map(lambda leaf, k=k: jnp.asarray(leaf[k, 0]), found.windows)
        mapped = window.metric(jnp.asarray(earlier))
        assert distances(found.answers["itself"].metric[k], mapped) < max(1e-6, 3 * found.case.tolerance)
        assert distances(found.answers["itself"].metric[k], window.metric(1.0)) > 1e-4


def stationary_information(case):
    """P at rest by the algebraic Riccati equation of the stationary Kalman filter."""
    x, u = (jnp.asarray(part) for part in case.still)
    a, c = case.model.jacobians(TIME, x, u)
    cov = linalg.solve_continuous_are(a.T, c.T, case.process_cov, case.measurement_cov)
    return np.linalg.inv(cov), a - cov @ c.T @ np.linalg.inv(case.measurement_cov) @ c


AT_REST = [name for name, case in CASES.items() if case.still is not None]


@pytest.mark.exhaustive("bioreactor")
@pytest.mark.long("Lorenz", "van der Pol", "bioreactor")
@pytest.mark.parametrize("found", AT_REST, indirect=True)
def test_at_rest_it_is_the_stationary_kalman_filters(found):
    exact, _ = stationary_information(found.case)
    assert distances(found.answers["at rest"].metric, exact[None]).max() < 3 * found.case.tolerance
