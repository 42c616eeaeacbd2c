from ._check import follows as follows
from ._checked import Checked as Checked, check as check, judged as judged
