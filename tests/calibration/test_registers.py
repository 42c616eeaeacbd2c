"""How columns were read: codings of signs, resolutions, stamps that count or begin anew, rows made from others.

Logs of one pendulum, with faults that a generator draws: no case is known to the code by a line of its own.
"""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pandas
import pytest
from logs_with_faults import PERIOD, inputs, made

import covariant
from covariant import logs
from covariant.calibration import diagnose, draft
from covariant.models import ModelFile, load

ROWS = 1500


@dataclasses.dataclass
class Swing:
    """A pendulum with its exact positions, velocities and torques; columns are made of these."""

    file: ModelFile
    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    u: np.ndarray


def swing(seed: int = 3, between: str = "linear") -> Swing:
    log = made("pendulum", seed - seed % 2, between=between, std=1e-9)
    t = PERIOD * np.arange(ROWS)
    return Swing(log.file, t, log.exact[:, 0], np.gradient(log.exact[:, 0], t), np.asarray(log.record.u)[:, 0])
