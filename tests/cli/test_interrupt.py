"""Ctrl-C at any moment ends the command with one line and status 130, and leaves nothing behind."""

from __future__ import annotations

import contextlib
import io
import os
import pty
import re
import select
import signal
import subprocess
import sys
import time
import weakref
from pathlib import Path

import pytest

from tests.report.fits import DEMO
from vjm.cli import _Interrupts, commands, main

_PATIENCE = 60.0  # s, on a busy machine


def experiment(folder: Path) -> Path:
    """The demo's beam, the first second and a half of two recordings to train on and of one held out."""
    rig = DEMO.read_text(encoding="utf-8").partition("[[recording]]")[0]
    for name, role in (("first_mode.csv", "train"), ("second_mode.csv", "train"), ("both_modes.csv", "holdout")):
        lines = (DEMO.parent / name).read_text(encoding="utf-8").splitlines()
        (folder / name).write_text("\n".join(lines[:46]) + "\n", encoding="utf-8")
        rig += f'[[recording]]\nfile = "{name}"\nkind = "decay"\nrole = "{role}"\n'
    (folder / "experiment.toml").write_text(rig, encoding="utf-8")
    return folder / "experiment.toml"


def interrupted(stage: str, delay: float, *arguments: str | Path) -> tuple[int, str]:
    """Run a command as in a terminal, press Ctrl-C `delay` seconds after the bar shows a stage.

    Return its status and its last words.
    """
    terminal, other = pty.openpty()
    command = [sys.executable, "-m", "vjm", *map(str, arguments)]
    environment = os.environ | {"COLUMNS": "120", "TERM": "xterm"}
    process = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=other, env=environment, start_new_session=True
    )
    os.close(other)
    seen, began, pressed = "", time.monotonic(), False
    try:
        while part := read(terminal, began + _PATIENCE - time.monotonic()):
            seen += part.decode("utf-8", "replace")
            if not pressed and stage in seen:
                time.sleep(delay)
                os.killpg(process.pid, signal.SIGINT)  # a terminal tells all processes of the group
                pressed, seen = True, ""
        assert pressed, seen
        status = process.wait(_PATIENCE)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        os.close(terminal)
    return status, re.sub(r"\x1b\[[\d;?]*[A-Za-z]", "", seen)


def read(terminal: int, patience: float) -> bytes:
    """What comes next; nothing where no process has the terminal any more."""
    ready, _, _ = select.select([terminal], [], [], max(0.0, patience))
    assert ready, "a process still holds the terminal"
    try:
        return os.read(terminal, 65536)
    except OSError:  # nobody writes any more
        return b""


CANDIDATES = "diagnose", "--jobs", "2", "--effects", "tip_payload,linear_drag,clamp_compliance"


@pytest.mark.parametrize(
    ("stage", "delay", "command"),
    [
        ("reading", 0.0, ("identify",)),
        pytest.param("fitting trajectories", 0.0, ("identify",), marks=pytest.mark.slow),
        ("drawing", 0.0, ("identify",)),
        pytest.param("drawing shapes", 0.0, ("identify",), marks=pytest.mark.slow),
        ("testing candidates", 0.0, CANDIDATES),  # while processes start
        *(pytest.param("testing candidates", delay, CANDIDATES, marks=pytest.mark.slow) for delay in (0.1, 0.3)),
    ],
)
def test_the_command_ends_with_one_line(stage: str, delay: float, command: tuple[str, ...], tmp_path: Path) -> None:
    name, *options = command
    status, said = interrupted(stage, delay, name, experiment(tmp_path), "-o", tmp_path / "out", *options)
    assert status == 130, said
    assert said.rstrip().splitlines()[-1].endswith("vjm: interrupted")
    assert "Traceback" not in said
    assert "Error" not in said
    assert not (tmp_path / "out").exists()


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("stream", "said"), [(io.StringIO(), "vjm: interrupted\n"), (Terminal(), "\r\x1b[2K\x1b[?25hvjm: interrupted\n")]
)
def test_the_last_line_is_not_left_to_a_bar_that_has_just_begun(
    stream: io.StringIO, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A bar replaces the stream of errors, and is not ended where Ctrl-C is pressed before its block begins."""

    def interrupted_by_a_bar(_: object) -> None:
        sys.stderr = io.StringIO()
        raise KeyboardInterrupt

    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setitem(commands.COMMANDS, "check", interrupted_by_a_bar)
    assert main(["check", str(DEMO)]) == 130
    assert sys.stderr is stream
    assert stream.getvalue() == said


# Presses Ctrl-C when a module is looked for.
_PRESS = """
import os, signal, sys

class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == "{module}":
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Finder())
sys.argv = ["vjm", "check", {experiment!r}]
from vjm.cli import main
sys.exit(main())
"""


# From the first that `main` imports to those that libraries' C code asks for, and would report as an ImportError.
@pytest.mark.parametrize(
    "module",
    ["shlex", "argparse", "vjm.cli.commands", "rich.console", "numpy._core.multiarray", "datetime",
     "scipy.linalg._fblas", "pinocchio.pinocchio_pywrap_default", "matplotlib"],
)  # fmt: skip
def test_imports_are_interrupted_quietly(module: str) -> None:
    code = _PRESS.format(module=module, experiment=str(DEMO))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=_PATIENCE)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "vjm: interrupted\n")


# A library's thread that waits for ever, for which Python would wait at its end.
_WAIT = """
import os, signal, sys, threading
import vjm.cli.commands as commands

