"""Run the command line as ``python -m robotid``."""

import sys

from robotid.cli import main

__all__: list[str] = []

if __name__ == "__main__":
    sys.exit(main())
