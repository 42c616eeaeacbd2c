from ._certify import (
    CertificateCheckResult as CertificateCheckResult,
    CertifyResult as CertifyResult,
    certify as certify,
    check_certificate as check_certificate,
)
from ._check import CheckResult as CheckResult, check as check
from ._compare import CompareResult as CompareResult, compare as compare
from ._describe import ModelResult as ModelResult, describe_model as describe_model
from ._determined import Determinacy as Determinacy
from ._doctor import DoctorResult as DoctorResult, doctor as doctor
from ._estimate import EstimateResult as EstimateResult, estimate as estimate
from ._excitation import ExcitationResult as ExcitationResult, design_excitation as design_excitation
from ._export import ExportResult as ExportResult, export as export
from ._fit import FitResult as FitResult, check_machine_files as check_machine_files, fit as fit
from ._init import InitResult as InitResult, init as init
from ._inputs import MisfitError as MisfitError
from ._metric import MetricResult as MetricResult, design_metric as design_metric
from ._model_output import check_model_output as check_model_output
from ._outcome import Pushes as Pushes
from ._outputs import FIGURES as FIGURES, TABLES as TABLES, check_output as check_output, columns_of as columns_of
from ._over_logs import LogsResult as LogsResult, over_logs as over_logs
from ._progress import Progress as Progress
from ._reduced_order import ReducedOrderResult as ReducedOrderResult, design_reduced_order as design_reduced_order
from ._reproduce import ReproduceResult as ReproduceResult, reproduce_paper as reproduce_paper
from ._result import AbstractResult as AbstractResult, AbstractTable as AbstractTable
from ._robot_file import RobotFileResult as RobotFileResult
from ._simulate import SimulateResult as SimulateResult, simulate as simulate
from ._smooth import SmoothResult as SmoothResult, smooth as smooth
from ._sweep import SweepResult as SweepResult, sweep as sweep
from ._tune import TuneResult as TuneResult, tune as tune

__all__ = [
    "AbstractResult",
    "check_certificate",
    "describe_model",
    "design_metric",
    "design_reduced_order",
    "init",
]
