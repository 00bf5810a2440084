"""How long until `import vjm`, `vjm --help` and a fault in a file are done, beside a Python that does nothing."""

import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
from clock import header, in_turns, line

WRONG = str(Path(__file__))  # no experiment file, as its first line says
COMMANDS = {
    "nothing": [sys.executable, "-c", "pass"],
    "import vjm": [sys.executable, "-c", "import vjm"],
    "vjm --help": [str(Path(sys.executable).with_name("vjm")), "--help"],
    "vjm check, a wrong file": [str(Path(sys.executable).with_name("vjm")), "check", "--quiet", WRONG],
    "vjm.identify, first use": [sys.executable, "-c", "import vjm; vjm.identify"],
}
LIMITS = {"import vjm": 0.7, "vjm --help": 0.4}


def run(command: list[str]) -> None:
    status = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL).returncode
    if status != (2 if WRONG in command else 0):
        raise SystemExit(f"{' '.join(command)} ended with {status}")


def main() -> None:
    times = in_turns({name: partial(run, command) for name, command in COMMANDS.items()}, repeats=10)
    header("start-up")
    for name in COMMANDS:
        line(f"{name}, median", float(np.median(times[name])), "s", LIMITS.get(name))
    for name in LIMITS:
        line(f"{name} as a multiple of nothing", float(np.median(times[name] / times["nothing"])))


if __name__ == "__main__":
    main()
