"""The check that the numbers of an example system make sense."""

from collections.abc import Collection

import numpy as np

from covariant.models._mechanical import Parameter


def check_parameters(
    system: str, parameters: dict[str, Parameter], signed: Collection[str] = (), may_vanish: Collection[str] = ()
) -> dict[str, Parameter]:
    """The parameters; raises `ValueError` for one that is not finite, or not positive and not named as an exception."""
    for name, (value, unit, _) in parameters.items():
        wanted = "finite" if name in signed else "≥ 0" if name in may_vanish else "positive"
        least = {"finite": -np.inf, "≥ 0": 0.0, "positive": np.nextafter(0, 1)}[wanted]
        if not (np.isfinite(value) & (np.asarray(value) >= least)).all():
            raise ValueError(f"{system}: {name} [{unit}] must be {wanted}; got {value!r}")
    return parameters
