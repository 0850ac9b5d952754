"""The interface of recursive estimators: a state, one sample at a time."""

import json
import math
from abc import abstractmethod
from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path
from typing import Any, ClassVar, Generic, Literal, TypeVar

import numpy as np

from robotid._files import written_whole
from robotid._typing import Array
from robotid.estimators.estimator import Estimate, Estimator
from robotid.exceptions import DataError
from robotid.regressor.problem import Problem, Sample

__all__ = [
    "RecursiveEstimator",
    "fold",
    "load_state",
    "require_samples",
    "save_state",
    "scaled_rows",
]

StateT = TypeVar("StateT")


class RecursiveEstimator(Estimator[Problem], Generic[StateT]):
    """Settings go into the constructor, everything learnt into a state that is never changed.

    A state is a frozen dataclass of arrays and numbers: ``save_state`` and
    ``load_state`` keep every bit of it.
    """

    reads: ClassVar[Literal["samples"]] = "samples"

    @abstractmethod
    def init(self, c: int) -> StateT:
        """Return the state before any sample.

        Args:
            c: Number of parameters.
        """

    @abstractmethod
    def update(self, state: StateT, sample: Sample) -> StateT:
        """Return the state after one more sample; the state given is not changed.

        Args:
            state: The state before.
            sample: One instant; rows of weight 0 are skipped.

        Raises:
            DataError: If the sample is not finite or of another shape; the state stays valid.
        """

    @abstractmethod
    def estimate(self, state: StateT, names: tuple[str, ...]) -> Estimate:
        """Return the estimate that a state holds.

        Args:
            state: The state.
            names: Names of the c parameters.
        """


def fold(estimator: RecursiveEstimator[StateT], samples: Iterable[Sample], state: StateT) -> StateT:
    """Return the state after all samples.

    Args:
        estimator: The estimator.
        samples: The samples, in the order of the updates.
        state: The state before.

    Raises:
        DataError: If a sample is not finite or of another shape.
    """
    for sample in samples:
        state = estimator.update(state, sample)
    return state


def scaled_rows(sample: Sample, sigma: Array, c: int) -> Array:
    """Return rows sqrt(weight_j) / sigma_j [Y_j tau_j], shape (k, c + 1), but those of weight 0.

    Args:
        sample: One instant.
        sigma: Noise level of each joint, shape (n,) [N m or N].
        c: Number of parameters.

    Raises:
        DataError: If the sample is not finite or of another shape.
    """
    n = len(sigma)
    if sample.Y.shape != (n, c) or sample.tau.shape != (n,) or sample.weight.shape != (n,):
        raise DataError(
            f"the sample has Y {sample.Y.shape}, tau {sample.tau.shape}, weight "
            f"{sample.weight.shape}, wanted {(n, c)}, {(n,)}, {(n,)}"
        )
    rows = np.empty((n, c + 1))
    rows[:, :c] = sample.Y
    rows[:, c] = sample.tau
    rows *= (np.sqrt(sample.weight) / sigma)[:, None]
    if not sample.weight.all():
        rows = rows[sample.weight != 0]
    # one sum is the cheapest test: it is finite unless an entry is not
    if not math.isfinite(rows.sum()):
        raise DataError(
            "the sample is not finite, so it was refused; the state before it is still valid"
        )
    return rows


def save_state(state: Any, path: str | Path) -> None:  # noqa: ANN401
    """Write a state to an NPZ file, every bit of it, without pickle.

    Args:
        state: A frozen dataclass of arrays and numbers.
        path: The file; written beside its place first.
    """
    content = {f.name: np.asarray(getattr(state, f.name)) for f in fields(state)}
    kind = np.frombuffer(json.dumps(type(state).__name__).encode(), dtype=np.uint8)
    with written_whole(path) as beside, open(beside, "wb") as stream:
        np.savez(stream, allow_pickle=False, __kind__=kind, **content)


def load_state(path: str | Path, kind: type[StateT]) -> StateT:
    """Read a state back; updates from it give the same bits as an unbroken run.

    Args:
        path: The file.
        kind: Class of the state, as ``RLSState``.

    Raises:
        DataError: If the file is missing, no NPZ, or holds another kind of state.
    """
    source = Path(path)
    if not source.is_file():
        raise DataError(f"there is no state {str(source)!r}")
    try:
        with np.load(source, allow_pickle=False) as archive:
            content = dict(archive)
    except (ValueError, OSError) as error:
        raise DataError(f"{source.name} is not a state: {error}") from error
    found = json.loads(bytes(content.pop("__kind__", np.frombuffer(b"null", np.uint8))))
    if found != kind.__name__:
        raise DataError(f"{source.name} holds a state {found!r}, wanted {kind.__name__!r}")
    # LAPACK wants its own order: arrays come back in the order they were saved in
    plain = {key: x if x.ndim else x.item() for key, x in content.items()}
    return kind(**plain)


def require_samples(data: object) -> None:
    """Refuse what holds no samples.

    Args:
        data: What was given to ``fit``.

    Raises:
        DataError: If it is no problem: factors hold no samples.
    """
    if not isinstance(data, Problem):
        raise DataError(
            "a recursive estimator reads samples, and factors hold none; give it the problem itself"
        )
