from ._diagnose import diagnose as diagnose, misfit as misfit
from ._finding import Diagnosis as Diagnosis, Finding as Finding
from ._sensor import outliers as outliers
from ._suggest import Suggestion as Suggestion, suggest_noise as suggest_noise
