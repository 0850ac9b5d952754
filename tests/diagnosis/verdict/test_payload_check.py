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


def test_the_message_has_both_masses_their_difference_and_what_follows():
    assert SHARP.message == (
        "payload of 2 kg on tool0: torque alone determines 2.02 kg (95 % interval 2 to 2.04), "
        "+1.0 %, 2.0 standard errors; wanted: at most 5 %"
    )
    low = replace(SHARP, identified=1.8, std_error=0.05, interval=(1.7, 1.9))
    assert "1.8 kg (95 % interval 1.7 to 1.9), -10.0 %, 4.0 standard errors" in low.message
    assert "about 10 % too small, and so are masses and inertias: divide the" in low.message
    assert "by 0.9, or check the known mass" in low.message
    assert "about 10 % too large" in replace(low, identified=2.2, interval=(2.1, 2.3)).message
    wide = replace(SHARP, interval=(1.8, 2.24)).message
    assert wide.endswith(
        "2.0 standard errors. This neither verifies nor contradicts the scale; wanted: a "
        "difference and a half-width of the interval of at most 5 %. Use a larger payload, or a "
        "longer motion"
    )
    unknown = PayloadCheck("tool0", 2.0)
    assert "the motion does not determine its mass" in unknown.message
    assert not unknown.verifies
    assert not unknown.contradicts


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


def test_every_payload_counts_and_is_in_the_message():
    like = ScaleCheck(scale=1.0, factor=1.0, masses=(20.0, 20.0, 0.0))
    wide = replace(SHARP, known=1.0, identified=1.02, interval=(0.8, 1.24), log="small.csv")
    wrong = replace(SHARP, known=3.0, identified=3.6, interval=(3.4, 3.8), log="large.csv")
    both = replace(like, payloads=(SHARP, wide))
    assert both.agrees
    second = both.message.split(". Payload of 1 kg on tool0: ")[1]
    assert second.startswith("torque alone determines 1.02 kg (95 % interval 0.8 to 1.24)")
    every = replace(like, payloads=(SHARP, wide, wrong))
    assert every.contradicts
    assert not every.agrees
    first, verified = every.message.split(". Absolute scale verified by a payload of known mass: ")
    assert first == f"absolute scale contradicted by a payload of known mass: {wrong.message}"
    assert verified.startswith(SHARP.message)
    assert verified.endswith(f"P{wide.message[1:]}")
    assert [x["known"] for x in every.to_dict()["payloads"]] == [2.0, 1.0, 3.0]
