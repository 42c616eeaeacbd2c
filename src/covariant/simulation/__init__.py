"""Simulation of models, alone or with an observer, and of sensors."""

import lazy_loader

from covariant.simulation import _simulate_state_space as _simulate_state_space  # teaches both state-space models

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
