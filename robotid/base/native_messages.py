"""Messages of compiled libraries on stderr, which Python's redirection does not catch."""

import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_ONE_AT_A_TIME = threading.Lock()
_KINDS = ("Error:", "Warning:")  # first word of console_bridge's messages, which urdfdom uses
_PLACE = "         at line "  # the second line of such a message: a line of urdfdom's source


@contextmanager
def caught_messages() -> Iterator[list[str]]:
    """Catch the messages that urdfdom and Pinocchio print on file descriptor 2."""
    messages: list[str] = []
    with _ONE_AT_A_TIME, tempfile.TemporaryFile() as caught:
        try:
            stderr = os.dup(2)
        except OSError:  # no stderr: nothing can be printed there
            yield messages
            return
        if sys.stderr is not None:
            sys.stderr.flush()
        os.dup2(caught.fileno(), 2)
        try:
            yield messages
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
        caught.seek(0)
        others = []
        for line in caught.read().decode(errors="replace").splitlines():
            kind, _, text = line.partition(" ")
            if kind in _KINDS:
                messages.append(text.strip())
            elif not line.startswith(_PLACE):
                others.append(f"{line}\n")
        if others:
            os.write(2, "".join(others).encode())
