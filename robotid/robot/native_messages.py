"""What compiled libraries print on stderr, which Python's own redirection does not reach."""

import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["caught_messages"]

_ONE_AT_A_TIME = threading.Lock()
_KINDS = ("Error:", "Warning:")  # how console_bridge, which urdfdom prints by, begins a message
_PLACE = "         at line "  # how it goes on: a line of urdfdom's source


@contextmanager
def caught_messages() -> Iterator[list[str]]:
    """Catch the complaints that urdfdom and Pinocchio print on file descriptor 2.

    What others print there meanwhile is printed afterwards.

    Yields:
        The complaints, filled in when the block ends.
    """
    complaints: list[str] = []
    with _ONE_AT_A_TIME, tempfile.TemporaryFile() as caught:
        try:
            stderr = os.dup(2)
        except OSError:  # there is no stderr, so nothing can be printed there
            yield complaints
            return
        if sys.stderr is not None:
            sys.stderr.flush()
        os.dup2(caught.fileno(), 2)
        try:
            yield complaints
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
        caught.seek(0)
        others = []
        for line in caught.read().decode(errors="replace").splitlines():
            kind, _, text = line.partition(" ")
            if kind in _KINDS:
                complaints.append(text.strip())
            elif not line.startswith(_PLACE):
                others.append(f"{line}\n")
        if others:
            os.write(2, "".join(others).encode())
