"""A unit for simulators, driven as a simulator does it."""

import tempfile
from pathlib import Path

import fmpy
import fmpy.fmi2
import fmpy.fmi3
import numpy as np


class Unit:
    """The instance of a unit of either version; what it refuses raises `fmpy.fmi1.FMICallException`."""

    def __init__(self, path: Path, folder: Path, token: str = ""):
        described = fmpy.read_model_description(str(path), validate=True)
        self.old = described.fmiVersion == "2.0"
        make = fmpy.fmi2.FMU2Slave if self.old else fmpy.fmi3.FMU3Slave
        # A folder for each instance, as its library stays loaded.
        place, name = fmpy.extract(str(path), tempfile.mkdtemp(dir=folder)), described.coSimulation.modelIdentifier
        self.calls = make(guid=token or described.guid, unzipDirectory=place, modelIdentifier=name, instanceName="a")
        self.calls.instantiate()
        self.places: dict[str, list[int]] = {}
        for variable in described.modelVariables:
            self.places.setdefault(variable.name.partition("[")[0], []).append(variable.valueReference)

    def read(self, name: str, size: int) -> np.ndarray:
        place = self.places[name]
        return np.array(self.calls.getReal(place) if self.old else self.calls.getFloat64(place, nValues=size))

    def write(self, name: str, values) -> None:
        (self.calls.setReal if self.old else self.calls.setFloat64)(self.places[name], np.ravel(values).tolist())

    def outcome(self) -> int:
        return (self.calls.getInteger if self.old else self.calls.getInt32)(self.places["outcome"])[0]

    def begin(self, t: float) -> None:
        if self.old:
            self.calls.setupExperiment(startTime=t)
            self.calls.enterInitializationMode()
        else:
            self.calls.enterInitializationMode(startTime=t)
        self.calls.exitInitializationMode()

    def step(self, t: float, h: float) -> None:
        self.calls.doStep(t, h)
