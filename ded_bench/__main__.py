"""`python -m ded_bench` is `ded-bench`."""

import sys

from ded_bench.cli import main

if __name__ == "__main__":
    sys.exit(main())
