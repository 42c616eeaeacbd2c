from ._certify import GlobalCertificate as GlobalCertificate, certify_globally as certify_globally
from ._check import check_globally as check_globally
