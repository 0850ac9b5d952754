"""Hostile URDFs: what robotid cannot use it refuses in its own words, and nothing breaks."""

import os
import subprocess
import sys
from xml.sax.saxutils import quoteattr

import numpy as np
import pytest
from helpers.hostile_urdfs import FILES, MESHES, HostileUrdf, run_urdf, urdf_inputs
from hypothesis import HealthCheck, given, settings

from robotid.base.exceptions import DataError, ModelError, SettingsError
from robotid.diagnosis.urdf.inspection import inspect_urdf
from robotid.robot.bodies import find_mesh, read_surfaces
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.parameters import Coupling

CHAIN = """<link name="l{0}"/>
<joint name="j{0}" type="{2}"><parent link="l{1}"/><child link="l{0}"/></joint>"""
FEW = int(os.environ.get("ROBOTID_FUZZ", "25"))  # inputs; benchmarks/bench_fuzz.py tries thousands


@settings(max_examples=FEW, derandomize=True, database=None, deadline=None,
          suppress_health_check=list(HealthCheck))  # fmt: skip
@given(urdf_inputs())
def test_nothing_but_its_own_words_comes_of_a_hostile_urdf(tmp_path_factory, case):
    run_urdf(case, tmp_path_factory.mktemp("hostile"))


@pytest.mark.parametrize("mesh", MESHES, ids=range(len(MESHES)))
def test_no_path_of_a_mesh_breaks_anything(tmp_path, mesh):
    path, scale = quoteattr(mesh), "0 0 0" if mesh == "good.stl" else "1 1 1"
    shape = f"<geometry><mesh filename={path} scale='{scale}'/></geometry>"
    text = f"<robot name='r'><link name='l0'/>{CHAIN.format(1, 0, 'revolute')}</robot>"
    shapes = f"<visual>{shape}</visual><collision>{shape}</collision>"
    content = text.replace('<link name="l1"/>', f'<link name="l1">{shapes}</link>')
    run_urdf(HostileUrdf(content.encode(), dict(FILES)), tmp_path)


DOORS = {
    "locked at nan": (dict(locked={"elbow_joint": float("nan")}), "locked at nan, wanted a number"),
    "locked at inf": (dict(locked={"elbow_joint": float("inf")}), "locked at inf, wanted a number"),
    "locked too far": (dict(locked={"elbow_joint": 1e308}), "locked at 1e+308, wanted a number"),
    "locked at text": (dict(locked={"elbow_joint": "x"}), "locked at 'x', wanted a number within"),
    "gravity 1e308": (dict(gravity=(0, 0, 1e308)), "gravity is 0, 0, 1e+308, wanted three finite"),
    "gravity nan": (dict(gravity=(0, float("nan"), 0)), "gravity is 0, nan, 0, wanted three"),
    "gravity in mm": (dict(gravity=(0, 0, -9810)), "three finite numbers within +-100 [m/s^2]"),
    "gravity of text": (dict(gravity=("a", "b", "c")), "gravity is a, b, c, wanted three finite"),
    "no gravity": (dict(gravity=None), "gravity is None, wanted three finite"),
}  # fmt: skip


@pytest.mark.parametrize(("options", "message"), DOORS.values(), ids=DOORS)
def test_no_number_reaches_pinocchio_unchecked(options, message):
    with pytest.raises(ModelError) as caught:
        RobotModel.from_urdf(example_urdf("ur5_robot.urdf"), **options)
    assert message in str(caught.value)


@pytest.mark.parametrize("ratio", [float("nan"), float("-inf"), 1e300])
def test_ratios_of_couplings_are_checked(ratio):
    coupling = Coupling("motor", (("elbow_joint", ratio), ("wrist_1_joint", 1.0)))
    with pytest.raises(SettingsError, match="'motor': the ratio of joint 'elbow_joint' is"):
        RobotModel.from_urdf(example_urdf("ur5_robot.urdf"), couplings=[coupling])


@pytest.mark.parametrize("ratios", [(), (("elbow_joint", 0.0), ("wrist_1_joint", -0.0))])
def test_a_coupling_turns_with_some_joint(ratios):
    couplings = [Coupling("good", (("elbow_joint", 0.0), ("wrist_1_joint", 1.0)))]
    model = RobotModel.from_urdf(example_urdf("ur5_robot.urdf"), couplings=couplings)
    assert "good.armature" in model.layout.names
    with pytest.raises(SettingsError, match=r"'motor' moves no joint: its ratios are \{"):
        RobotModel.from_urdf(
            example_urdf("ur5_robot.urdf"), couplings=[*couplings, Coupling("motor", ratios)]
        )


