"""What a fit on one recorded log is worth on another: velocity errors with first, fitted and published numbers.

Run `COVARIANT_DATA=... python benchmarks/fits.py` from the repository's root.
"""

import os
from pathlib import Path

import numpy as np

from covariant import models
from covariant.calibration import fit, observer_gains, relations
from covariant.observers import Intrinsic
from covariant.verbs.base.inputs import Job, data_sheet, load
from covariant.verbs.base.outcome import drive

DATA = Path(os.environ["COVARIANT_DATA"])
COLUMNS = dict.fromkeys(("t", "q", "u", "v", "truth"))
SIMPLE = {"mass": [0.6], "inertia": [0.25], "coulomb": [0.05], "offset": [0.0]}
DRAWN = {
    "mass": [0.5, 0.5],
    "length": [0.28, 0.2],
    "com": [0.25, 0.16],
    "inertia": [0.04, 0.018],
    "viscous": [0.01, 0.01],
    "coulomb": [0.05, 0.05],
}
CASES = {
    "simple pendulum, dircol -> ddp": (
        ("dfki_simple_pendulum_dircol", ["dfki_simple_pendulum/dircol.csv"], "dfki_simple_pendulum/ddp.csv"),
        SIMPLE,
        (*SIMPLE, "inputs.lag"),
    ),
    "simple pendulum, ddp -> dircol": (
        ("dfki_simple_pendulum", ["dfki_simple_pendulum/ddp.csv"], "dfki_simple_pendulum/dircol.csv"),
        SIMPLE,
        (*SIMPLE, "inputs.lag"),
    ),
    **{
        f"DFKI A0, {' and '.join(logs)} -> {judged}": (
            (
                "dfki_double_pendulum",
                [f"dfki_double_pendulum/A0_sysid_{log}.csv" for log in logs],
                f"dfki_double_pendulum/A0_sysid_{judged}.csv",
            ),
            DRAWN,
            ("mass", "length[0]", "com", "inertia", "viscous", "coulomb", "inputs.lag"),
        )
        for logs in (("05",), ("12",), ("00",), ("00", "12"))
        for judged in ("00", "05", "12")
        if judged not in logs
    },
}

if __name__ == "__main__":
    print("| fitted on -> judged on | first numbers | fitted | published |")
    for case, ((name, fitted_logs, judged), guess, names) in CASES.items():
        spec, first = f"examples/{name}.toml", tuple(f"parameters.{key}={value}" for key, value in guess.items())
        first += ("inputs.lag=0.005",) if "inputs.lag" in names else ()
        family = models.family(spec, names, first)
        seen = [load(Job(spec, DATA / log, first, 1, None, COLUMNS, True)) for log in fitted_logs]
        records, velocities = [one.log.record for one in seen], [one.reference.v for one in seen if one.reference]
        found = fit(family, records, velocities)

        def error(overrides, spec=spec, judged=judged):
            loaded = load(Job(spec, DATA / judged, tuple(overrides), 1, None, COLUMNS, True))
            gains = observer_gains(data_sheet(loaded.file), loaded.rate)
            score = drive(Intrinsic(loaded.model, gains.alpha, gains.beta), loaded).score
            assert score is not None
            return score.rmse

        content = family.with_values(found.values)
        fitted = [f"parameters.{key}={content['parameters'][key]}" for key in guess]
        fitted += [f"inputs.lag={content['inputs']['lag']}"] if "inputs" in content else []
        errors = [", ".join(f"{x:.4f}" for x in error(each)) for each in (first, fitted, ())]
        print(f"| {case} | {' | '.join(errors)} |", flush=True)
        print(dict(zip(found.names, np.round(found.values, 5), strict=True)), relations(found), flush=True)
