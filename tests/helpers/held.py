"""The command line, held once some pieces are finished: ``held.py MARK COUNT ARGUMENT...``.

Then it writes the file MARK and waits for a signal, so that a test never races with the work.
"""

import signal
import sys
import time
from pathlib import Path

from robotid.cli import main
from robotid.estimation.work_plan import WorkPlan

_map = WorkPlan.map


def held(mark, count):
    def map_pieces(*stated):
        for k, result in enumerate(_map(*stated), start=1):
            if k == count:
                mark.touch()
                time.sleep(600)
            yield result

    return map_pieces


if __name__ == "__main__":
    # as from a terminal, whatever the shell of the tests ignores
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    WorkPlan.map = held(Path(sys.argv[1]), int(sys.argv[2]))
    sys.exit(main(sys.argv[3:]))
