"""Run the command line as ``python -m robotid``."""

import sys

from robotid.cli import main

if __name__ == "__main__":
    sys.exit(main())
