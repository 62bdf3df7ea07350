# SPDX-License-Identifier: Apache-2.0
"""Measure speed and memory on one core and print Markdown.

python -m benchmarks [--quick] [--model NAME] [--core N]
"""

import argparse
import subprocess
import sys
from dataclasses import replace

from benchmarks.case import ALL, QUICK, Case, Figures
from benchmarks.machine import describe
from benchmarks.one_core import environment, pin
from benchmarks.report import report
from pugeo_model.errors import BadOptionError


def main() -> None:
    """Run every case in a process of its own, one after the other, and print the report."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="two small cases, one run each")
    parser.add_argument("--core", type=int, help="which core; the last allowed one by default")
    parser.add_argument("--model", default="standard", help="name or path of the weights")
    options = parser.parse_args()
    core = pin(options.core)
    try:
        machine = describe(core, options.model)
    except BadOptionError as error:
        parser.error(error.message)
    cases = [replace(case, model=options.model) for case in (QUICK if options.quick else ALL)]
    print(report(machine, [_measured(case) for case in cases]))


def _measured(case: Case) -> Figures:
    print(f"measuring {case.name} ...", file=sys.stderr, flush=True)
    command = [sys.executable, "-m", "benchmarks.measure", case.to_json()]
    done = subprocess.run(
        command, env=environment(), check=False, stdout=subprocess.PIPE, text=True
    )
    if done.returncode:
        sys.exit(f"measuring {case.name} failed with status {done.returncode}")
    return Figures.from_json(done.stdout)


if __name__ == "__main__":
    main()
