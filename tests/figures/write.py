"""Write what tests/figures holds of each scenario anew: look at the diff before you commit it.

python tests/figures/write.py [SCENARIO ...]
"""

import os
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path[:0] = [str(Path(__file__).resolve().parents[n]) for n in (1, 2)]  # of this checkout


def main() -> None:
    from helpers.figure_runs import SCENARIOS
    from helpers.stored import write

    for name in sys.argv[1:] or SCENARIOS:
        with tempfile.TemporaryDirectory() as folder:
            runs, _ = SCENARIOS[name](Path(folder))
        write(name, runs.documents)


if __name__ == "__main__":
    main()
