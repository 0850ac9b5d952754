"""Pieces for tests of who reduces them: random rows by seed, with a mark for each reduction."""

import logging
import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robotid.base.exceptions import DataError


@dataclass(frozen=True)
class RandomPiece:
    """Rows of two joints. ``fault``: what goes wrong with it."""

    seed: int
    marks: str  # folder with a file per time that a piece was reduced
    pause: float = 0.0  # [s]
    fault: str = ""

    @property
    def name(self):
        return f"random rows {self.seed}"

    @property
    def samples(self):
        return 100 + self.seed


def reduce_piece(piece, threads):
    """Return a triangular factor of random rows, or do what the fault of the piece says."""
    time.sleep(piece.pause)
    mark = f"{piece.seed:03d}-{os.getpid()}-{time.monotonic_ns()}"
    (Path(piece.marks) / mark).write_text(str(threads))
    logging.getLogger("robotid.piecework").info("reduced %s", piece.name)
    if piece.fault == "data":
        raise DataError("row 7 is not finite", "not_finite")
    if piece.fault == "kill" or (
        piece.fault == "kill once" and marks(piece.marks)[piece.seed] == 1
    ):
        os.kill(os.getpid(), signal.SIGKILL)
    if piece.fault == "meet":
        _meet(piece.marks)
    rng = np.random.default_rng(piece.seed)
    return np.linalg.qr(rng.standard_normal((piece.samples, 300)), mode="r")


def _meet(folder, seconds=60.0):
    """Wait until another process reduces something, too."""
    end = time.monotonic() + seconds
    while len(workers_of(folder)) < 2:
        if time.monotonic() > end:
            raise DataError("alone")
        time.sleep(0.01)


def marks(folder):
    """Return how often each piece was reduced, by seed."""
    counts = {}
    for path in Path(folder).iterdir():
        seed = int(path.name[:3])
        counts[seed] = counts.get(seed, 0) + 1
    return counts


def workers_of(folder):
    """Return the processes that reduced something."""
    return {int(path.name.split("-")[1]) for path in Path(folder).iterdir()}


def pieces_in(folder, count=10, pause=0.0, faults=()):
    """Return pieces that leave their marks in a folder; faults by seed."""
    Path(folder).mkdir(exist_ok=True)
    by_seed = dict(faults)
    return [RandomPiece(k, str(folder), pause, by_seed.get(k, "")) for k in range(count)]
