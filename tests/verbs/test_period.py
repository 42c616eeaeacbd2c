"""An encoder that begins anew is read as one that goes on, by every verb and by the exported code."""

import numpy as np
import pandas as pd
import pytest

import covariant
from covariant import verbs

MODEL = {f"parameters.{name}": [value] for name, value in {"mass": 1.0, "length": 0.5, "viscous": 0.05}.items()}
MODEL |= {"measurement.std": 1e-4, "uncertainty.acceleration": 0.5}
MODEL |= {"uncertainty.motion_acceleration": 20.0, "uncertainty.motion_time": 0.2}


@pytest.fixture(scope="module")
def whole():
    simulated = covariant.simulate(
        "pendulum_chain", overrides=MODEL, duration=4.0, rate=250.0, q0=[1.2], amplitude=[1.0]
    )
    return simulated.record


def test_a_draft_names_the_period_and_ticks_that_were_rounded(whole):
    tick = 360 / 4096
    angle = np.round(np.rad2deg(whole.y[:, 0]) / tick) * tick
    table = pd.DataFrame({"t": whole.t, "angle [deg]": np.round(angle % (410 * tick), 2)})
    (text,) = verbs.init(table).texts().values()
    assert "quantum = 0.00153397" in text
    assert "period = 0.6289" in text
    (text,) = verbs.init(pd.DataFrame({"t": whole.t, "angle [deg]": angle})).texts().values()
    assert "period" not in text
