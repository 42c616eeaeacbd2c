"""What takes long of `test_driven_dissipation.py`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from driven import boat, braked, pendulum, steered

from covariant import simulation
from covariant.certificates import certify
from covariant.models import Motion
from covariant.observers import EKF, Geodesic, Intrinsic, ModelCopy, run

STAMPS = np.linspace(0.0, 6.0, 601)


def pendulum_inputs(t, x):
    return jnp.stack([jnp.sin(2 * t), 0.3 + 0.3 * jnp.sin(t)])


def boat_inputs(t, x):
    return jnp.stack([2 + jnp.sin(t), 0.5 * jnp.cos(1.3 * t)])


CASES = {
    "pendulum": (pendulum, jnp.array([0.4, 2.0]), pendulum_inputs),
    "boat": (boat, Motion(jnp.eye(3), jnp.array([1.0, 0.2, -0.3])), boat_inputs),
}


@pytest.fixture(scope="module")
def motions():
    """Each machine, and its true motion under inputs that are held from stamp to stamp."""
    found = {}
    for name, (make, start, inputs) in CASES.items():
        held = simulation.hold(
            jnp.asarray(STAMPS), jax.vmap(lambda t, inputs=inputs: inputs(t, None))(jnp.asarray(STAMPS))
        )
        found[name] = make, simulation.simulate(make(), start, STAMPS, held, rtol=1e-9, atol=1e-10)
    return found


OBSERVERS = {
    "intrinsic": lambda model, n: Intrinsic(model, 8.0, 32.0, substeps=1),
    "geodesic": lambda model, n: Geodesic(model, 8.0, 32.0, substeps=1),
    "copy": lambda model, n: ModelCopy(model, 8.0, 32.0, substeps=1),
    "ekf": lambda model, n: EKF(model, 1e-2 * jnp.eye(n), 1e-6 * jnp.eye(n), substeps=1),
}


@pytest.mark.exhaustive
@pytest.mark.parametrize(("machine", "name"), [*(("pendulum", name) for name in OBSERVERS), ("boat", "intrinsic")])
def test_observers_evaluate_it_at_the_estimate(motions, machine, name):
    """On a noise-free log the estimate meets the truth; without the dissipation it keeps an error."""
    make, record = motions[machine]

    def velocity_error(dissipation):
        model = make(dissipation)
        n = model.manifold.zero(record.y[0]).size
        estimate = model.motion(run(OBSERVERS[name](model, n), record).estimate).v
        return float(np.abs(estimate - make().motion(record.x).v)[-100:].max())

    known = steered if make is boat else braked
    assert velocity_error(known) < 1e-5
    assert velocity_error(None) > 1e-3


@pytest.mark.exhaustive
def test_friction_alone_is_proved_either_way():
    region = {
        "position": (np.array([-0.2]), np.array([0.2])),
        "velocity": 0.2,
        "error": 0.05,
        "rate": 0.5,
        "boxes": 2000,
    }
    forms = (lambda q, v: -0.3 * v, lambda t, q, v, u: -0.3 * v)
    first, second = (certify(Intrinsic(pendulum(form), 4.0, 8.0), **region) for form in forms)
    assert all(claim.proof.verdict == "holds" for claim in first.claims)
    assert [claim.proof.boxes for claim in first.claims] == [claim.proof.boxes for claim in second.claims]
