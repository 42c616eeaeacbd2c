"""Sentences of a fit: where its search began, and which other reading of the log would explain it better."""

import numpy as np

from covariant.calibration import Fit
from covariant.calibration.diagnosis import later_line, names_of
from covariant.calibration.identification import Rival
from covariant.models import ModelFile


def start_sentence(best: Fit) -> str:
    """Where the search began that won, and what the others ended at."""
    (won, _), *others = best.starts or (("", 0.0),)
    if not won:
        return ""
    if not others:
        return f"The search began from {won}."
    rest = ", ".join(f"that from {name} by {behind:.3g} worse in log-likelihood" for name, behind in others)
    return f"The search from {won} ended best, {rest}."


def rival_sentence(rival: Rival, file: ModelFile, held_out: str, step: float) -> str:
    """What another reading of the log explains, with the line of the model file that says so; `step` is of its rows."""
    names = ", ".join(map(str, file.columns.u))
    less = f"the same fit then predicts {held_out} with {rival.growth:.2g} times the errors"
    if rival.column >= 0:
        column = file.columns.u[rival.column]
        factors = np.where(np.arange(len(file.columns.u)) == rival.column, -1.0, 1.0)
        return (
            f"The input {column} seems to be logged with the other sign: {less}. Mend it by "
            f"{names_of(file).line('u', factors)} in the model file, or by the signs of its positions, and fit again; "
            "`covariant check` looks closer"
        )
    time = abs(rival.rows) * step
    if rival.rows > 0:
        line = later_line(file, time)
        claim = f"Positions seem to follow {names} by about {time:.2g} s later than the model file says"
    else:
        claim = f"The stamps of {names} seem to be about {time:.2g} s later than they act"
        line = f"taking {time:.2g} s off them"
    return f"{claim}: {less}. Mend it by {line}, and fit again; `covariant check` looks closer"
