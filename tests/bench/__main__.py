"""`python -m tests.bench [NAME...] [--small] [--json]`: run the benchmarks, print a table.

The exit code is 0 unless a program broke.
"""

import argparse
import importlib
import json
import platform
import sys

from tests.bench.measured import FULL, SMALL, Measured

BENCHMARKS = {
    "decode": "decoding",
    "readings": "readings",
    "commands": "commands",
    "load": "load",
    "start": "starting",
    "stops": "stops",
    "floods": "floods",
    "record": "recording",
    "replay": "replaying",
    "sessions": "sessions",
    "questions": "questions",
    "fleet": "fleet",
    "router": "routing",
    "plan": "planning",
    "cli": "command_line",
    "secure": "securing",
}


def row_of(one: Measured) -> str:
    """Return one line of the table."""
    verdict = ""
    if one.goal is not None:
        slack = f" + {one.slack:g} {one.unit}" if one.slack else ""
        goal = f"{one.goal:g} x{slack}" if one.goal else f"{one.slack:g} {one.unit}"
        verdict = f"{goal:13} {'met' if one.met else 'MISSED'}"
    ratio = f"{one.ratio:6.2f} x" if one.ratio is not None else f"{'-':>8}"
    numbers = f"{one.ours_median:8.2f} {one.floor_median:8.2f} {one.unit:3} {ratio}"
    return f"{one.name:54} {numbers}   {verdict}".rstrip()


def main() -> int:
    """Run the named benchmarks, or all. Fail only if a program broke."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"which: {', '.join(BENCHMARKS)} (default all)")
    parser.add_argument("--json", action="store_true", help="one JSON object per line instead of a table")
    parser.add_argument("--small", action="store_true", help="one small round of each, to see that it runs")
    arguments = parser.parse_args()
    unknown = [name for name in arguments.names if name not in BENCHMARKS]
    if unknown:
        parser.error(f"there is no benchmark {', '.join(unknown)}: allowed are {', '.join(BENCHMARKS)}")
    scale = SMALL if arguments.small else FULL
    if not arguments.json:
        print(f"Python {platform.python_version()}, {platform.machine()}; medians of {scale.runs} runs, in turns")
        print(f"{'':54} {'ours':>8} {'floor':>8} {'':3} {'ratio':>8}   {'goal':13}", flush=True)
    for name in arguments.names or BENCHMARKS:
        for one in importlib.import_module(f"tests.bench.{BENCHMARKS[name]}").run(scale):
            print(json.dumps(one.to_dict()) if arguments.json else row_of(one), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
