"""The command `vjm`."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Sequence

DONE, FAILED, UNUSABLE_INPUT, INTERRUPTED = 0, 1, 2, 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: the arguments; those of the process when None.

    Returns:
        Exit status: 0 done, 2 the input is unusable, 130 interrupted, 1 anything else.
    """
    try:
        from vjm.cli.arguments import parse

        arguments = parse(argv)
        if not sys.warnoptions:
            warnings.simplefilter("ignore")  # a user can do nothing about a library's warnings
        # The matrices are small: BLAS threads would only wait for each other. Read when NumPy is first imported.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        from vjm.cli.commands import COMMANDS  # everything heavy comes with it

        COMMANDS[arguments.command](arguments)
        sys.stdout.flush()
    except KeyboardInterrupt:
        return _failed("interrupted", INTERRUPTED)
    except BrokenPipeError:
        # The reader of our output has gone; the rest of the buffer must not raise once more at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except Exception as error:
        from vjm.errors import InputError, VjmError

        if isinstance(error, VjmError):
            return _failed(str(error), UNUSABLE_INPUT if isinstance(error, InputError) else FAILED)
        text = " ".join(str(error).split())
        return _failed(f"internal error: {type(error).__name__}{': ' if text else ''}{text}", FAILED)
    return DONE


def _failed(message: str, status: int) -> int:
    # Half a surrogate pair (from an undecodable file name) cannot be printed as it is.
    print(f"vjm: {message}".encode("utf-8", "backslashreplace").decode("utf-8"), file=sys.stderr)
    return status
