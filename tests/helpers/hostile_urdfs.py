"""Hostile URDFs of every kind, and what is done with each: a traceback is a failure."""

import contextlib
import json
import os
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from hypothesis import strategies as st

from robotid.base.exceptions import RobotIdError
from robotid.diagnosis.urdf.inspection import inspect_urdf
from robotid.dynamics.base_parameters import structural_mapping
from robotid.output.files.urdf import write_urdf
from robotid.output.viewer.replays import robot_scene
from robotid.robot.bodies import body_boxes
from robotid.robot.mass_matrix import check_mass_matrix
from robotid.robot.model import RobotModel

LONGEST = 20_000  # characters of a message: longer ones are no words
ANY = st.characters(exclude_categories=["Cs"])  # known at once, unlike those of a codec


@dataclass(frozen=True)
class HostileUrdf:
    """A URDF, the files beside it, and how a model is asked of it."""

    content: bytes
    beside: dict[str, bytes | str] = field(default_factory=dict)  # bytes, "folder" or "pipe"
    options: dict[str, object] = field(default_factory=dict)


def run_urdf(case: HostileUrdf, folder: Path) -> None:
    """Do with a URDF all that robotid does without a log; raise what is not in its own words."""
    path = write_urdf_files(case, folder)
    for free_flyer in (False, True):
        found = json.dumps(inspect_urdf(path, free_flyer=free_flyer).to_dict(), allow_nan=False)
        assert len(found) < 50 * LONGEST
    with contextlib.suppress(RobotIdError):
        model = described(RobotModel.from_urdf, path, **case.options)
        described(structural_mapping, model)
        pi = model.standard_parameters()
        assert np.isfinite(pi).all()
        described(body_boxes, model)
        described(check_mass_matrix, model, pi, poses=10)
        described(robot_scene, model)
        described(write_urdf, model, pi, folder / "new.urdf", dynamics=True)


def write_urdf_files(case: HostileUrdf, folder: Path) -> Path:
    """Write a URDF and the files that it names; return its path."""
    path = folder / "robot.urdf"
    path.write_bytes(case.content)
    beside = {name: x for name, x in FILES.items() if name.encode() in case.content} | case.beside
    for name, content in beside.items():
        if content == "pipe":
            os.mkfifo(folder / name)
        elif content == "folder":
            (folder / name).mkdir()
        else:
            (folder / name).write_bytes(content)
    return path


def described(function, *arguments, **options):
    """Return what a function returns; its errors are short."""
    try:
        return function(*arguments, **options)
    except RobotIdError as error:
        if len(str(error)) > LONGEST:
            raise AssertionError("an error of pages") from error
        raise


# --- numbers and names ---------------------------------------------------------------------------

