from ._certify import CHECKERS as CHECKERS, CheckerName as CheckerName, certify as certify
from ._contraction_certificate import ContractionCertificate as ContractionCertificate
from ._figures import Projection as Projection, projection as projection
from ._joint_bounds import friction_bounds as friction_bounds, friction_on as friction_on
from ._largest import Attempt as Attempt, Largest as Largest, largest as largest
from ._simulated import (
    Trajectories as Trajectories,
    trajectories as trajectories,
)
