"""Scales of gains that are concluded, and those that are not."""

import numpy as np
import pytest

from robotid.closed_loop.gain_check import GainScale


@pytest.mark.parametrize(
    ("change", "common", "is_wrong"),
    [
        ((-0.2, -0.18), -0.19, True),
        ((0.2, 0.18), 0.19, True),
        ((-0.03, -0.03), -0.03, False),  # small
        ((-0.2, 0.6), -0.19, False),  # one joint shows another
    ],
)
def test_gains_are_wrong_where_all_joints_show_it(change, common, is_wrong):
    scale = GainScale(np.array(change), np.array([0.05, 0.05]), common, 0.006)
    assert scale.is_wrong is is_wrong
    unsure = GainScale(np.array(change), np.array([0.05, 0.05]), common, 0.07)
    assert not unsure.is_wrong
