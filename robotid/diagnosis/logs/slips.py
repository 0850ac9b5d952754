"""Feet that slip during a part of their contacts, slowly or fast."""

from collections.abc import Iterator, Sequence

import numpy as np

from robotid.base.findings import Finding, log_finding
from robotid.base.typing import Array
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings

_MARGIN = 0.03  # [s] after and before a change of contact in which a slip is not examined
_SLIPS = 0.03  # share of the time in contact with a slip that is reported
_BEYOND = 3.0  # standard errors that a slip must exceed
_FAST, _SLOW = 0.2, 1.0  # [s] windows in which the mean velocity of a foot in contact is a slip ...
_DISTANCE = 0.01  # [m] ... from this way in a window on
_USUAL = 3.0  # median speeds up to which a sample counts for the zeros
_ZERO = 0.05  # [rad or m] prior standard deviation of the zero of a joint


def without_zeros(t: Array, v: Array, J: Array, flags: Array) -> Array:
    """Return the velocity of a point of contact without that due to wrong zeros of joints.

    Wrong zeros d of the joints move the point by J d, which has the velocity dJ/dt d: it returns
    with the posture, and d is the same in all contacts. It is estimated from all of them, without
    samples of more than three times the median speed.

    t (N,) [s], v (N, 3) [m/s], J (N, 3, n_rows), flags (N,).
    """
    if not flags.any():
        return v
    A: Array = np.gradient(J[:, :, 6:], t, axis=0)
    speed = np.linalg.norm(v, axis=1)
    slow = flags & (speed <= _USUAL * np.median(speed[flags]))  # no fast slips
    rows, left = A[slow].reshape(-1, A.shape[2]), v[slow].ravel()
    step = float(np.median(np.diff(t)))
    noise = np.mean(left**2) * max(1.0, _FAST / step) / _ZERO**2 + 1e-12
    d = np.linalg.solve(rows.T @ rows + noise * np.eye(A.shape[2]), rows.T @ left)
    steady: Array = v - A @ d
    return steady


def check_slip(
    link: str, log: Log, flags: Array, t: Array, ways: Sequence[Array], signals: SignalSettings
) -> Iterator[Finding]:
    """Yield a finding if a link moves during a part of its contacts, away from their ends.

    Contacts are cut into windows of 0.2 s, and of 1 s. A slip is a mean velocity of a window by
    which the link moves 1 cm, and that its scatter does not explain: vibrations and noise are none.

    flags (N,), t (N,) [s], ways (N, 3) [m/s].
    """
    step = float(np.median(np.diff(t)))
    spread = 1.0 / signals.cutoff if signals.cutoff else 0.0
    width = 2 * round((_MARGIN + spread) / step) + 1
    inside = np.convolve(~flags, np.ones(width), mode="same") < 0.5
    edges = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(int)))
    speeds = np.zeros(len(flags))  # of slips
    for window in (_FAST, _SLOW):
        least = _DISTANCE / window
        for first, stop in edges.reshape(-1, 2):
            count = max(1, round((stop - first) * step / window))
            for rows in np.array_split(np.arange(first, stop), count):
                rows = rows[speeds[rows] == 0.0]  # fast slips are no slow ones
                if not len(rows):
                    continue
                independent = max(1.0, len(rows) * min(1.0, 2.0 * step / spread if spread else 1.0))
                means = [v[rows].mean(axis=0) for v in ways]
                k = int(np.argmin([np.linalg.norm(mean) for mean in means]))
                error = rms(ways[k][rows] - means[k]) / np.sqrt(independent)
                speed = float(np.linalg.norm(means[k]))
                if speed <= max(least, _DISTANCE / (len(rows) * step), _BEYOND * error):
                    continue
                own = np.linalg.norm(ways[k][rows], axis=1)
                speeds[rows] = np.where(own > least, own, 0.0) if window == _FAST else speed
    slips = speeds > 0.0
    if np.count_nonzero(slips) < _SLIPS * np.count_nonzero(inside) or not slips.any():
        return
    share = np.count_nonzero(slips) / np.count_nonzero(inside)
    mean, distance = rms(speeds[slips, None]), step * float(speeds[slips].sum())
    message = (
        f"the link {link} slips in {share:.0%} of its time in contact, at {mean:.2g} m/s (RMS), "
        f"{distance:.2g} m in total. Its force is still eliminated, and its rows are used: they "
        "do not assume that it is at rest"
    )
    evidence = {"share": share, "speed": mean, "distance": distance}
    yield log_finding(log.name, "slipping_foot", "note", message, **evidence)


def rms(values: Array) -> float:
    """Return the root mean square of the lengths of vectors: values (N, 3)."""
    return float(np.sqrt(np.mean(np.sum(values**2, axis=1))))