BAD_NUMBERS = (
    "", " ", "nan", "NaN", "inf", "-inf", "Infinity", "1e400", "-1e400", "1e308",
    "1.7976931348623157e308", "-1e300", "1e-400", "5e-324", "1_0", "0x10", "0x1p3", "1,5", "1.5.5",
    "--1", "+-1", "1e", "1e+", "e5", ".", "-", "1d3", "1f", "１２", "٣", "½", "1\u00a0", "1 ", " 1",
    "1\t", "1\n", "1 2", "1;2", "${mass}", "None", "true", "1e9", "1.1e9", "-0", "9" * 400,
    "0." + "0" * 400 + "1", "1" * 5000, "1" + "_1" * 50, "3.1416", "1.57", "-1.5708",
    "3.14159265358979",
)  # fmt: skip
number_texts = (
    st.sampled_from(BAD_NUMBERS)
    | st.floats(allow_nan=True, allow_infinity=True).map(repr)
    | st.floats(-1e9, 1e9).map(repr)
    | st.text(ANY, max_size=6).filter(lambda text: text.isprintable())
)
BAD_NAMES = (
    "", " ", "universe", "root_joint", "world", "a.b", "a b", "m", "base.fx", "link_1.m", "../x",
    "\u202e", "x\ny", "<x>", "&", '"', "'", "-", "%s", "{0}", "nan", "x" * 300, "x" * 5000, "é",
    "日本", "🤖",
)  # fmt: skip
MESHES = (
    "", ".", "..", "/", "/dev/zero", "/dev/null", "/proc/self/mem", "/etc/passwd", "folder.stl",
    "pipe.stl", "empty.stl", "garbage.stl", "counts.stl", "nan.stl", "far.stl", "flat.stl",
    "good.stl", "broken.dae", "deep.dae", "broken.obj", "index.obj", "materials.obj", "counts.ply",
    "broken.ply", "broken.glb", "broken.gltf", "broken.off", "bomb.zip", "package://",
    "package://x", "package://../../etc/passwd", "package://dev/zero", "package://x/folder.stl",
    "package://x/pipe.stl", "package://x/../robot.urdf", "file://", "file:///dev/zero",
    "file://pipe.stl", "http://127.0.0.1/x", "model://good.stl", "robot.urdf", "good.stl/x",
    "x" * 300 + ".stl", "x/" * 2000, "~/x.stl", "$HOME/x.stl", "%00.stl", "good.STL", "C:\\x.stl",
    "\\\\host\\x.stl",
)  # fmt: skip


def stl(*corners, count=None):
    """Return a binary STL of triangles, each three corners."""
    body = b"".join(np.array([0, 0, 1, *np.ravel(c)], "<f4").tobytes() + b"\0\0" for c in corners)
    return b"\0" * 80 + np.array([len(corners) if count is None else count], "<u4").tobytes() + body


CUBE = [[[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 0, 0], [0, 1, 0], [0, 0, 1]]]
FILES: dict[str, bytes | str] = {
    "folder.stl": "folder",
    "pipe.stl": "pipe",
    "empty.stl": b"",
    "garbage.stl": b"\xff\0solid" * 40,
    "counts.stl": stl(*CUBE, count=4_000_000_000),
    "nan.stl": stl([[0, 0, np.nan], [1, 0, 0], [0, 1, 0]]),
    "far.stl": stl([[3e38, 0, 0], [1, 0, 0], [0, 1, 3e38]]),
    "flat.stl": stl([[0, 0, 0], [0, 0, 0], [0, 0, 0]]),
    "good.stl": stl(*CUBE),
    "broken.dae": b"<COLLADA><library_geometries/>",
    "deep.dae": b"<COLLADA>" + b"<a>" * 5000 + b"</a>" * 5000 + b"</COLLADA>",
    "broken.obj": b"v 1 2\nf 1 2 3\nf 9 9 9\n",
    "index.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99999999\n",
    "materials.obj": b"mtllib /dev/zero\nmtllib pipe.stl\nusemtl x\n"
    b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
    "counts.ply": b"ply\nformat binary_little_endian 1.0\nelement vertex 1000000000000\n"
    b"property float x\nproperty float y\nproperty float z\nelement face 1\n"
    b"property list uchar int vertex_indices\nend_header\n",
    "broken.ply": b"ply\nformat ascii 1.0\nelement vertex x\nend_header\n1 2 3\n",
    "broken.glb": b"glTF\2\0\0\0\xff\xff\xff\xff",
    "broken.gltf": b'{"asset": {"version": "2.0"}, "buffers": '
    b'[{"uri": "/dev/zero", "byteLength": 1e18}]}',
    "broken.off": b"OFF\n3 1 0\n0 0 0\n",
    "bomb.zip": b"PK\3\4" + b"\0" * 60,
}

# --- whole robots --------------------------------------------------------------------------------

SHAPES = (
    ("box", {"size": "0.1 0.2 0.3"}), ("sphere", {"radius": "0.1"}), ("box", {}), ("capsule", {}),
    ("cylinder", {"radius": "0.1", "length": "1"}),
    ("mesh", {"filename": "good.stl", "scale": "1 1 1"}),
)  # fmt: skip


