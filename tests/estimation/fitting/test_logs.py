"""Segments that logs in memory are cut into."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.driven import arm
from helpers.synthetic import exact_log, truth

from robotid.base.exceptions import DataError
from robotid.data.signal_settings import SignalSettings
from robotid.dynamics.base_parameters import structural_mapping
from robotid.estimation.fitting import recorded as recordings_module
from robotid.estimation.fitting.recorded import Recordings, RepeatedErrors
from robotid.estimation.fitting.survey import hold_log


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
    np.testing.assert_allclose(
        squares, sum(np.sum(log.whole.trajectory.tau**2, axis=0) for log in logs)
    )


def test_logs_in_files_have_segments_as_many_as_fit_into_the_memory(monkeypatch):
    """The factors of three logs of 7 joints and 120 parameters share 64 MB."""
    given = []

    def joined(found, count, most):
        parts = list(found)
        given.append((parts, count, most))
        return parts

    monkeypatch.setattr(recordings_module, "join_segments", joined)
    parts = [SimpleNamespace(samples=k) for k in (0, 5, 3, 2, 9, 1)]
    logs = [
        SimpleNamespace(pieces=[None] * n, is_in_memory=False, too_short=lambda: DataError("short"))
        for n in (2, 1, 3)
    ]
    plan = SimpleNamespace(reduce=lambda pieces: iter(parts))
    mapping = SimpleNamespace(independent=np.arange(120))
    recordings = Recordings(SimpleNamespace(n_rows=7), mapping, logs, plan=plan)
    assert recordings.reduce() == tuple(parts)
    most = 2**26 // (8 * 7 * 121**2 * 3)
    assert 8 < most < 64
    assert given == [(parts[:2], 2, most), (parts[2:3], 1, most), (parts[3:], 3, most)]
    parts[2].samples = 0
    with pytest.raises(DataError, match="short"):
        recordings.reduce()


def test_errors_that_repeat_are_described_with_their_figures():
    root, bias = np.eye(2), np.array([0.1234, -0.5, 0.0625])
    none = RepeatedErrors(root, 1.0, 0.0)
    assert none.described == ""
    points = RepeatedErrors(root, 1.0, 0.0125)
    assert points.described == "points of contact uncertain by 0.013 m"
    both = RepeatedErrors(root, 1.0, 0.0125, bias, 0.025, has_motion=True)
    assert both.described == (
        "points of contact uncertain by 0.013 m; bias of the accelerometers, estimated and "
        "subtracted: +0.123, -0.500, +0.062 m/s^2, uncertain by 0.025 m/s^2; errors of the motion "
        "of the base that would cause the residual"
    )
    alone = RepeatedErrors(root, 1.0, 0.0, has_motion=True)
    assert alone.described == "errors of the motion of the base that would cause the residual"
