"""The same trajectories through python-control as through the library's own simulation: what takes long."""

import jax.numpy as jnp
import numpy as np
import pytest
from test_python_control import control

from covariant import codegen, models
from covariant.models import marine, state_space
from covariant.observers import Contracting, craft_observer
from covariant.simulation import Backstepping, lissajous, observe, simulate


@pytest.mark.exhaustive
def test_plant_and_observer_interconnected_follow_the_librarys_own(control):
    model = models.StateSpace(
        lambda t, x, u: jnp.stack([x[1], u[0] - jnp.sin(x[0])]), lambda t, x, u: x[:1], coordinates=("q", "v"), inputs=1
    )
    observer = Contracting(model, jnp.array([[3.0], [2.0]]), jnp.zeros(2))
    plant = codegen.plant(model)
    estimator = codegen.observer_system(observer, model, [0.0])
    both = control.interconnect(
        [plant, estimator], inplist=["u1"], inputs=["u1"], outlist=["y1", "observer_v"], ignore_outputs=["observer_q"]
    )
    t = np.linspace(0.0, 3.0, 31)
    u = np.sin(2 * t)
    x0 = np.array([0.5, 0.2])
    response = control.input_output_response(
        both, t, u, [*x0, *estimator.initial], solve_ivp_kwargs={"rtol": 1e-9, "atol": 1e-11}
    )
    interpolated = lambda s, x: jnp.interp(s, jnp.asarray(t), jnp.asarray(u))[None]  # noqa: E731
    x, state = observe(model, observer, jnp.asarray(x0), observer.init(jnp.zeros(1)), jnp.asarray(t), interpolated)
    np.testing.assert_allclose(response.outputs[0], x[:, 0], atol=1e-6)
    np.testing.assert_allclose(response.outputs[1], state.x[:, 1], atol=1e-6)


@pytest.mark.exhaustive
def test_closed_loop_is_the_librarys_own(control):
    ship = marine.cybership()
    model = state_space(ship)
    controller = Backstepping(ship, lissajous([0.0, 0.0, 0.0], [1.0, 0.5, 0.4], 0.8), 20.0, 40.0, 0.5)
    observer = craft_observer(ship, np.eye(3), 30.0 * np.eye(3))
    x0 = np.array([0.1, 0.0, 0.1, 0.0, 0.0, 0.0])
    loop = codegen.closed_loop(model, observer, controller, x0[:3])
    t = np.linspace(0.0, 5.0, 11)
    response = control.input_output_response(
        loop, t, 0.0, loop.initial(x0), solve_ivp_kwargs={"rtol": 1e-8, "atol": 1e-10}
    )
    start = observer.init(jnp.asarray(x0[:3]))
    x, state = observe(model, observer, jnp.asarray(x0), start, jnp.asarray(t), controller=controller)
    np.testing.assert_allclose(response.outputs[:6].T, x, atol=1e-5)
    np.testing.assert_allclose(response.outputs[6:12].T, state.x, atol=1e-5)
    assert list(response.output_labels)[-3:] == ["u1", "u2", "u3"]


@pytest.mark.exhaustive
def test_linearisation_is_the_models_own(control):
    model = marine.Station(marine.supply_vessel()).model()
    linear = control.linearize(codegen.plant(model), np.zeros(6), np.zeros(3))
    a, c = model.jacobians(jnp.zeros(()), jnp.zeros(6), jnp.zeros(3))
    np.testing.assert_allclose(linear.A, a, atol=1e-5)
    np.testing.assert_allclose(linear.C, c, atol=1e-5)
    assert simulate(model, jnp.zeros(6), jnp.linspace(0.0, 1.0, 3)).y.shape == (3, 3)
