"""A payload of known mass: when it verifies or contradicts the scale, and the words for it."""

from dataclasses import replace

import pytest

from robotid.diagnosis.verdict.scale_check import PayloadCheck, ScaleCheck, StatedMass

SHARP = PayloadCheck("tool0", 2.0, 2.02, 0.01, (2.0, 2.04), "loaded.csv", "ab")


@pytest.mark.parametrize(
    ("identified", "half", "verifies", "contradicts"),
    [
        (2.09, 0.099, True, False),
        (2.09, 0.101, False, False),  # the interval is too wide
        (2.09, 0.08, True, False),  # the known mass is outside, but the masses are alike
        (1.91, 0.02, True, False),
        (2.11, 0.10, False, True),
        (2.11, 0.12, False, False),  # the known mass is in the interval
        (1.89, 0.10, False, True),
    ],
)
def test_five_percent_and_the_interval_decide(identified, half, verifies, contradicts):
    check = replace(SHARP, identified=identified, interval=(identified - half, identified + half))
    assert (check.verifies, check.contradicts) == (verifies, contradicts)
    assert check.ratio == pytest.approx(identified / 2.0)


def test_it_decides_before_the_urdf_and_a_contradiction_before_all():
    urdf = ScaleCheck(scale=1.2, factor=1.2, masses=(20.0, 24.0, 0.0))
    assert not urdf.agrees
    verified = replace(urdf, payloads=(SHARP,))
    assert verified.agrees
    assert verified.message == (
        f"absolute scale verified by a payload of known mass: {SHARP.message}"
    )
    wrong = replace(SHARP, identified=2.4, interval=(2.3, 2.5))
    like = ScaleCheck(scale=1.0, factor=1.0, masses=(20.0, 20.0, 0.0), payloads=(wrong,))
    assert like.contradicts
    assert like.message.startswith("absolute scale contradicted by a payload of known mass: pay")
    open_ = replace(urdf, payloads=(replace(SHARP, interval=(1.8, 2.24)),))
    assert not open_.agrees
    assert not open_.contradicts
    assert open_.message.endswith("Use a larger payload, or a longer motion")
    stated = StatedMass(("total_mass",), ratio=1.2, half_width=0.01)
    both = replace(verified, stated=stated)
    assert both.contradicts
    assert not both.agrees
    first, second = both.message.split(". Absolute scale ")
    assert first.startswith("absolute scale contradicted by a stated mass")
    assert second.startswith("verified by a payload of known mass")
    assert PayloadCheck.from_dict(both.to_dict()["payloads"][0]) == SHARP
