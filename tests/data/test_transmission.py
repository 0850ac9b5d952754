"""Motor columns become joint columns through the gears, or are refused by name."""

import re

import numpy as np
import pytest

from robotid.base.exceptions import DataError, SettingsError
from robotid.data.files.read import read_log, write_columns
from robotid.data.signal_settings import LogUnits, Transmission

JOINTS = ("shoulder", "elbow", "wrist")
# the last motor turns with the last two joints
WRIST = dict(joints=("elbow", "wrist"), motors=("m2", "m3"), matrix=((45.0, 0.0), (32.0, -30.0)))
MOTORS = (
    Transmission(joints=("shoulder",), motors=("m1",), matrix=(-101.0,), efficiency=(0.8,)),
    Transmission(**WRIST, efficiency=(0.9, 0.7), offset=(0.3, -1.2)),
)
T = np.array([[-101.0, 0, 0], [0, 45, 0], [0, 32, -30]])
OFFSET, EFFICIENCY = np.array([0, 0.3, -1.2]), np.array([0.8, 0.9, 0.7])


@pytest.fixture
def motion(rng):
    """Positions, speeds and torques of the joints, by kind."""
    return {kind: rng.uniform(-1, 1, (20, 3)) for kind in ("q", "dq", "tau")}


def motor_side(motion):
    """What motors do that drive the joints so: w = T v, q_m = T (q - q_0), power passes."""
    tau_m = np.linalg.solve(T.T, motion["tau"].T).T / EFFICIENCY
    moved = {"qm": (motion["q"] - OFFSET) @ T.T, "dqm": motion["dq"] @ T.T, "taum": tau_m}
    return {"time": np.arange(20) / 100} | {
        f"{kind}_m{i + 1}": x[:, i] for kind, x in moved.items() for i in range(3)
    }


def save(path, table):
    write_columns(table, path)
    return path


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_motor_columns_become_those_of_the_joints(tmp_path, motion, suffix):
    path = save(tmp_path / f"run{suffix}", motor_side(motion))
    log = read_log(path, JOINTS, transmissions=MOTORS)
    assert log.notes == ()
    for kind, values in (("q", log.q), ("dq", log.v), ("tau", log.tau)):
        np.testing.assert_allclose(values, motion[kind], atol=1e-12)
    # without losses, the motors give the power that the joints take
    table, lossless = motor_side(motion), Transmission(**WRIST)
    own = read_log(path, JOINTS, transmissions=(MOTORS[0], lossless))
    power = sum(table[f"taum_{m}"] * table[f"dqm_{m}"] for m in ("m2", "m3"))
    np.testing.assert_allclose(np.sum(own.tau[:, 1:] * own.v[:, 1:], axis=1), power)


def test_each_quantity_may_be_of_either_side(tmp_path, motion):
    table = {name: x for name, x in motor_side(motion).items() if not name.startswith("qm")}
    table |= {f"q_{joint}": motion["q"][:, j] for j, joint in enumerate(JOINTS)}
    log = read_log(save(tmp_path / "run.csv", table), JOINTS, transmissions=MOTORS)
    np.testing.assert_array_equal(log.q, motion["q"])
    np.testing.assert_allclose(log.tau, motion["tau"], atol=1e-12)


def test_currents_of_motors_take_gains_at_the_motor_and_angles_may_be_degrees(tmp_path, motion):
    table = motor_side(motion)
    table["currentm_m3"] = table.pop("taum_m3") / 0.12
    table |= {name: np.rad2deg(x) for name, x in table.items() if name[:2] in ("qm", "dq")}
    path = save(tmp_path / "run.csv", table)
    units = LogUnits(angle="deg")
    log = read_log(
        path, JOINTS, transmissions=MOTORS, gains={"m3": 0.12}, units=units, prismatic=["wrist"]
    )
    np.testing.assert_allclose(log.q, motion["q"], atol=1e-12)  # what turns is the motor
    np.testing.assert_allclose(log.tau, motion["tau"], atol=1e-12)
    with pytest.raises(DataError, match=r"'m3' has the current 'currentm_m3' but no gain"):
        read_log(path, JOINTS, transmissions=MOTORS, units=units)


def test_joints_of_a_transmission_are_all_read(tmp_path, motion):
    path = save(tmp_path / "run.csv", motor_side(motion))
    text = "transmission: wrist are not among the joints identified: shoulder, elbow. Leave them"
    with refused(text, SettingsError):
        read_log(path, JOINTS[:2], transmissions=MOTORS)


