"""Error of input that the library refuses."""


class InputError(ValueError):
    """Error of a file, a column or an argument that cannot be used.

    The message is one line: the file, column or argument, what was found, and what to do. Every refusal of the library
    is an `InputError`; any other exception that leaves a function is a bug. The command line prints an `InputError` as
    one line with exit code 2, and anything else with its traceback.

    It is a `ValueError`, so that one `except` catches it with those of NumPy and JAX.

    Attributes:
        exit_code: Exit code of a command that ends with this error.

    Example:
        >>> import covariant
        >>> try:
        ...     covariant.simulate("pendulum_chain", duration=-1.0)
        ... except covariant.InputError as error:
        ...     print(str(error).split(";")[0])
        duration must be a positive number of seconds
    """

    exit_code = 2


class MissingPackageError(InputError, ImportError):
    """Error of an optional package that is not installed; the message has the line that installs it.

    Example:
        >>> from covariant._errors import MissingPackageError
        >>> issubclass(MissingPackageError, ImportError)
        True
    """
