"""`vjm identify` on the demo, report included, as a whole process."""

import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from clock import header, in_turns, line

import vjm

DEMO = Path(vjm.__file__).parent / "demo" / "experiment.toml"
REPEATS = 5


def run(*arguments: str) -> None:
    subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL)


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        times = in_turns(
            {
                "identify": lambda: run("-m", "vjm", "identify", str(DEMO), "-q", "-o", f"{folder}/out"),
                "imports": lambda: run("-c", "import vjm.cli.commands"),
            },
            REPEATS,
        )
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    header("vjm identify on the demo")
    line("identify, median", float(np.median(times["identify"])), "s", 10.0)
    line("fastest", float(np.min(times["identify"])), "s")
    line("of which importing the libraries, median", float(np.median(times["imports"])), "s")
    line("processor time of both together, mean", processor / (REPEATS + 1), "s")
    line(
        "identify as a multiple of the imports, median over rounds",
        float(np.median(times["identify"] / times["imports"])),
    )


if __name__ == "__main__":
    main()
