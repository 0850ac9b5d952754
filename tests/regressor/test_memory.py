"""What drives remember along a motion."""

import numpy as np
import pytest
from helpers.robots import motion

from robotid.regressor.memory import bears_load, remember
from robotid.robot.drives import Lag, LoadFriction, Presliding


@pytest.mark.parametrize(
    ("term", "is_loaded"), [(Presliding(), False), (LoadFriction(), True), (Lag(), True)]
)
def test_bristles_alone_remember_the_same_whatever_the_bodies_weigh(ur5, rng, term, is_loaded):
    model = ur5.with_terms({ur5.joints[1]: (term,)})
    assert bears_load(model) is is_loaded
    trajectory, pi = motion(model, rng, 50), model.standard_parameters()
    light, heavy = (remember(model.with_reference(x * pi), trajectory).memory for x in (1.0, 2.0))
    assert np.array_equal(light, heavy) is not is_loaded
