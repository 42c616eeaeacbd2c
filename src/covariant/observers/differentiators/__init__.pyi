from ._filtered_derivative import FilteredDerivative as FilteredDerivative
from ._high_gain import HighGain as HighGain
from ._levant import Levant as Levant
from ._model_free import AbstractLinearFilter as AbstractLinearFilter, response as response
from ._pll import PLL as PLL
from ._savitzky_golay import SavitzkyGolay as SavitzkyGolay
