from ._diagnose import diagnose as diagnose, misfit as misfit
from ._finding import Diagnosis as Diagnosis, Finding as Finding
from ._sensor import outliers as outliers