def test_an_interpreter_survives_the_command_lines_that_aborted_it(tmp_path):
    urdf, log = str(example_urdf("ur5_robot.urdf")), str(tmp_path / "none.csv")
    job = tmp_path / "job.toml"
    job.write_text(f'urdf = "{urdf}"\ngravity = [0, 0, 1e308]\n[[identification]]\nlog = "{log}"\n')
    lines = [[urdf, log, "--lock", f"elbow_joint={value}"] for value in ("nan", "inf", "-1e308")]
    words = [["identify", *line] for line in [*lines, [str(job)]]]
    code = f"from robotid.cli import main; print([main(line) for line in {words}])"
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, cwd=tmp_path
    )
    assert run.stdout == "[2, 2, 2, 2]\n", run.stderr
    assert run.stderr.count("wanted") == 4


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('value="4.0"', 'value="4_0"', "lacks none, and has 16.99.* kg, wanted 20.99"),
        ('link name="wrist_3_link"', 'link name="wrist"', "cannot read it: "),
    ],
)
def test_what_pinocchio_omits_is_an_error(monkeypatch, old, new, message):
    path = example_urdf("ur5_robot.urdf")
    text = path.read_text().replace(old, new)
    monkeypatch.setattr("robotid.robot.tree.Tree.xml", property(lambda self: text))
    with pytest.raises(ModelError, match=message):
        RobotModel.from_urdf(path)


def chain(tmp_path, count, kind="revolute", more=""):
    links = "".join(CHAIN.format(k, k - 1, kind) for k in range(1, count + 1))
    path = tmp_path / "chain.urdf"
    path.write_text(f'<robot name="chain"><link name="l0"/>{links}{more}</robot>')
    return path


def test_trees_that_are_none_or_too_deep_are_refused(tmp_path):
    circle = CHAIN.format("a", "b", "fixed") + CHAIN.format("b", "a", "revolute")
    with pytest.raises(ModelError, match="links la, lb form a closed loop that is not connected"):
        RobotModel.from_urdf(chain(tmp_path, 2, more=circle))
    with pytest.raises(ModelError, match="a chain has more than 500 joints"):
        RobotModel.from_urdf(chain(tmp_path, 20_000, "fixed"))
    with pytest.raises(ModelError, match="400 joints move, wanted at most 300; list"):
        RobotModel.from_urdf(chain(tmp_path, 400))
    assert len(RobotModel.from_urdf(chain(tmp_path, 400), joints=["j1", "j9"]).joints) == 2


@pytest.mark.parametrize("name", ["universe", "root_joint"])
def test_names_that_pinocchio_has_taken_are_refused(tmp_path, name):
    path = chain(tmp_path, 2)
    path.write_text(path.read_text().replace('name="j2"', f'name="{name}"'))
    with pytest.raises(
        ModelError, match=f"a joint is named '{name}', which is reserved by Pinocchio"
    ):
        RobotModel.from_urdf(path, free_flyer=True)


def test_a_pipe_is_no_urdf(tmp_path):
    os.mkfifo(tmp_path / "pipe.urdf")
    (finding,) = inspect_urdf(tmp_path / "pipe.urdf").findings
    assert (finding.code, "is a pipe or a device, wanted a URDF" in finding.message) == (
        "unusable",
        True,
    )


def test_only_files_of_meshes_inside_their_package_are_read(tmp_path):
    urdf = tmp_path / "p" / "urdf" / "r.urdf"
    urdf.parent.mkdir(parents=True)
    (tmp_path / "secret.stl").write_bytes(b"solid")
    os.mkfifo(urdf.parent / "pipe.stl")
    (urdf.parent / "folder.stl").mkdir()
    outside, endless = "package://p/../secret.stl", "package://p/" + "x/" * 3000
    nowhere = ("file:///dev/zero", "/dev/zero", "x" * 300)
    for name in (outside, endless, "pipe.stl", "folder.stl", *nowhere):
        assert find_mesh(name, urdf) is None, name
    for name in ("r.urdf", "passwd"):
        with pytest.raises(ValueError, match=r"is not a mesh, wanted .stl, .dae"):
            read_surfaces(urdf.parent / name)
    with (tmp_path / "huge.stl").open("wb") as stream:
        stream.truncate(2**40)
    with pytest.raises(
        ValueError, match=r"huge.stl cannot be read: the file has more than 256 MiB"
    ):
        read_surfaces(tmp_path / "huge.stl")


