"""Friction against the truth."""

import numpy as np
from helpers.synthetic import exact_log, truth

from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.residual.torque_split import friction_split
from robotid.estimation.fitting.evaluation import evaluate_logs
from robotid.estimation.fitting.survey import hold_log


def test_friction_is_the_torque_that_viscous_coulomb_and_offset_add(ur5, rng):
    pi = truth(ur5)
    log = hold_log(ur5, exact_log(ur5, pi, rng), SignalSettings(cutoff=None))
    ((evaluation,), ()) = evaluate_logs([log], (), {"estimate": pi}, ur5.standard_parameters())
    left, friction = friction_split(ur5, evaluation, pi)
    value = dict(zip(ur5.layout.names, pi, strict=True))
    v = evaluation.recording.trajectory.v
    for j, name in enumerate(ur5.joints):
        known = (
            value[f"{name}.viscous"] * v[:, j]
            + value[f"{name}.coulomb"] * np.sign(v[:, j])
            + value[f"{name}.offset"]
        )
        np.testing.assert_allclose(friction[:, j], known, atol=1e-9)
        np.testing.assert_allclose(left[:, j], known, atol=1e-9)
