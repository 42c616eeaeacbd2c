from ._certify import (
    CertificateCheckResult as CertificateCheckResult,
    CertifyResult as CertifyResult,
    DistanceResult as DistanceResult,
    certify as certify,
    check_certificate as check_certificate,
)
from ._check import CheckResult as CheckResult, check as check
from ._compare import CompareResult as CompareResult, compare as compare
from ._describe import ModelResult as ModelResult, describe_model as describe_model
from ._doctor import DoctorResult as DoctorResult, doctor as doctor
from ._estimate import estimate as estimate
from ._excitation import ExcitationResult as ExcitationResult, design_excitation as design_excitation
from ._export import ExportResult as ExportResult, export as export
from ._fit import FitResult as FitResult, check_machine_files as check_machine_files, fit as fit
from ._init import InitResult as InitResult, init as init
from ._metric import MetricResult as MetricResult, design_metric as design_metric
from ._reduced_order import ReducedOrderResult as ReducedOrderResult, design_reduced_order as design_reduced_order
from ._reproduce import ReproduceResult as ReproduceResult, reproduce_paper as reproduce_paper
from ._simulate import SimulateResult as SimulateResult, simulate as simulate
from ._smooth import SmoothResult as SmoothResult, smooth as smooth
from ._tune import TuneResult as TuneResult, tune as tune
from .base.determined import Determinacy as Determinacy
from .base.estimates import EstimateResult as EstimateResult
from .base.inputs import MisfitError as MisfitError
from .base.model_output import check_model_output as check_model_output
from .base.outcome import Pushes as Pushes
from .base.outputs import FIGURES as FIGURES, TABLES as TABLES, check_output as check_output, columns_of as columns_of
from .base.progress import Progress as Progress
from .base.result import AbstractResult as AbstractResult, AbstractTable as AbstractTable
from .base.robot_file import RobotFileResult as RobotFileResult

__all__ = [
    "AbstractResult",
    "check_certificate",
    "describe_model",
    "design_metric",
    "design_reduced_order",
    "init",
]
