"""Laws of the intrinsic observers: the linear error law, invariance under coordinates, order of the approximation.

Each law is tested on all observers that claim it; observers spoiled on purpose must break it.
"""

from error_law import ALPHA, BETA, worst

from covariant import models
from covariant.geometry import hyperbolic, sphere
from covariant.models import Lagrangian
from covariant.papers._errata import PrintedBallAndBeam


def on_space(space) -> Lagrangian:
    """A system on a yardstick space, with a potential so that the source term has something to transport."""
    return Lagrangian(space, lambda q: 0.4 * q[0] + 0.3 * q[0] * q[1] - 0.2 * q[1] ** 2, coordinates=("a", "b"))


SYSTEMS = {
    "sphere": on_space(sphere()),
    "hyperbolic plane": on_space(hyperbolic()),
    "ball and beam": models.ball_and_beam(),
    "double pendulum": models.pendulum_chain((1.0, 0.7), (0.5, 0.4)),
}


def test_the_printed_ball_and_beam():
    """Equation (14) as printed breaks the law; with the sign of (5) it keeps it."""
    model = SYSTEMS["ball and beam"]
    printed, corrected = (worst(PrintedBallAndBeam(ALPHA, BETA, sign), model, 3.0) for sign in (1, -1))
    assert printed > 1e-2
    assert corrected <= 1e-4


# Invariance under coordinates.
