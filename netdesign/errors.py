"""The errors a user can cause or meet, each with its exit status.

Everything else that escapes is a bug (status 1). The command line prints the message as one line.
"""


class NetdesignError(Exception):
    """Base of every error that is reported as one clear line."""

    exit_status = 1


class InputError(NetdesignError):
    """Wrong usage or bad input: the message says where, what was expected and what was found."""

    exit_status = 2


class InfeasibleError(NetdesignError):
    """No admissible network: the message names the binding constraint with counts."""

    exit_status = 3


class EnvironmentProblem(NetdesignError):
    """Something outside the project is missing: the message names the Debian package."""

    exit_status = 4
