"""The worst second of a joint: its window, its figures, and the link that opens it in a replay."""

import numpy as np
import pytest

from robotid.output.report.report_page import Residual, worst_second

T = 100.0 + np.arange(1000) / 100  # [s] 10 s at 100 Hz


def residual(values, t=T, name="a.csv"):
    return Residual(f"{name} window", name, t, np.asarray(values, dtype=float))


def burst(start, size, length=1.0, noise=0.1):
    inside = (start <= T) & (start + length - 0.005 > T)
    return np.where(inside, size, noise)


def test_the_window_is_where_the_burst_is():
    others = [residual(burst(107.0, 1.0, noise=x), name="b.csv") for x in (0.1, 1e-3)]
    worst = worst_second([others[0], residual(burst(103.5, 2.0)), others[1]])
    assert (worst.of.file, worst.start, worst.end) == ("a.csv", pytest.approx(103.5), 104.5)
    assert worst.rms == pytest.approx(2.0)
    whole = np.sqrt(0.1 * 2.0**2 + 0.9 * 0.1**2)
    assert worst.ratio == pytest.approx(2.0 / whole)


def test_the_figure_is_that_of_every_window():
    values = np.random.default_rng(3).standard_normal(1000) * (1 + np.sin(T))
    rms = [np.sqrt(np.mean(values[k : k + 100] ** 2)) for k in range(901)]
    worst = worst_second([residual(values)])
    assert worst.rms == pytest.approx(max(rms))
    assert worst.start == pytest.approx(T[int(np.argmax(rms))])


@pytest.mark.parametrize("share", [0.4, 0.6])
def test_a_window_needs_half_of_its_samples(share):
    values = burst(102.0, 5.0)
    unused = (T > 101.0) & (T < 104.0) & ~((T >= 102.0) & (102.0 + share - 0.005 > T))
    values[unused] = np.nan
    worst = worst_second([residual(values)])
    assert worst.rms == pytest.approx(5.0 if share > 0.5 else 0.1)


def test_a_window_at_a_gap_has_half_of_its_samples_at_least():
    t = np.where(T < 105.0, T, T + 60.0)
    values = np.full(1000, 0.1)
    values[490:500] = 9.0  # the last 0.1 s before the gap
    worst = worst_second([residual(values, t)])
    assert worst.start == pytest.approx(104.5, abs=0.011)
    assert worst.rms == pytest.approx(np.sqrt((10 * 81 + 40 * 0.01) / 50), rel=0.02)