def wait(arguments):
    threading.Thread(target=threading.Event().wait).start()
    os.kill(os.getpid(), signal.SIGINT)

commands.COMMANDS["check"] = wait
sys.argv = ["vjm", "check", "x"]
from vjm.cli import main
sys.exit(main())
"""


def test_a_library_that_waits_for_ever_does_not_keep_the_command() -> None:
    done = subprocess.run([sys.executable, "-c", _WAIT], capture_output=True, text=True, timeout=_PATIENCE)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "vjm: interrupted\n")


# Says when the handler stands; until then, Python answers Ctrl-C with a traceback.
_READY = """
import sys
import vjm.cli

class Interrupts(vjm.cli._Interrupts):
    def begin(self):
        super().begin()
        print(flush=True)

vjm.cli._Interrupts = Interrupts
sys.argv = ["vjm", "identify", {experiment!r}]
import vjm.__main__
"""


@pytest.mark.parametrize("delay", [0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5])  # s
def test_a_command_that_has_just_started_is_interrupted_quietly(delay: float, tmp_path: Path) -> None:
    command = [sys.executable, "-c", _READY.format(experiment=str(DEMO))]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, **pipes, cwd=tmp_path) as process:
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(delay)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=_PATIENCE)
    assert (process.returncode, said) == (130, b"vjm: interrupted\n")
    assert not (tmp_path / "vjm-identify").exists()


def test_ctrl_c_as_soon_as_the_handler_stands_is_quiet(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    begin = _Interrupts.begin

    def interrupted_at_once(self: _Interrupts) -> None:
        begin(self)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(_Interrupts, "begin", interrupted_at_once)
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGALRM)
    assert main(["check", str(DEMO)]) == 130
    assert capsys.readouterr().err == "vjm: interrupted\n"
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGALRM)) == before


def test_nothing_slow_is_imported_before_the_handler() -> None:
    """Ctrl-C ends in a traceback before; it must be over in a millisecond or two."""
    slow = {"argparse", "dataclasses", "inspect", "pathlib", "shlex", "threading", "typing", "warnings"}
    code = f"import sys; import vjm.cli; print(*sorted({slow} & {{*sys.modules}}))"
    done = subprocess.run([sys.executable, "-S", "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_interrupt_that_is_dropped_is_told_again() -> None:
    """Python drops what a weak reference's callback raises."""

    class Thing:
        pass

    before = signal.getsignal(signal.SIGINT)
    interrupts = _Interrupts()
    interrupts.begin()
    try:
        thing = Thing()
        reference = weakref.ref(thing, lambda _: signal.raise_signal(signal.SIGINT))
        del thing  # calls it
        assert reference() is None
        with pytest.raises(KeyboardInterrupt):
            time.sleep(10)
    finally:
        interrupts.end()
    assert interrupts.any
    assert signal.getsignal(signal.SIGINT) is before


def test_handlers_are_given_back() -> None:
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGALRM)
    with pytest.raises(SystemExit):
        main(["--version"])
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGALRM)) == before
