"""How long until `import vjm` and `vjm --help` are done, as whole processes beside a Python that does nothing."""

import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
from clock import header, in_turns, line

COMMANDS = {
    "nothing": [sys.executable, "-c", "pass"],
    "import vjm": [sys.executable, "-c", "import vjm"],
    "vjm --help": [str(Path(sys.executable).with_name("vjm")), "--help"],
    "vjm.identify, first use": [sys.executable, "-c", "import vjm; vjm.identify"],
}
LIMITS = {"import vjm": 0.7, "vjm --help": 0.4}


def run(command: list[str]) -> None:
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def main() -> None:
    times = in_turns({name: partial(run, command) for name, command in COMMANDS.items()}, repeats=10)
    header("start-up")
    for name in COMMANDS:
        line(f"{name}, median", float(np.median(times[name])), "s", LIMITS.get(name))
    for name in LIMITS:
        line(f"{name} as a multiple of nothing", float(np.median(times[name] / times["nothing"])))


if __name__ == "__main__":
    main()