def test_motors_of_several_joints_drive_in_the_place_of_the_joints_without_their_own():
    assert Transmission(**WRIST).shared == {"wrist": (("elbow", 1.0), ("wrist", -30.0 / 32.0))}
    assert Transmission(**WRIST).gears == {"elbow": 45.0, "wrist": 32.0}
    assert Transmission(joints=JOINTS, matrix=(3.0, -4.0, 5.0)).shared == {}
    assert Transmission(joints=("a", "b"), matrix=(1e6, -1e-6)).gears == {"a": 1e6, "b": -1e-6}
    crossed = Transmission(joints=("a", "b"), motors=("x", "y"), matrix=((0, 7.0), (8.0, 8.0)))
    assert crossed.shared == {"a": (("a", 1.0), ("b", 1.0))}
    assert crossed.gears == {"b": 7.0, "a": 8.0}
    back = Transmission(
        joints=("a", "b", "c"), matrix=((5.0, 0, 0), (0, 3.0, -32.0), (0, 2.0, 7.0))
    )
    assert back.shared == {
        "b": (("b", 3.0 / -32.0), ("c", 1.0)),
        "c": (("b", 2.0 / 7.0), ("c", 1.0)),
    }
    assert back.gears == {"a": 5.0, "b": -32.0, "c": 7.0}


def refused(text, kind=DataError):
    return pytest.raises(kind, match="^" + re.escape(text))


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (
            {"matrix": ((1.0, 1.0), (2.0, 2.0))},
            "transmission of elbow, wrist: matrix [[1.0, 1.0], [2.0, 2.0]] is singular, so the "
            "motor positions do not determine the joint positions. Each row is a motor",
        ),
        ({"matrix": (10.0, 0.0)}, "transmission of elbow, wrist: matrix [10.0, 0.0] is singular"),
        (
            {"matrix": ((1.0, 1.0),)},
            "transmission of elbow, wrist: matrix is [[1.0, 1.0]], wanted 2 rows of 2 numbers",
        ),
        ({"motors": ("m2", "m2")}, "transmission: motors contains m2 twice"),
        ({"motors": ("m2",)}, "transmission of elbow, wrist: motors has 1 entries, wanted 2"),
        ({"efficiency": (0.9, 1.2)}, "transmission: efficiency of 'm3' is 1.2, wanted more than 0"),
        ({"matrix": "file"}, "transmission: matrix is 'file', wanted rows of numbers"),
    ],
)
def test_an_impossible_transmission_is_refused(change, text):
    with refused(text, SettingsError):
        Transmission(**(WRIST | change))


def test_both_sides_of_one_joint_are_refused(tmp_path, motion):
    path = save(tmp_path / "run.csv", motor_side(motion) | {"q_wrist": motion["q"][:, 2]})
    text = (
        "run.csv has 'qm_m2' of a motor and 'q_wrist' of a joint that it drives, two position "
        "columns of one transmission; remove the columns of the motors"
    )
    with refused(text):
        read_log(path, JOINTS, transmissions=MOTORS)


def test_motor_columns_without_gears_and_gears_without_a_motor_column_are_named(tmp_path, motion):
    table = motor_side(motion)
    path = save(tmp_path / "run.csv", table)
    with pytest.raises(DataError, match=r"For columns of motors, as qm_m1, state \[\[trans"):
        read_log(path, JOINTS)
    del table["taum_m2"]
    with pytest.raises(DataError, match=r"^run.csv has no column 'taum_m2'; torque or current"):
        read_log(save(path, table), JOINTS, transmissions=MOTORS)


def test_a_motor_or_joint_in_two_transmissions_is_refused(tmp_path, motion):
    path = save(tmp_path / "run.csv", motor_side(motion))
    for noun, other in (("motors m3", ("a", "m3")), ("joints wrist", ("wrist", "m4"))):
        more = Transmission(joints=other[:1], motors=other[1:], matrix=(1.0,))
        with refused(f"several transmissions contain the {noun}", SettingsError):
            read_log(path, JOINTS, transmissions=[*MOTORS, more])


def test_gear_ratios_of_the_urdf_are_used_only_if_asked_for():
    asked = Transmission(joints=("elbow", "wrist"), matrix="urdf")
    assert asked.stated({"wrist": -80.0, "elbow": 50.0, "other": 1.0}).T.tolist() == [
        [50.0, 0.0], [0.0, -80.0],
    ]  # fmt: skip
    stated = Transmission(**WRIST)
    assert stated.stated({"wrist": 9.0}) is stated
    with refused(
        "transmission: matrix is 'urdf', but the URDF has no <transmission> with a "
        "<mechanicalReduction> only for elbow; it has one for wrist. State",
        SettingsError,
    ):
        asked.stated({"wrist": 80.0})
