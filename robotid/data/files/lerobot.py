"""LeRobot datasets, folders of version 2 or 3: an episode as a table of named columns.

Positions are in ``observation.state``, commanded positions in ``action``.
"""

import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.files import DATASET, read_json
from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.data.files.parquet_files import load_pyarrow
from robotid.data.files.table import Format, Table, choose, parsing
from robotid.data.log import suggestion
from robotid.data.signal_settings import LogSource

#: Prefixes of the columns of each feature, by the endings of the names in it.
_FEATURES: Mapping[str, Mapping[str, str]] = {
    "observation.state": {"": "q", "pos": "q", "q": "q", "vel": "dq", "dq": "dq",
                          "torque": "tau", "tau": "tau", "effort": "tau"},
    "observation.velocity": {"": "dq"},
    "observation.effort": {"": "tau"},
    "action": {"": "qref", "pos": "qref", "q": "qref", "vel": "dqref", "dq": "dqref",
               "torque": "tauref", "tau": "tauref", "effort": "tauref"},
}  # fmt: skip
_NORMALISED = (
    "the unit of positions is not in the files of LeRobot. By version and use_degrees of the "
    "robot, they are degrees, or normalised: -100 to 100 over the calibrated range of each joint, "
    "which is no angle (a gripper always has 0 to 100). Normalised positions: record with "
    "use_degrees = true, or convert them with the calibration of the robot. If "
    'they are angles, state the unit: angle = "deg" or "rad" (job file table [units], CLI '
    '--angle-unit deg, Python units=LogUnits(angle="deg"))'
)
_Place = tuple[str, int]  # a feature, and the number of a value in its vectors


def _open(path: Path, source: LogSource) -> Table:
    """Return the table of an episode: the topic, as ``episode_3``, or the only one.

    LeRobot computes the time stamps of an episode from the numbers of the frames.
    """
    pa = load_pyarrow("reading LeRobot datasets")
    columns = _columns(path, _features(path))
    parts: dict[int, list[Path]] = {}  # files with rows of an episode, by its number
    with parsing(path, "LeRobot"):
        for file in sorted(path.glob("data/**/*.parquet")):
            numbers = pa.parquet.read_table(file, columns=["episode_index"])
            for number in np.unique(numbers.column(0).to_numpy()):
                parts.setdefault(int(number), []).append(file)
    number = _episode(path, sorted(parts), source.topic)
    note = (
        f"episode {number}: its time stamps are frame numbers over the frame rate, so the "
        "delay between commands and positions has an error of up to one frame"
    )
    read = partial(_read, path, parts[number], number, columns)
    return Table(["time", *columns], read, notes=(note,), angle_unit=_NORMALISED)


LEROBOT = Format((), _open, topics="episode")


def _features(path: Path) -> dict[str, Any]:
    """Return the description of the columns of the dataset."""
    info = read_json(path / DATASET, "description of a LeRobot dataset")
    features = info.get("features") if isinstance(info, dict) else None
    if not isinstance(features, dict) or not all(isinstance(x, dict) for x in features.values()):
        raise DataError(
            f"{path.name}: meta/info.json does not describe a LeRobot dataset of version 2 or "
            f"3: features is {str(features)[:80]}, wanted a table of tables"
        )
    return features


def _columns(path: Path, features: Mapping[str, Any]) -> dict[str, _Place]:
    """Return the columns of the motors of the dataset, by standard name."""
    columns: dict[str, _Place] = {}
    for feature in filter(features.__contains__, _FEATURES):
        names = _names(features[feature].get("names"))
        if not names:
            raise DataError(
                f"{path.name}: meta/info.json has no names of the motors in {feature}; add "
                f"their names, in the order of its {features[feature].get('shape')} values"
            )
        for place, name in enumerate(names):
            joint, dot, end = name.rpartition(".")
            if not dot or end not in _FEATURES[feature]:
                joint, end = name, ""
            column = f"{_FEATURES[feature][end]}_{joint}"
            if column in columns:
                other, number = columns[column]
                raise DataError(
                    f"{path.name}: meta/info.json has the same name for {name!r} of {feature}, "
                    f"number {place}, and number {number} of {other}; give each motor another name"
                )
            columns[column] = feature, place
    if not columns:
        raise DataError(
            f"{path.name} has neither observation.state nor action, wanted one of them; features: "
            f"{listed(features)}"
        )
    return columns


def _names(stated: object) -> list[str]:
    """Return the names of a feature's values; none if their form is unknown."""
    groups: list[Any] = list(stated.values()) if isinstance(stated, dict) else [stated]
    if not all(isinstance(group, list) for group in groups):  # neither {"motors": [...]} nor a list
        return []
    names = [name for group in groups for name in group]
    return names if all(isinstance(name, str) for name in names) else []


def _episode(path: Path, numbers: Sequence[int], wanted: str | None) -> int:
    """Return the number of the stated episode, or of the only one."""
    names = [f"episode_{number}" for number in numbers]
    if not names:
        raise DataError(f"{path.name} has no episode: its files data/**/*.parquet have no rows")
    if wanted is None:
        chosen = choose(path.name, names, "episodes", "each episode is a separate log")
        return numbers[names.index(chosen)]
    digits = re.fullmatch(r"(?:episode_)?0*([0-9]+)", wanted)
    chosen = f"episode_{digits[1]}" if digits else wanted
    if chosen not in names:
        shown = wanted if len(wanted) <= 40 else f"{wanted[:40]}..."
        raise DataError(
            f"{path.name} has no episode {shown!r}; episodes: {listed(names)}"
            f"{suggestion(shown, names)}"
        )
    return numbers[names.index(chosen)]


def _read(
    path: Path,
    files: Sequence[Path],
    number: int,
    columns: Mapping[str, _Place],
    wanted: Sequence[str],
) -> dict[str, Array]:
    """Return columns of an episode, in the order of its frames."""
    pa = load_pyarrow("reading LeRobot datasets")
    places = {name: columns[name] for name in wanted if name != "time"}
    features = sorted({feature for feature, _ in places.values()})
    names = ["timestamp", "episode_index", "frame_index", *features]
    with parsing(path, "LeRobot"):
        table = pa.concat_tables([pa.parquet.read_table(file, columns=names) for file in files])
        rows = np.flatnonzero(table.column("episode_index").to_numpy() == number)
        rows = rows[np.argsort(table.column("frame_index").to_numpy()[rows], kind="stable")]
        vectors = {
            feature: np.array(table.column(feature).take(rows).to_pylist(), dtype=np.float64)
            for feature in features
        }
        t = table.column("timestamp").to_numpy()[rows].astype(np.float64).ravel()
    values: dict[str, Array] = {"time": t}
    for name, (feature, place) in places.items():
        vector = vectors[feature]
        if vector.ndim != 2 or place >= vector.shape[1]:
            raise DataError(
                f"{path.name}: {feature} has vectors of shape {vector.shape[1:]}, but "
                f"meta/info.json has at least {place + 1} names of motors for it"
            )
        values[name] = vector[:, place]
    return {name: values[name] for name in wanted}
