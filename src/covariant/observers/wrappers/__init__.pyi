from ._acting_inputs import ActingInputs as ActingInputs, ActingInputsState as ActingInputsState
from ._contacts import Contacts as Contacts, ContactsState as ContactsState
from ._damped import (
    Damped as Damped,
    DampedInfo as DampedInfo,
    DampedState as DampedState,
    damping_margin as damping_margin,
)
from ._delayed import Delayed as Delayed, DelayedState as DelayedState
from ._gated import Gated as Gated, GatedState as GatedState, without_last_input as without_last_input
from ._unwrapped import Unwrapped as Unwrapped
