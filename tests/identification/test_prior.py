import numpy as np
from helpers.synthetic import exact_log, truth

from robotid.identification.prior import prior_spread
from robotid.logs.settings import SignalSettings
from robotid.logs.signals import process


def test_the_spread_has_the_size_of_the_robot(ur5, rng):
    log = exact_log(ur5, truth(ur5), rng)
    trajectory = process(log, SignalSettings(cutoff=None, trim=0.0))
    spread = dict(zip(ur5.layout.names, prior_spread(ur5, [trajectory]), strict=True))
    assert spread["forearm_link.m"] == ur5.tree.inertials["forearm_link"].mass
    radius = spread["forearm_link.mcx"] / spread["forearm_link.m"]
    assert 0.1 < radius < 1.0
    assert np.isclose(spread["forearm_link.Ixy"], spread["forearm_link.m"] * radius**2)
    rms = np.sqrt(np.mean(log.tau**2, axis=0))
    assert np.isclose(spread["elbow_joint.coulomb"], rms[2])
    assert min(spread.values()) > 0


def test_a_massless_link_still_has_a_spread(rng, ur5):
    light = ur5.with_parameters(0 * ur5.standard_parameters())
    log = exact_log(ur5, truth(ur5), rng)
    trajectory = process(log, SignalSettings(cutoff=None, trim=0.0))
    assert (prior_spread(light, [trajectory]) > 0).all()
