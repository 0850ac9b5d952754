"""The switch of the shown prediction: URDF, URDF + drives, identified."""

import numpy as np
import pytest
from helpers.browsing import until, visit
from helpers.paths import URDF

from robotid.output.viewer.replays import Torques, replay
from robotid.robot.model import RobotModel

T = np.linspace(3.0, 5.0, 200)  # [s]
SIZES = {"identified": 0.1, "URDF + drives": 0.3, "URDF": 0.6}  # [N m] residuals


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    model = RobotModel.from_urdf(URDF / "planar_2r.urdf")
    q = np.column_stack([np.sin(T), np.cos(T)])
    tau = 5.0 * q
    predicted = {label: tau + size for label, size in SIZES.items()}
    torques = Torques(T, tau, predicted, np.array([0.1, 0.2]))
    shown = replay(model, T, q, torques=torques, log="second.csv")
    return shown.write(tmp_path_factory.mktemp("choice") / "replay.html")


@pytest.fixture(scope="module")
def seen(browser, page):
    with visit(browser, page, size=(900, 620), reduced_motion="reduce") as opened:
        opened.page.locator(".plot").first.scroll_into_view_if_needed()
        until(opened, "replay.torqueCharts[0].below.plot !== null")
        yield opened
        assert opened.errors == []


def shown(seen):
    """Return the mean residual that chart, strip and arc show of the first joint [N m]."""
    return seen.page.evaluate(
        """() => {
          const { chart, below } = replay.torqueCharts[0];
          const labels = chart.what.series.map((s) => s.label);
          const visible = labels.filter((_, i) => !chart.hidden.has(i)), [residual] = below.ys;
          replay.seek(4);
          return { visible, chart: residual.reduce((a, b) => a + b) / residual.length,
            strip: 0.1 * replay.level(10, 0),
            colour: replay.arcs[0].measured.material.color.getStyle() };
        }"""
    )


@pytest.mark.parametrize("label", ["URDF", "URDF + drives", "identified"])
def test_charts_strip_and_arcs_show_the_selected_prediction(seen, label):
    seen.page.get_by_label(label, exact=True).check()
    found = shown(seen)
    assert found["visible"] == ["measured", label]
    assert found["chart"] == pytest.approx(-SIZES[label], abs=1e-3)
    assert found["strip"] == pytest.approx(SIZES[label], abs=2e-3)
    share = SIZES[label] / 0.1 / 6.0  # of the full scale: blue, yellow, red
    red = 255 if share >= 0.5 else 43 + 2 * share * (255 - 43)
    red -= max(0.0, 2 * share - 1) * (255 - 215)
    assert int(found["colour"][4:].split(",")[0]) == pytest.approx(red, abs=1.5)
