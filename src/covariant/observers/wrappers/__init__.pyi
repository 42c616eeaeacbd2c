from ._acting_inputs import ActingInputs as ActingInputs
from ._contacts import Contacts as Contacts
from ._delayed import Delayed as Delayed
from ._gated import Gated as Gated, without_last_input as without_last_input
from ._unwrapped import Unwrapped as Unwrapped
