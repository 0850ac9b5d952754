"""A drive term that the package does not have is a class with its law, and its entries."""

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.driven import driven, driven_log, fitted_in
from helpers.paths import URDF

from robotid.dynamics.friction_projection import drive_moments, project_friction
from robotid.output.files.mjcf import write_mjcf
from robotid.output.report.pictures import friction_chart
from robotid.robot.drive_term import Family, MemorylessTerm, Shape
from robotid.robot.drives import FAMILIES, TERM_CLASSES, term_from_dict
from robotid.robot.model import RobotModel

JOINT = "joint_1"
TRUE, SIZE, SPEED = f"{JOINT}.bend", 1.4, 0.25


@dataclass(frozen=True)
class Bend(MemorylessTerm):
    """Friction that sets in over a speed, tau = x atan(w / w_b)."""

    speed: float = 0.1

    label = "bend"
    guards = "v"
    usual = (0.3, 0.6)

    @staticmethod
    def speed_law(w, speed):
        z = w / speed
        return np.arctan(z), 1.0 / (speed * (1.0 + z * z))


@pytest.fixture
def bend(monkeypatch):
    """The term with its family in the catalogue, a robot that has it, and its parameters."""
    family = Family(
        "bend", "friction that bends", lambda own, speed: (Bend(data_range=own["v"], speed=speed),),
        (Shape("speed", ("rad/s", "m/s"), (0.01, 0.5), "v"),), is_automatic=True,
    )  # fmt: skip
    monkeypatch.setitem(TERM_CLASSES, "Bend", Bend)
    monkeypatch.setitem(FAMILIES, "bend", family)
    plain = RobotModel.from_urdf(URDF / "planar_2r.urdf")
    term = Bend(data_range=(0.0, 30.0), speed=SPEED)
    true, pi = driven(plain, {JOINT: (term,)}, {TRUE: SIZE})
    return SimpleNamespace(plain=plain, true=true, pi=pi, term=term)


def law(v):
    """Return the friction of the joint beside viscous and Coulomb's."""
    return SIZE * np.arctan(v / SPEED)


def test_a_new_term_is_identified_drawn_and_exported(bend, tmp_path):
    log = driven_log(bend.true, bend.pi, 3, duration=20.0, noise=0.001)
    found = fitted_in(bend.plain, [log], friction={JOINT: "bend", "*": "none"})
    (choice,) = found.drives
    ((shape,), (own,)) = choice.shapes, found.model.layout.own[JOINT]
    assert abs(shape.value - SPEED) < 3 * shape.std_error < 0.1 * SPEED
    assert term_from_dict(own.to_dict()) == own
    values = dict(zip(found.model.layout.names, found.standard, strict=True))
    assert values[TRUE] == pytest.approx(SIZE, rel=0.1)

    chart = friction_chart(found, JOINT)
    steady, v = chart.series[2].y, chart.x
    truth = dict(zip(bend.true.layout.names, bend.pi, strict=True))
    viscous, coulomb, offset = (truth[f"{JOINT}.{x}"] for x in ("viscous", "coulomb", "offset"))
    wanted = law(v) + viscous * v + coulomb * np.sign(v) + offset
    drawn = np.isfinite(steady)  # the line breaks where friction reverses
    np.testing.assert_allclose(steady[drawn], wanted[drawn], atol=0.05)
    assert drawn.sum() > 100

    rows = [(e.recording.trajectory, e.recording.mask) for e in found.fitted]
    moments = drive_moments(found.model, rows)
    simple = project_friction(found.model, found.standard, moments, ("viscous", "coulomb"))
    (drive,) = simple.drives
    assert drive.replaced == ("bend",)
    write_mjcf(simple.model, simple.pi, tmp_path / "robot.xml")
    (joint,) = (x for x in ET.parse(tmp_path / "robot.xml").iter("joint") if x.get("name") == JOINT)
    assert float(joint.get("damping")) == pytest.approx(drive.values["viscous"])
