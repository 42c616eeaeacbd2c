"""What takes long of `test_reduced_order.py`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_reduced_order import BOXES, designed

from covariant import models
from covariant.certificates import reduced_order
from covariant.certificates.theory import _reduced_order
from covariant.observers import Contracting


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["lorenz", "duffing"])
def test_the_full_observer_contracts_in_the_box(name):
    rate, bounds = BOXES[name]
    design = reduced_order(getattr(models, name)(), rate, full=True, **bounds)
    assert design.full.proved
    assert design.gain > 0
    model = design.model
    observer = Contracting(model, jnp.asarray(design.gain * design.direction), jnp.zeros(len(model.coordinates)))
    weights = design.weights
    shear = np.eye(len(model.coordinates))
    shear[np.ix_(design.unmeasured, design.measured)] = -design.injection
    block = np.zeros_like(shear)
    block[np.ix_(design.measured, design.measured)] = np.diag(weights)
    block[np.ix_(design.unmeasured, design.unmeasured)] = design.metric
    metric = shear.T @ block @ shear
    box = np.asarray(model.box, float)
    random = np.random.default_rng(2)

    def growth(x, u):
        slope = jax.jacfwd(lambda x: observer.virtual(jnp.zeros(()), x, u, jnp.zeros(len(model.outputs))))(x)
        form = metric @ slope
        return jnp.linalg.eigvalsh(-(form + form.T) - rate / 2 * metric)[0]

    x = jnp.asarray(random.uniform(box[:, 0], box[:, 1], (500, len(box))))
    u = jnp.asarray(random.uniform(-1, 1, (500, model.inputs)))
    assert np.asarray(jax.vmap(growth)(x, u)).min() > 0


@pytest.mark.exhaustive
@pytest.mark.parametrize(("name", "sign", "rate"), [("unknown_frequency", -1, 0.1), ("lorenz", 1, 30.0)])
def test_a_wrong_injection_and_a_rate_that_is_too_high_are_not_proved(name, sign, rate, monkeypatch, designed):
    design = designed(name)
    monkeypatch.setattr(_reduced_order, "_solved", lambda *_: (sign * design.injection, design.metric))
    with pytest.raises(ValueError, match="after 8 counterexamples there is still one"):
        reduced_order(design.model, rate, **BOXES[name][1])


@pytest.mark.exhaustive
def test_the_velocity_of_a_pendulum_is_found_in_the_box():
    arm = models.state_space(models.pendulum_chain(mass=[1.0], length=[0.5]))
    design = reduced_order(arm, 2.0, box=[(-3.2, 3.2), (-5.0, 5.0)], inputs=[(-5.0, 5.0)])
    assert design.statement.proved
    # One joint has no forces of its velocity, but f is written with products of it: where they end nothing is claimed.
    assert "estimates may be in the box" in str(design.statement)