def test_motions_that_are_no_numbers_are_refused():
    import numpy as np

    from robotid.dynamics.torque import joint_torque_regressor

    model = RobotModel.from_urdf(example_urdf("ur5_robot.urdf"), free_flyer=True)
    q, v = np.zeros((3, 13)), np.zeros((3, 12))
    with pytest.raises(DataError, match=r"q\[0, 3:7\], the quaternion of the base, has length 0"):
        joint_torque_regressor(model, q, v, v)
    q[:, 6] = 1.0
    for bad, where in (((q, 2, 8), r"q\[2, 8\]"), ((v, 1, 7), r"v\[1\] of shoulder_lift_joint")):
        values, row, column = bad
        values[row, column] = np.nan
        with pytest.raises(DataError, match=f"{where} is nan, wanted"):
            joint_torque_regressor(model, q, v, np.zeros((3, 12)))
        values[row, column] = 0.0
    pi = model.standard_parameters()
    pi[12] = np.inf
    with pytest.raises(DataError, match=r"shoulder_link.mcy is inf kg m, wanted a finite number"):
        model.with_parameters(pi)


ARM = """<robot name="arm">{first}<link name="l1"><inertial><origin xyz="0 0.4 0"/>
<mass value="0.7"/><inertia ixx="0.01" ixy="0" ixz="0" iyy="0.004" iyz="0" izz="0.01"/></inertial>
</link><joint name="{name}" type="{kind}"><origin xyz="{origin}"/><parent link="{parent}"/>
<child link="l1"/><axis xyz="1 0 0"/><limit lower="-1" upper="1" velocity="3" effort="9"/></joint>
<link name="l2"><inertial><origin xyz="0 0.4 0"/><mass value="0.7"/>
<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.004" iyz="0" izz="0.01"/></inertial></link>
<joint name="j" type="revolute"><origin xyz="{origin}"/><parent link="l1"/><child link="l2"/>
<axis xyz="1 0 0"/><limit lower="-1" upper="1" velocity="3" effort="9"/></joint>{last}</robot>"""
USUAL = {
    "first": '<link name="base"/>', "name": "i", "kind": "revolute", "origin": "0 0 0.3",
    "parent": "base", "last": "",
}  # fmt: skip


@pytest.mark.parametrize(
    "odd",
    [
        {"name": "root_joint"},
        {"name": "root_joint", "kind": "fixed"},
        {"first": "", "parent": "world"},
        {"last": '<gazebo reference="l1"><sensor:camera name="c" sensor:rate="3"/></gazebo>'},
        {"origin": "0 \n\t 0  0.3\n"},
    ],
)
def test_what_other_readers_load_is_loaded_with_the_same_dynamics(tmp_path, odd):
    models = []
    for changes in (odd, {k: v for k, v in odd.items() if k == "kind"}):
        path = tmp_path / "arm.urdf"
        path.write_text(ARM.format(**USUAL | changes))
        models.append(RobotModel.from_urdf(path))
        assert not [f for f in inspect_urdf(path).findings if f.severity == "error"]
    odd_one, plain = models
    np.testing.assert_array_equal(odd_one.standard_parameters(), plain.standard_parameters())
    placements = [[p.homogeneous for p in m.pin_model.jointPlacements] for m in models]
    np.testing.assert_array_equal(*placements)


@pytest.mark.parametrize("origin", ["0 0 0", "-0.0005 0 0"])
def test_friction_is_identifiable_at_a_joint_beside_the_origin(tmp_path, origin):
    path = tmp_path / "arm.urdf"
    path.write_text(ARM.format(**USUAL | {"kind": "fixed", "origin": origin}))
    inspection = inspect_urdf(path)
    assert (inspection.structure.base_inertial, inspection.structure.base) == (3, 6)
    assert not [f for f in inspection.findings if f.code == "weak_parameters"]