NUMBERS = (
    "xyz", "rpy", "value", "ixx", "ixy", "ixz", "iyy", "iyz", "izz", "lower", "upper", "velocity",
    "effort", "damping", "friction", "multiplier", "offset", "size", "radius", "length", "scale",
    "rgba",
)  # fmt: skip
VECTORS = ("xyz", "rpy", "size", "scale", "rgba")


def any_of(words):
    """Return a strategy of the words of a text."""
    return st.sampled_from(words.split())


@st.composite
def robots(draw) -> ET.Element:
    """Draw a robot that most readers accept: up to five links, shapes, limits, mimic."""
    robot = ET.Element("robot", name="r")
    count = draw(st.integers(1, 5))
    for k in range(count):
        link = ET.SubElement(robot, "link", name=f"link_{k}")
        if draw(st.integers(0, 3)):
            inertial = ET.SubElement(link, "inertial")
            ET.SubElement(inertial, "origin", xyz="0.1 0 0.02", rpy="0 0.3 0")
            mass = draw(st.sampled_from(["1", "2.5", "0", "1e-9", "1e-15"]))
            ET.SubElement(inertial, "mass", value=mass)
            moments = dict(ixx="0.1", iyy="0.1", izz="0.12")
            ET.SubElement(inertial, "inertia", moments, ixy="0", ixz="0", iyz="0")
        for tag in draw(st.lists(st.sampled_from(["visual", "collision"]), max_size=2)):
            geometry = ET.SubElement(ET.SubElement(link, tag), "geometry")
            ET.SubElement(geometry, *draw(st.sampled_from(SHAPES)))
        if k:
            kind = draw(st.sampled_from(["revolute", "continuous", "prismatic", "fixed"]))
            joint = ET.SubElement(robot, "joint", name=f"joint_{k}", type=kind)
            ET.SubElement(joint, "parent", link=f"link_{draw(st.integers(0, k - 1))}")
            ET.SubElement(joint, "child", link=f"link_{k}")
            ET.SubElement(joint, "origin", xyz="0.5 0 0.1", rpy="0 1.5708 0")
            ET.SubElement(joint, "axis", xyz=draw(st.sampled_from(["0 0 1", "1 0 0", "1 2 3"])))
            ET.SubElement(joint, "limit", lower="-1", upper="1", velocity="2", effort="9")
            ET.SubElement(joint, "dynamics", damping="0.1", friction="0.2")
            if draw(st.integers(0, 4)) == 0:
                ET.SubElement(joint, "mimic", joint="joint_1", multiplier="2", offset="0.1")
    return robot


def spoil_number(draw, robot):
    """Replace one number, or one of a vector, or how many there are."""
    places = [(e, key) for e in robot.iter() for key in e.attrib if key in NUMBERS]
    if not places:
        return
    element, key = draw(st.sampled_from(places))
    if key in VECTORS:
        words = element.get(key, "").split()
        words[draw(st.integers(0, len(words) - 1))] = draw(number_texts)
        words = words[: draw(st.sampled_from([9, 9, 9, 2]))]
        words += draw(st.sampled_from([[], [], ["1"]]))
        element.set(key, draw(st.sampled_from([" ", " ", "  ", "\t", ","])).join(words))
    else:
        element.set(key, draw(number_texts))


def spoil_name(draw, robot):
    """Rename a link or joint everywhere, or in one place."""
    new = draw(
        st.sampled_from(BAD_NAMES) | st.sampled_from(["link_0", "link_1", "joint_1", "base"])
    )
    keys = ("name", "link", "joint", "type")
    places = [(e, key) for e in robot.iter() for key in keys if key in e.attrib]
    element, key = draw(st.sampled_from(places))
    old = element.get(key)
    for e, k in places if draw(st.booleans()) else [(element, key)]:
        if e.get(k) == old:
            e.set(k, new)


