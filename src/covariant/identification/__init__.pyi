from ._draft import Draft as Draft, draft as draft
from ._fit import Fit as Fit, fit as fit, losses as losses
from ._held_out import FITTED as FITTED, growth as growth, split as split
from ._predict import PredictionErrors as PredictionErrors, prediction_errors as prediction_errors
from ._relations import relations as relations
from ._windows import Windows as Windows, horizon as horizon, windows as windows
