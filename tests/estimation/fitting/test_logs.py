"""Segments that logs in memory are cut into."""

import numpy as np
import pytest
from helpers.driven import arm
from helpers.synthetic import exact_log, truth

from robotid.data.signal_settings import SignalSettings
from robotid.dynamics.base_parameters import structural_mapping
from robotid.estimation.fitting.recorded import Recordings, RepeatedErrors, hold_log


@pytest.mark.parametrize(
    ("cutoff", "sizes", "segments"),
    [
        (None, (1200,), [25] * 48),
        (None, (1200, 600), [50] * 24 + [25] * 24),  # 48 of both logs together
        (5.0, (1200, 600), [50] * 24 + [50] * 12),  # ten times the filter's five rows at least
    ],
)
def test_all_logs_together_have_48_stretches_of_ten_correlation_times_or_more(
    rng, cutoff, sizes, segments
):
    model, signals = arm(), SignalSettings(cutoff=cutoff, trim=0.0, min_velocity=0.0)
    logs = [hold_log(model, exact_log(model, truth(model), rng, samples=n), signals) for n in sizes]
    recordings = Recordings(model, structural_mapping(model), logs)
    found = recordings.reduce()
    assert [reduction.samples for reduction in found] == segments
    whole = recordings.reduce(is_cut=False)
    assert [reduction.samples for reduction in whole] == list(sizes)
    squares = sum(reduction.factors.torque_squares() for reduction in found)
    wanted = sum(np.sum(log.whole.trajectory.tau**2, axis=0) for log in logs)
    np.testing.assert_allclose(squares, wanted)


def test_errors_that_repeat_in_every_row_are_described_by_their_sizes():
    bias = np.array([0.1, -0.2, 0.003])
    errors = RepeatedErrors(np.eye(2), 1.0, 0.0123, bias, bias_error=0.045)
    assert errors.described == (
        "points of contact uncertain by 0.012 m; bias of the accelerometers, estimated and "
        "subtracted: +0.100, -0.200, +0.003 m/s^2, uncertain by 0.045 m/s^2"
    )
    assert RepeatedErrors(np.eye(2), 1.0, 0.0).described == ""
