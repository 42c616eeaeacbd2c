"""What takes long of `test_closed_loops.py`."""

import jax.numpy as jnp
import numpy as np
import pytest
from test_closed_loops import four_bar, observer, reduced

from covariant import certificates, observers
from scalargraph import lower, numbers


@pytest.mark.exhaustive
def test_in_the_angle_of_its_crank_the_observer_of_a_loop_is_the_same_to_first_order(four_bar):
    # One freedom has no curvature, and that of the loop would take most of the time.
    space, single = four_bar.space, observers.Intrinsic(reduced(), 20.0, 200.0, curvature=False)
    loop = observers.Intrinsic(four_bar, 20.0, 200.0, curvature=False)
    q, theta, torque = space.assembly, space.assembly[:1], jnp.array([0.01])
    along = space.projected(q, jnp.array([1.0, 0.0, 0.0]))
    v, at_rest = 0.8 * along / along[0], single.init(theta)

    def change(error):
        """Velocity and acceleration of the crank by the observer of the loop, and by that in its angle."""
        measured = jnp.concatenate([theta - error, jnp.full(2, jnp.nan)])
        state = at_rest._replace(q=q, v=v)
        whole = loop.flow(state.t, state, jnp.pad(torque, (0, 2)), measured)
        # The flow keeps the loop closed to first order in the error, and the projection after each step entirely.
        turn = space.connection(q, whole.q, v)
        closed = space.projected(q, whole.v + turn) - turn
        one = single.flow(state.t, at_rest._replace(v=v[:1]), torque, theta - error)
        return jnp.stack([whole.q[0], closed[0]]) - jnp.concatenate([one.q, one.v])

    apart = np.abs(numbers(lower(change, jnp.zeros(())), np.array([[0.0], [0.01], [0.02]])))
    assert (apart[0] < 1e-10).all()
    assert (apart[2] / apart[1] > 3.5).all(), apart


@pytest.mark.exhaustive
def test_in_the_angle_of_its_crank_it_is_certified():
    certificate = certificates.certify(
        observers.Intrinsic(reduced(), 20.0, 200.0),
        **{"position": ([0.98], [1.02]), "velocity": 0.5, "error": 0.02, "input": 0.005, "rate": 2.0, "checker": "off"},
    )
    assert certificate.statement.proved
    assert certificate.radius > 2e-4
