"""Bounds that are none, or that no double holds: refused by name, or meant as they are written."""

import math
import warnings

import numpy as np
import pytest
from systems import ALPHA, BETA, Case, attempt, line, simulate, size_of, verdict, wheel

from scalargraph.proofs import box

USUAL = Case(lambda xp, x, v: -v).bounds()
OBSERVER = line(lambda xp, x, v: -v)

# Velocities and metrics that are none are refused in `tests/certificates`, gains in `test_streams.py`.
BAD = {
    "positions the wrong way round": {"position": (1.0, -1.0)},
    "position that is no number": {"position": (math.nan, 1.0)},
    "position without bound": {"position": (-math.inf, math.inf)},
    "one position without bound": {"position": (-1.0, math.inf)},
    "positions the wrong way round by a hair": {"position": (np.nextafter(0.1, 1), 0.1)},
    "error of nought": {"error": 0.0},
    "error below nought": {"error": -0.1},
    "error that is no number": {"error": math.nan},
    "error without bound": {"error": math.inf},
    "input that is no number": {"input": math.nan},
    "input without bound": {"input": math.inf},
    "input below nought": {"input": -1.0},
    "inputs the wrong way round": {"input": (1.0, -1.0)},
    "times the wrong way round": {"times": (1.0, 0.0)},
    "time that is no number": {"times": (0.0, math.nan)},
    "rate that is no number": {"rate": math.nan},
    "rate of nought": {"rate": 0.0},
    "rate below nought": {"rate": -2.0},
    "rate without bound": {"rate": math.inf},
    "two positions for one": {"position": (np.zeros(2), np.ones(2))},
    "two errors for one": {"error": np.array([0.1, 0.2])},
}


@pytest.mark.parametrize("name", BAD)
def test_bad_bounds_are_refused(name):
    with np.errstate(all="ignore"):
        assert verdict(OBSERVER, **(USUAL | BAD[name])) in ("refused", "fails")


@pytest.mark.parametrize(
    "bounds", [{"x": (1.0, 0.0)}, {"x": (math.nan, 1.0)}, {"x": (0.0, math.inf)}, {"x": (np.nextafter(0.1, 1), 0.1)}]
)
def test_boxes_that_are_none_are_refused(bounds):
    with pytest.raises(ValueError, match="bounds of x must be finite"):
        box(**bounds)


UNUSUAL = {
    "one position": {"position": (0.25, 0.25)},
    "one input": {"input": (0.5, 0.5)},
    "a hair above a tenth": {"error": np.nextafter(0.1, 1)},
    "position that no double holds": {"position": (-0.1, np.nextafter(0.1, 1))},
    "little error": {"error": 1e-6},
}


@pytest.mark.core(1)
@pytest.mark.long("one position")
@pytest.mark.parametrize("name", UNUSUAL)
def test_unusual_bounds_are_meant_as_they_are_written(name):
    assert verdict(OBSERVER, **(USUAL | UNUSUAL[name])) == "holds"


EXTREME = {
    "least error": {"error": 5e-324},
    "denormal error": {"error": 1e-310},
    "little velocity": {"velocity": 1e-300},
    "large velocity": {"velocity": 1e300},
    "large position": {"position": (-1e300, 1e300)},
    "largest position": {"position": (-1.7e308, 1.7e308)},
    "large input": {"input": 1e300},
    "large error": {"error": 1e300},
}


@pytest.mark.core(1)
@pytest.mark.parametrize("name", EXTREME)
def test_extreme_bounds_are_no_accident(name):
    """The statement is true: any verdict will do but "fails", and no radius that is no number."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        found = attempt(OBSERVER, **(USUAL | EXTREME[name]))
    assert found is None or found.statement.verdict != "fails"
    assert found is None or np.isfinite(found.radius)


BEYOND = {
    "error below the last digit of the place": (1.0, 1e-17),
    "error of a few last digits": (1.0, 3e-16),
    "error below the last digit of a large place": (1e300, 0.1),
    "error below the last digit of a kilometre": (1e3, 1e-14),
}


@pytest.mark.parametrize("name", BEYOND)
def test_estimates_a_hair_beyond_the_bound_of_the_place_are_in_the_region(name):
    """Friction that drives from a quarter of the error beyond the place p: estimates get there, if p + error = p."""
    place, error = BEYOND[name]

    def law(xp, x, v):
        return -v + 2e3 * xp.maximum((x - place) - error / 4, 0.0)

    # Seen from the bound, where there are digits enough: the truth rests at nought.
    start = 0.9 * error
    run = simulate(lambda xp, x, v: -v + 2e3 * xp.maximum(x - error / 4, 0.0), 0.0, 0.0, start, 0.0, hold=True)
    distance = size_of(run.xi, run.zeta)
    assert distance[-1] > 5 * distance[0]
    assert verdict(line(law), velocity=1.0, error=error, position=(-place, place), input=1.0) != "holds"


def test_a_velocity_a_hair_beyond_its_bound_is_in_the_region():
    def law(xp, x, v):
        return -v + 200 * xp.maximum(v - 1.0, 0.0)

    for error in (1e-17, 1e-12):
        assert verdict(line(law), velocity=1.0, error=error, position=(-1, 1), input=1.0) != "holds"


@pytest.mark.long("no rotation", "one place alone")
@pytest.mark.parametrize(
    "entries",
    [
        (np.eye(2), np.eye(2)),
        (np.ones((2, 2)), -np.ones((2, 2))),
        (np.full((2, 2), 2.0), np.full((2, 2), 3.0)),
        (np.full((2, 2), math.nan), np.ones((2, 2))),
    ],
    ids=["one place alone", "the wrong way round", "no rotation", "no number"],
)
def test_matrix_entries_of_a_group_may_not_hide_places(entries):
    """A force that is bounded from a part of the rotations speaks of that part alone, and says so, or is refused."""
    found = attempt(
        wheel(lambda xp, g, v: -v, lambda t, g, u: u + 100 * g[1, :1]), velocity=1.0, error=0.3, position=entries
    )
    assert found is None or found.statement.verdict != "holds" or found.given.positions.size


def test_gains_are_those_of_the_observer():
    found = attempt(OBSERVER, **USUAL)
    assert found is not None
    assert float(found.observer.alpha) == ALPHA
    assert float(found.observer.beta) == BETA
    assert found.statement.verdict == "holds"
