# SPDX-License-Identifier: Apache-2.0
"""Choose a harness: ``python -m benchmarks.reliability fuzz --inputs 1000000``."""

import argparse
import importlib
import os
import sys
from pathlib import Path

_HARNESSES = {
    "load": "64 clients, small and large clouds, some minutes",
    "overload": "ten times what the service can do",
    "faults": "workers killed or stopped, and the whole service killed, at random moments",
    "fuzz": "a million broken files for the readers",
    "machines": "three worker hosts, a scheduler and two fronts: cut off, killed, joining",
    "floods": "too many event streams, connections and columns",
    "disk": "a full disk under the jobs, and room again (needs root)",
    "http": "broken HTTP of all kinds, and every route beyond its description",
}


def main() -> int:
    """Run the harness that is named; return its status."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.reliability")
    chosen = parser.add_subparsers(dest="harness", required=True)
    for name, text in _HARNESSES.items():
        if name in sys.argv[1:2] or sys.argv[1:2] != [name]:
            one = chosen.add_parser(name, help=text, description=text)
            one.add_argument("--out", type=Path, default=Path("out/reliability"), help="folder")
            one.add_argument("--cores", help="which ones to use, such as 0,1 [all]")
            if name in sys.argv[1:2]:
                importlib.import_module(f"benchmarks.reliability.{name}").arguments(one)
    options = parser.parse_args()
    if options.cores:
        # Inherited by everything that is started; the harness itself stays on them too.
        os.sched_setaffinity(0, {int(core) for core in options.cores.split(",")})
    module = importlib.import_module(f"benchmarks.reliability.{options.harness}")
    status: int = module.main(options)
    return status


if __name__ == "__main__":
    sys.exit(main())
