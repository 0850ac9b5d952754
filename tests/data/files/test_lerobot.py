"""LeRobot datasets: episodes of versions 2 and 3, their units, and what is refused."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest
from helpers.recorders import write_lerobot

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.files import file_sha256, log_exists, source_entry
from robotid.data.files.read import read_log
from robotid.data.log import Log
from robotid.data.signal_settings import LogSource, LogUnits

JOINTS = ("shoulder", "elbow")


def make_log(count):
    t = np.arange(count) / 50
    q = np.sin(t[:, None] * [2.0, 3.0])
    return Log(t, q, 0 * q, JOINTS, q_ref=np.sin(t[:, None] * [2.0, 3.0] + 0.1), has_torque=False)


DEGREES = LogUnits(angle="deg")


MOTORS = {
    "v2.0": {"observation.state": {"motors": list(JOINTS)}, "action": {"motors": list(JOINTS)}},
    "v2.1": {key: list(JOINTS) for key in ("observation.state", "action")},
    "v3.0": {key: [f"{j}.pos" for j in JOINTS] for key in ("observation.state", "action")},
}


def dataset(folder, version="v2.1", episodes=(0,)):
    logs = {number: make_log(100 + number) for number in episodes}
    moves = {n: (np.rad2deg(log.q) + n, np.rad2deg(log.q_ref)) for n, log in logs.items()}
    return write_lerobot(folder / "arm", moves, MOTORS[version], version=version)


@pytest.mark.parametrize("version", MOTORS)
def test_an_episode_of_lerobot_is_read(tmp_path, version):
    path, log = dataset(tmp_path, version), make_log(100)
    back = read_log(path, JOINTS[::-1], needs="commands", units=DEGREES).select(JOINTS)
    np.testing.assert_allclose(back.t, np.arange(100) / 50, atol=1e-6)
    np.testing.assert_allclose(back.q, log.q, atol=1e-6)
    np.testing.assert_allclose(back.q_ref, log.q_ref, atol=1e-6)
    assert (back.has_torque, back.v_ref) == (False, None)
    assert back.notes == (
        "episode 0: its time stamps are frame numbers over the frame rate, so the delay "
        "between commands and positions has an error of up to one frame",
    )


def test_frames_of_an_episode_are_in_their_order_whatever_that_of_the_rows_and_files(tmp_path, rng):
    path = dataset(tmp_path, "v3.0", episodes=(0, 3))
    (file,) = path.glob("data/**/*.parquet")
    table = pq.read_table(file)
    table = table.take(rng.permutation(len(table)))
    for k, rows in enumerate((slice(0, 90), slice(90, 150), slice(150, None))):
        part = table.take(np.arange(len(table))[rows])
        pq.write_table(part, file.with_name(f"file-00{2 - k}.parquet"))
    for number in (0, 3):
        source, log = LogSource(topic=f"episode_{number}"), make_log(100 + number)
        back = read_log(path, JOINTS, needs="commands", units=DEGREES, source=source)
        np.testing.assert_allclose(back.t, np.arange(100 + number) / 50, atol=1e-6)
        np.testing.assert_allclose(back.q, log.q + np.deg2rad(number), atol=1e-6)
        np.testing.assert_allclose(back.q_ref, log.q_ref, atol=1e-6)


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_each_log_of_a_job_is_an_episode_of_its_own(tmp_path, version):
    path = dataset(tmp_path, version, episodes=(3, 12))
    logs = {number: path / f"episode_{number}" for number in (12, 3)}
    for number, episode in logs.items():
        log = read_log(episode, JOINTS, needs="commands", units=DEGREES)
        assert log.name == f"episode_{number}"
        q = make_log(100 + number).q + np.deg2rad(number)
        np.testing.assert_allclose(log.q, q, atol=1e-6)
    with pytest.raises(DataError, match="arm has no episode 'episode_4'"):
        read_log(path / "episode_4", JOINTS, needs="commands", units=DEGREES)
    other = LogSource(topic="episode_3")
    with pytest.raises(SettingsError, match=r"topic is 'episode_3', but the log is episode_12 of"):
        read_log(logs[12], JOINTS, needs="commands", source=other)
    first, second = map(file_sha256, logs.values())
    assert len({first, second, file_sha256(path)}) == 3
    assert source_entry(str(logs[3])) == {"path": str(logs[3]), "sha256": second}
    (file, *_) = sorted(path.glob("data/**/*.parquet"))
    file.write_bytes(b"x")
    assert file_sha256(logs[12]) != first
    assert log_exists(logs[12])
    assert not log_exists(tmp_path / "episode_3")


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_one_episode_of_several_is_stated(tmp_path, version):
    path = dataset(tmp_path, version, episodes=(0, 3, 12))
    with pytest.raises(DataError, match=r"arm has 3 episodes: episode_0, episode_12, episode_3"):
        read_log(path, JOINTS, needs="commands", units=DEGREES)
    for topic in ("episode_3", "3", "episode_000003"):
        source = LogSource(topic=topic)
        log = read_log(path, JOINTS, needs="commands", units=DEGREES, source=source)
        assert len(log.t) == 103
        np.testing.assert_allclose(log.q, make_log(103).q + np.deg2rad(3), atol=1e-6)
    with pytest.raises(
        DataError, match=r"no episode 'episode_4'; episodes: episode_0, episode_3, "
    ):
        read_log(path, JOINTS, units=DEGREES, source=LogSource(topic="episode_4"))


@pytest.mark.parametrize("topic", ["9" * 5000, "²", "episode_٠", "-0", "x"])
def test_an_episode_that_no_dataset_has_is_refused(tmp_path, topic):
    with pytest.raises(DataError, match=r"no episode '.{1,43}'; episodes: episode_0"):
        read_log(dataset(tmp_path), JOINTS, units=DEGREES, source=LogSource(topic=topic))


def test_normalised_positions_are_no_angles(tmp_path):
    with pytest.raises(DataError) as error:
        read_log(dataset(tmp_path), JOINTS, needs="commands")
    assert error.value.code == "angle_unit"
    assert str(error.value).startswith(
        "arm: the unit of positions is not in the files of LeRobot. By version and use_degrees"
    )


MISSING, NAMELESS = object(), "no names of the motors in ac"
DOUBLE = "same name for .* of action, number 1, and number 0 of action; give each motor another"


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (MISSING, "does not describe a LeRobot dataset of version 2"),
        (None, "features is None, wanted a table of tables"),
        ({"action": 5}, "wanted a table of tables"),
        ({"image": {}}, "neither observation.state nor action"),
        *[({"action": {"names": names}}, NAMELESS)
          for names in (None, 5, {"m": 5}, [["a"], 5])],
        ({"action": {"names": ["a", *JOINTS]}}, "at least 3 names of motors"),
        ({"action": {"names": [JOINTS[0], JOINTS[0]]}}, DOUBLE),
        ({"action": {"names": [f"{JOINTS[0]}.pos", JOINTS[0]]}}, DOUBLE),
    ],
)  # fmt: skip
def test_datasets_that_do_not_fit_are_refused(tmp_path, change, text):
    path = dataset(tmp_path)
    file = path / "meta" / "info.json"
    info = json.loads(file.read_text())
    features = info.pop("features")
    if change is not MISSING:
        info["features"] = features | change if change and "action" in change else change
    file.write_text(json.dumps(info))
    with pytest.raises(DataError, match=text):
        read_log(path, JOINTS, needs="commands", units=DEGREES)


@pytest.mark.parametrize("text", ["[" * 5000, "{", '{"features": ' * 60 + "1" + "}" * 60, "5"])
def test_a_description_that_is_none_is_refused(tmp_path, text):
    path = dataset(tmp_path)
    (path / "meta" / "info.json").write_text(text)
    with pytest.raises(DataError, match=r"info\.json"):
        read_log(path, JOINTS, needs="commands", units=DEGREES)