def spoil_tree(draw, robot):
    """Drop, double or move an element, or remove an attribute."""
    parents = [(parent, child) for parent in robot.iter() for child in parent]
    parent, child = draw(st.sampled_from(parents))
    match draw(st.sampled_from(["drop", "double", "move", "attribute", "nest", "extra"])):
        case "drop":
            parent.remove(child)
        case "double":
            parent.append(child)
        case "move":
            other = draw(st.sampled_from([e for e in robot.iter() if e not in list(child.iter())]))
            parent.remove(child)
            other.append(child)
        case "attribute":
            for key in draw(st.lists(st.sampled_from([*child.attrib, "quat_xyzw"]), max_size=2)):
                child.attrib.pop(key, None)
        case "nest":
            for _ in range(draw(st.sampled_from([20, 1000]))):
                child = ET.SubElement(child, child.tag)
        case "extra":
            tags = any_of("gazebo transmission mesh origin safety_controller mimic limit")
            about = {"quat_xyzw": "0 0 0 1", "joint": "joint_1"}
            ET.SubElement(child, draw(tags), about)


def spoil_mesh(draw, robot):
    """Let a shape be a mesh with a hostile path."""
    shapes = list(robot.iter("geometry"))
    if not shapes:
        link = robot.find("link")
        if link is None:
            return
        shapes = [ET.SubElement(ET.SubElement(link, "collision"), "geometry")]
    geometry = draw(st.sampled_from(shapes))
    geometry.clear()
    ET.SubElement(geometry, "mesh", filename=draw(st.sampled_from(MESHES)))


def spoil_bytes(draw, content):
    """Cut, overwrite or re-encode the bytes of a file."""
    match draw(any_of("cut overwrite utf-16 latin-1 head entities comment empty")):
        case "cut":
            return content[: draw(st.integers(0, len(content)))]
        case "overwrite":
            at = draw(st.integers(0, len(content) - 1))
            new = draw(st.binary(min_size=1, max_size=8))
            return content[:at] + new + content[at + len(new) :]
        case "utf-16":
            return content.decode().encode("utf-16")
        case "latin-1":
            return b'<?xml version="1.0" encoding="latin-1"?>' + content
        case "head":
            encoding = draw(st.sampled_from(["klingon", "utf-7", "utf-32", "idna", "base64", ""]))
            return f'<?xml version="1.0" encoding="{encoding}"?>'.encode() + content
        case "entities":
            inner = "".join(f'<!ENTITY a{k} "{f"&a{k - 1};" * 10}">' for k in range(1, 12))
            return f'<!DOCTYPE robot [<!ENTITY a0 "x">{inner}]><robot name="&a11;"/>'.encode()
        case "comment":
            content = content.replace(b"<link", b"<!-- x --><link")
            return content.replace(b"<joint", b"<?x y?><joint")
    return b""


options = st.fixed_dictionaries({}, optional={
    "free_flyer": st.booleans(),
    "mimic": any_of("independent coupled"),
    "snap_angles": st.booleans(),
    "locked": st.dictionaries(
        any_of("joint_1 joint_2 joint_9"),
        st.floats() | st.sampled_from([0.0, 1e308, "x", None, True]), max_size=2,
    ),
    "gravity": st.lists(st.floats(), min_size=2, max_size=4)
    | st.sampled_from([None, "x", (0, 0, 1e308), 9.81]),
    "joints": st.lists(any_of("joint_1 joint_2 joint_3 x"), max_size=3),
})  # fmt: skip


@st.composite
def urdf_inputs(draw) -> HostileUrdf:
    """Draw a robot with one to three faults, and how a model is asked of it."""
    robot = draw(robots())
    faults = [spoil_number, spoil_number, spoil_name, spoil_tree, spoil_mesh]
    for fault in draw(st.lists(st.sampled_from(faults), max_size=3)):
        if len(robot):
            fault(draw, robot)
    content = ET.tostring(robot)
    if draw(st.integers(0, 9)) == 0:
        content = spoil_bytes(draw, content)
    return HostileUrdf(content, options=draw(options))
