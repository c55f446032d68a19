"""How commands end: exit codes, and bad input with a message that names the way out."""

import contextlib

from dreamer_jax.integrity import DamagedError

FAILURE, USAGE, STOPPED = 1, 2, 130


class UsageError(Exception):
    """Bad input, with a message that names the way out."""


@contextlib.contextmanager
def usage_errors():
    """What is raised while input is read and checked is the user's to mend."""
    try:
        yield
    except DamagedError:
        raise
    except (ValueError, FileExistsError, NotADirectoryError, ModuleNotFoundError) as error:
        raise UsageError(str(error)) from error
