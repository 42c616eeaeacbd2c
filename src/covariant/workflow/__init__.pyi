from ._certify import (
    CertificateCheckResult as CertificateCheckResult,
    CertifyResult as CertifyResult,
    certify as certify,
    check_certificate as check_certificate,
)
from ._compare import CompareResult as CompareResult, compare as compare
from ._estimate import EstimateResult as EstimateResult, estimate as estimate
from ._inputs import MisfitError as MisfitError
from ._outputs import check_output as check_output
from ._progress import Progress as Progress
from ._result import AbstractResult as AbstractResult, AbstractTable as AbstractTable
from ._simulate import SimulateResult as SimulateResult, simulate as simulate
