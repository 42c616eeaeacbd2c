"""What `check` and `fit` print of right and of damaged logs has no word of another kind of machine."""

import numpy as np
import pytest
from test_names import KINDS, NEEDED, OF_A_ROBOT

import covariant
from covariant.models.files._systems import OF_LINKS

pytestmark = pytest.mark.long
MECHANICAL = [name for name, kind in KINDS.items() if kind.file.mechanical and name not in OF_LINKS]


@pytest.mark.parametrize("name", MECHANICAL)
def test_a_check_has_no_word_of_joints(name):
    log = covariant.simulate(name, duration=5.0, rate=100.0, overrides=NEEDED.get(name, {}), noise=1e-4).record
    held = np.array(log.y)
    held[200:300] = held[200]
    for damaged in (log, log._replace(t=1e3 * log.t), log._replace(y=held), log._replace(y=held[:1].repeat(501, 0))):
        text = str(covariant.check(name, damaged, overrides=NEEDED.get(name, {})))
        assert not OF_A_ROBOT.search(text), text


FITTED = [("oscillator", "stiffness", 1.2), ("ball_and_beam", "inertia", 0.9), ("ship", "rudder", 120.0)]


@pytest.mark.parametrize(("name", "number", "first"), FITTED)
def test_a_fit_has_no_word_of_joints(name, number, first):
    log = covariant.simulate(name, duration=5.0, rate=50.0, noise=1e-4).record
    text = str(covariant.fit(name, log, number, overrides={f"parameters.{number}": first}))
    assert not OF_A_ROBOT.search(text), text
