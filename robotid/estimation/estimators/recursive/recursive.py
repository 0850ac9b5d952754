"""The interface of recursive estimators: a state, one sample at a time."""

import json
import math
from abc import abstractmethod
from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path
from typing import Any, ClassVar, Generic, Literal, TypeVar

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.files import written_whole
from robotid.base.typing import Array
from robotid.dynamics.problem import Problem, Sample
from robotid.estimation.estimators.estimator import Estimate, Estimator

StateT = TypeVar("StateT")


class RecursiveEstimator(Estimator[Problem], Generic[StateT]):
    """Interface of recursive estimators: settings in the constructor, results in a state.

    A state is an immutable dataclass of arrays and numbers. ``save_state`` and ``load_state``
    preserve it exactly.
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
        """Return the state after one more sample; the given state is not changed.

        Args:
            state: The previous state.
            sample: One sample; rows of weight 0 are skipped.

        Raises:
            DataError: If the sample is not finite or has a wrong shape; the state remains valid.
        """

    @abstractmethod
    def estimate(self, state: StateT, names: tuple[str, ...]) -> Estimate:
        """Return the estimate of a state.

        Args:
            state: The state.
            names: Names of the c parameters.
        """


def fold(estimator: RecursiveEstimator[StateT], samples: Iterable[Sample], state: StateT) -> StateT:
    """Return the state after all samples.

    Args:
        estimator: The estimator.
        samples: The samples, in the order of the updates.
        state: The initial state.

    Raises:
        DataError: If a sample is not finite or has a wrong shape.
    """
    for sample in samples:
        state = estimator.update(state, sample)
    return state


def scaled_rows(sample: Sample, sigma: Array, c: int) -> Array:
    """Return rows sqrt(weight_j) / sigma_j [Y_j tau_j] of nonzero weight, shape (k, c + 1).

    sigma (n,) [N m or N].
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
    # the sum is the fastest test: it is finite only if every entry is
    if not math.isfinite(rows.sum()):
        raise DataError(
            "the sample has values that are not finite and was not used; the previous state "
            "remains valid"
        )
    return rows


def save_state(state: Any, path: str | Path) -> None:  # noqa: ANN401
    """Write a state to an NPZ file, exactly and without pickle.

    Args:
        state: An immutable dataclass of arrays and numbers.
        path: The file. A temporary file is written first and then renamed.
    """
    content = {f.name: np.asarray(getattr(state, f.name)) for f in fields(state)}
    kind = np.frombuffer(json.dumps(type(state).__name__).encode(), dtype=np.uint8)
    with written_whole(path) as beside, open(beside, "wb") as stream:
        np.savez(stream, allow_pickle=False, __kind__=kind, **content)


def load_state(path: str | Path, kind: type[StateT]) -> StateT:
    """Return a state from a file; updates from it give exactly the results of an unbroken run.

    Args:
        path: The file.
        kind: Class of the state, as ``RLSState``.

    Raises:
        DataError: If the file does not exist, is not NPZ, or contains another class of state.
    """
    source = Path(path)
    if not source.is_file():
        raise DataError(f"the file {str(source)!r} of the state does not exist")
    try:
        with np.load(source, allow_pickle=False) as archive:
            content = dict(archive)
    except (ValueError, OSError) as error:
        raise DataError(f"{source.name} is not a file of a state: {error}") from error
    found = json.loads(bytes(content.pop("__kind__", np.frombuffer(b"null", np.uint8))))
    if found != kind.__name__:
        raise DataError(f"{source.name} contains a state {found!r}, wanted {kind.__name__!r}")
    # LAPACK needs column order: NPZ preserves the memory order of arrays
    plain = {key: x if x.ndim else x.item() for key, x in content.items()}
    return kind(**plain)


def require_samples(data: object) -> None:
    """Raise an error if data for ``fit`` have no samples."""
    if not isinstance(data, Problem):
        raise DataError(
            "a recursive estimator needs samples, but factors have none; call fit with the problem"
        )
