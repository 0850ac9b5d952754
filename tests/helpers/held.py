"""The command line as ever, but held once some pieces are kept: ``held.py MARK COUNT ARGUMENT...``.

Then it writes the file MARK and waits for a signal, so that a test never races with the work.
"""

import signal
import sys
import time
from pathlib import Path

from robotid.cli import main
from robotid.workers.checkpoint import Checkpoint

_save = Checkpoint.save


def held(mark, count):
    def save(self, *piece):
        _save(self, *piece)
        if len(self.finished()) == count:
            mark.touch()
            time.sleep(600)

    return save


if __name__ == "__main__":
    # as from a terminal, whatever the shell of the tests ignores
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    Checkpoint.save = held(Path(sys.argv[1]), int(sys.argv[2]))
    sys.exit(main(sys.argv[3:]))
