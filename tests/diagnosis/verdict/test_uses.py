"""What a result can be used for: each use with its condition."""

import pytest

from robotid.diagnosis.verdict.scale_check import ScaleCheck
from robotid.diagnosis.verdict.verdict import uses_line, uses_of_motion, uses_of_torques

VERIFIED = ScaleCheck({"a": 1.0, "b": 1.0}, scale=1.0, factor=1.0, masses=(20.0, 20.0, 0.0))
OPEN = ScaleCheck({"a": 1.2, "b": 1.2}, scale=1.2, factor=1.2, masses=(20.0, 24.0, 0.0))
WRONG = ScaleCheck({"a": 2.0}, scale=2.0, factor=2.0, masses=(20.0, 40.0, 0.0))
SCALE = "yes, torque scale not verified"


def uses(*statuses, scale_check=VERIFIED, **changes):
    """Return the three uses of a result with joints a, b, c."""
    stated = {"is_consistent": True, "is_static": False, "log_errors": ()} | changes
    joints = dict(zip("abc", statuses, strict=False))
    return tuple(uses_of_torques(joints, scale_check=scale_check, **stated).values())


@pytest.mark.parametrize(
    ("statuses", "scale_check", "changes", "wanted"),
    [
        (("good",) * 3, VERIFIED, {}, ("yes", "yes", "yes")),
        (("good",) * 3, OPEN, {}, ("yes", SCALE, SCALE)),
        (("good",) * 3, None, {}, ("yes", SCALE, "no, no joint determines its gravity")),
        (("good",) * 3, WRONG, {}, ("yes", *["no, the torque scale is contradicted"] * 2)),
        (("good", "usable", "good"), VERIFIED, {}, ("yes, with the warnings",) * 3),
        # gravity loads a and b only
        (("good", "good", "poor"), VERIFIED, {},
         ("yes, without c", "no, torques of c are poor", "yes")),
        (("poor", "good", "good"), VERIFIED, {},
         ("yes, without a", "no, torques of a are poor", "yes, without a")),
        (("poor",) * 3, VERIFIED, {},
         ("no, the errors on validation logs are large", "no, torques of a, b, c are poor",
          "no, the errors on validation logs are large")),
        (("not evaluated",) * 3, VERIFIED, {}, ("not verified, no validation log",) * 3),
        (("good",) * 3, VERIFIED, {"is_consistent": False},
         ("yes", "no, not physically consistent", "yes")),
        (("good",) * 3, VERIFIED, {"is_static": True},
         ("yes, at rest and in slow motion", "no, inertias are the URDF's", "yes")),
        (("good",) * 3, VERIFIED, {"log_errors": ("x",)}, ("no, errors of the recordings",) * 3),
    ],
)  # fmt: skip
def test_uses_follow_from_joints_consistency_and_scale(statuses, scale_check, changes, wanted):
    assert uses(*statuses, scale_check=scale_check, **changes) == wanted


def test_the_scale_of_positions_comes_from_a_torque_only():
    joints = {"a": "good", "b": "not evaluated"}
    found = uses_of_motion(joints, log_errors=(), is_scaled=False)
    assert [*found.values()] == [
        "yes, without b (not evaluated)",
        "yes, without b (not evaluated), scale not verified by a torque",
        "no, it needs a result from logged torques",
    ]
    scaled = uses_of_motion({"a": "good"}, log_errors=(), is_scaled=True)
    assert uses_line(scaled) == (
        "use for: simulation of drives and controllers: yes; torque feed-forward: yes; "
        "payload estimation: no, it needs a result from logged torques"
    )
    wrong = uses_of_motion({"a": "good"}, log_errors=("x",), is_scaled=True)
    assert {*wrong.values()} == {
        "no, errors of the recordings", "no, it needs a result from logged torques",
    }  # fmt: skip
    assert uses_line({}) == ""
