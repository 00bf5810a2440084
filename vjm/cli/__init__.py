"""The command `vjm`: its exit status, and what it says of failures and of Ctrl-C.

It imports next to nothing: until its handler stands, Ctrl-C ends in a traceback.
"""

from __future__ import annotations

import os
import signal
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    import argparse
    from collections.abc import Sequence
    from typing import Any

    from vjm.errors import VjmError

_REPEAT_AFTER = 1.0  # s, after which Ctrl-C is raised again, and the end of Python cut short


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line, with the process's own arguments where `argv` is None, and return its exit status."""
    for stream in ("stdout", "stderr"):
        if getattr(sys, stream) is None:  # closed by the shell
            setattr(sys, stream, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115
    interrupts, stderr = _Interrupts(), sys.stderr
    try:
        interrupts.begin()
        return _run(argv, interrupts)
    except KeyboardInterrupt:
        interrupts.end()
        # A progress bar that had just begun still stands in for it, is in the line, and hides the cursor.
        sys.stderr = stderr
        if stderr.isatty():
            stderr.write("\r\x1b[2K\x1b[?25h")
        if argv is None:
            # The process ends. Python would end it by the signal where an `exec` was interrupted, as of a dataclass,
            # and with a traceback where Ctrl-C is pressed again.
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        status = _failed("interrupted", 130)
        if argv is None:
            _end_soon(status)
        return status


def _run(argv: Sequence[str] | None, interrupts: _Interrupts) -> int:
    try:
        import shlex
        import warnings

        from vjm.cli.arguments import parse

        arguments = parse(argv)
        if not sys.warnoptions:
            warnings.simplefilter("ignore")  # a user can do nothing about a library's warnings
        from vjm.cli.commands import COMMANDS

        arguments.line = shlex.join(["vjm", *(sys.argv[1:] if argv is None else argv)])
        COMMANDS[arguments.command](arguments)
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader of our output has gone; the rest of the buffer must not raise once more at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except Exception as error:
        if interrupts.any:  # a library made another error of it
            raise KeyboardInterrupt from error
        from vjm.errors import InputError, VjmError, printable

        if isinstance(error, VjmError):
            return _failed(_placed(error, arguments), 2 if isinstance(error, InputError) else 1)
        text = printable(" ".join(str(error).split()))
        if isinstance(error, MemoryError):
            return _failed(f"not enough memory; give fewer or shorter recordings ({text})", 1)
        if isinstance(error, OSError) and error.filename is None:
            return _failed(f"the output cannot be written ({error.strerror})", 1)
        return _failed(f"internal error: {type(error).__name__}{': ' if text else ''}{text}", 1)
    finally:
        interrupts.end()
    return 0


def _placed(error: VjmError, arguments: argparse.Namespace) -> str:
    """Return an error's message; of one that is about numbers, after the files that these are from."""
    from vjm.errors import InsufficientDataError, MistakeError, ShapeError, SimulationDivergedError, printable

    files = [getattr(arguments, key) for key in ("experiment", "model", "source") if hasattr(arguments, key)]
    if not files or not isinstance(error, InsufficientDataError | MistakeError | ShapeError | SimulationDivergedError):
        return str(error)
    return f"{printable(' with '.join(map(str, files)))}: {error}"


class _Interrupts:
    """Ctrl-C, raised again every second until the command ends.

    Python drops an exception that is raised in a weak reference's callback or in a C library's, of which drawing and
    Pinocchio have many; a KeyboardInterrupt then is lost.
    """

    def __init__(self) -> None:
        self.any = False
        self._previous_handlers: dict[int, Any] = {}
        self._unraisable = sys.unraisablehook

    def begin(self) -> None:
        """Set the handlers of both signals, and Python's hook."""
        try:
            for number in (signal.SIGINT, signal.SIGALRM):
                self._previous_handlers[number] = signal.signal(number, self._interrupt)
        except ValueError:  # not the main thread, which alone receives signals
            return
        sys.unraisablehook = self._ignore_interrupt

    def _interrupt(self, number: int, frame: object) -> None:
        self.any = True
        signal.setitimer(signal.ITIMER_REAL, _REPEAT_AFTER)
        raise KeyboardInterrupt

    def _ignore_interrupt(self, unraisable: sys.UnraisableHookArgs) -> None:
        if unraisable.exc_type is not KeyboardInterrupt:  # which is raised again
            self._unraisable(unraisable)

    def end(self) -> None:
        """Stop raising, and restore the handlers of both signals and Python's hook."""
        if self._previous_handlers:
            signal.setitimer(signal.ITIMER_REAL, 0)
            sys.unraisablehook = self._unraisable
        while self._previous_handlers:
            signal.signal(*self._previous_handlers.popitem())


def _end_soon(status: int) -> None:
    """Let Python end within a second, and quietly: libraries that were interrupted may fail then, or wait for ever."""
    from threading import Timer

    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())
    timer = Timer(_REPEAT_AFTER, os._exit, (status,))
    timer.daemon = True
    timer.start()


def _failed(message: str, status: int) -> int:
    print(f"vjm: {message}".replace("\n", "\n     "), file=sys.stderr)
    return status
