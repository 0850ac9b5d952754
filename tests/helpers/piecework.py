"""Pieces for tests of who reduces them: random rows by seed, with a mark for each reduction.

As a script, it reduces ten pieces with a checkpoint: ``piecework.py FOLDER WORKERS hold|resume``.
"hold" leaves the last five under way for ever: it waits for a signal.
"""

import logging
import os
import signal
import socket
import sys
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from robotid.base.exceptions import DataError
from robotid.dynamics.factors import Factors, Reduction, join
from robotid.estimation.workers.checkpoint import Checkpoint
from robotid.estimation.workers.pieces import Piece, reduce_piece
from robotid.estimation.workers.plan import map_pieces
from robotid.estimation.workers.processes import ProcessBackend, SerialBackend

NAMES = ("a", "b", "c", "d", "e")


@dataclass(frozen=True)
class RandomPiece(Piece):
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

    def reduce(self, *, threads=None):
        time.sleep(self.pause)
        mark(self)
        logging.getLogger("robotid.piecework").info("reduced %s", self.name)
        if self.fault == "data":
            raise DataError("row 7 is not finite", "not_finite")
        if self.fault == "missing":
            Path("/no/such/log.csv").read_bytes()
        if self.fault == "kill" or (self.fault == "kill once" and len(reduced(self)) == 1):
            os.kill(os.getpid(), signal.SIGKILL)
        if self.fault == "meet":
            meet(self.marks)
        if self.fault == "hold":
            time.sleep(600)
        rng = np.random.default_rng(self.seed)
        rows = rng.standard_normal((2, self.samples, len(NAMES) + 1))
        R = np.array([np.linalg.qr(part, mode="r") for part in rows])
        own = np.arange(len(NAMES))
        rows = np.full(2, self.samples)
        factors = Factors(tuple(np.asfortranarray(R_j) for R_j in R), (own, own), rows, NAMES)
        return KeptReduction(factors, rng.random((3, 2)), self.samples)


class KeptReduction(Reduction):
    """A reduction that a checkpoint can store."""

    def to_arrays(self):
        return arrays_of(self)

    @classmethod
    def from_arrays(cls, arrays):
        parts = [
            tuple(np.asfortranarray(arrays[f"{kind}_{j}"]) for j in range(len(arrays["rows"])))
            for kind in ("R", "columns")
        ]
        factors = Factors(*parts, arrays["rows"], tuple(arrays["names"].tolist()))
        return cls(factors, arrays["squares"], int(arrays["samples"]))


def arrays_of(reduction):
    """Return a reduction as arrays by name."""
    factors = reduction.factors
    return {
        **{f"R_{j}": R for j, R in enumerate(factors.triangles)},
        **{f"columns_{j}": own for j, own in enumerate(factors.columns)},
        "rows": factors.rows, "names": np.array(factors.names), "squares": reduction.squares,
        "samples": np.array(reduction.samples),
    }  # fmt: skip


open_checkpoint = partial(Checkpoint.open, kind=KeptReduction)


def mark(piece):
    """Leave a file that says who reduced a piece."""
    path = Path(piece.marks) / f"{piece.seed:03d}-{os.getpid()}-{time.monotonic_ns()}"
    path.write_text(socket.gethostname())


def meet(folder, seconds=60.0):
    """Wait until another process reduces something, too."""
    end = time.monotonic() + seconds
    while len(workers_of(folder)) < 2:
        if time.monotonic() > end:
            raise DataError("alone")
        time.sleep(0.01)


def reduced(piece):
    return sorted(Path(piece.marks).glob(f"{piece.seed:03d}-*"))


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


def reduce_all(pieces, **options):
    """Return the reductions of all pieces."""
    return tuple(map_pieces(reduce_piece, pieces, "reducing", **options))


def same_bits(one, other):
    """Return whether two reductions are equal to the last bit."""
    ours, theirs = arrays_of(one), arrays_of(other)
    return all(
        ours[key].dtype == theirs[key].dtype and ours[key].tobytes() == theirs[key].tobytes()
        for key in ours.keys() | theirs.keys()
    )


def local_cluster():
    """Return a cluster with two workers, each a process of its own, on ports that are free."""
    from distributed import LocalCluster

    return LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0", silence_logs=50
    )


def main(folder, workers, word):
    faults = dict.fromkeys(range(5, 10), "hold") if word == "hold" else {}
    pieces = pieces_in(Path(folder) / "marks", faults=faults)
    checkpoint = open_checkpoint(folder, {"inputs": "these"}, pieces, resume=word == "resume")
    backend = ProcessBackend(int(workers)) if int(workers) > 1 else SerialBackend()
    with backend:
        found = reduce_all(pieces, backend=backend, checkpoint=checkpoint)
    with open(Path(folder) / "joined.npz", "wb") as file:
        np.savez(file, **arrays_of(join(found)))
    checkpoint.remove()


if __name__ == "__main__":
    # as from a terminal, whatever the shell of the tests ignores
    signal.signal(signal.SIGINT, signal.default_int_handler)
    main(*sys.argv[1:])
