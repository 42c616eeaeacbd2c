"""The error of input that is refused."""

from scalargraph.errors import InputError as InputError
