"""The command line: python -m experiments {train, evaluate, table, plan, ...}; --help names all."""

import sys

from experiments.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
