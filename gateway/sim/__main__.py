"""`python -m gateway.sim`: the simulated cars without the rest of the command line."""

import argparse
import sys

from gateway.sim.cli import add_arguments, run
from schemas.process import stdio

if __name__ == "__main__":
    stdio.complete()
    parser = argparse.ArgumentParser(prog="gateway sim")
    add_arguments(parser)
    sys.exit(run(parser.parse_args()))
