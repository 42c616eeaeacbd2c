from ._certify import certify as certify
from ._check import check as check
from ._compare import compare as compare
from ._describe import describe_model as describe_model
from ._doctor import doctor as doctor
from ._estimate import estimate as estimate
from ._excitation import design_excitation as design_excitation
from ._export import export as export
from ._fit import check_machine_files as check_machine_files, fit as fit
from ._init import init as init
from ._metric import design_metric as design_metric
from ._reproduce import reproduce_paper as reproduce_paper
from ._simulate import simulate as simulate
from ._smooth import smooth as smooth
from ._tune import tune as tune
from .base.check_certificate import (
    CertificateCheckResult as CertificateCheckResult,
    check_certificate as check_certificate,
)
from .base.inputs import MisfitError as MisfitError
from .base.model_output import check_model_output as check_model_output
from .base.outputs import FIGURES as FIGURES, TABLES as TABLES, check_output as check_output, columns_of as columns_of
from .base.progress import Progress as Progress
from .base.result import AbstractResult as AbstractResult

__all__ = [
    "AbstractResult",
    "check_certificate",
    "describe_model",
    "design_metric",
    "init",
]
