"""Results of an identification from commands and positions, made of known drives."""

import json

import numpy as np

from robotid.data.log import Trajectory
from robotid.dynamics.friction_projection import drive_moments
from robotid.output.files.urdf import write_urdf
from robotid.robot.drives import PositionCoulomb

_UNITS = {
    "kp": "N m/rad", "kd": "N m s/rad", "delay": "s", "zero": "rad", "armature": "kg m^2",
    "viscous": "N m s/rad",
}  # fmt: skip
_STATED = ("kp", "kd")  # by the job


def by_position(slope, curve, low, high):
    """Return terms and parameters of Coulomb friction that depends on the position."""
    terms = [
        PositionCoulomb(data_range=(low, high), order=k, centre=0.5 * (low + high)) for k in (1, 2)
    ]
    return terms, (slope, curve)


def drive_entries(plant, relative=0.1):
    """Return the drive parameters as result.json has them; gains were stated, not found."""
    return [
        {
            "name": name,
            "value": value,
            "std_error": None if name.endswith(_STATED) else relative * abs(value) + 1e-6,
            "unit": _UNITS.get(name.rpartition(".")[2], "N m"),
        }
        for name, value in plant.truth.items()
    ]


def _moments(model, pi):
    """Return the moments of friction over positions from the lowest to the highest seen."""
    count = 2001
    q, way = np.zeros((count, len(model.joints))), (np.arange(count) + 0.5) / count
    for j, joint in enumerate(model.joints):
        for term in model.layout.own.get(joint, ())[:1]:
            q[:, j] = term.data_range[0] + way * (term.data_range[1] - term.data_range[0])
    still, first = np.zeros_like(q), np.zeros(count, dtype=int)
    runs = [
        Trajectory(np.arange(count) / 100.0, q, still + v, still, still, model.joints, None, first)
        for v in (-1.0, -0.5, 0.5, 1.0)
    ]
    rows = np.ones(q.shape, dtype=bool)
    found = drive_moments(model.with_reference(pi), [(run, rows) for run in runs])
    return {name: moments.to_dict() for name, moments in found.items()}


def written_result(plant, folder, *, position=None, limits=None, **changes):
    """Write the result of a plant whose drives were found exactly; return its folder."""
    # Position: by joint, as of ``by_position``; limits: of effort; changes: other keys of the
    # result.
    position = position or {}
    model = plant.model.with_terms({joint: terms for joint, (terms, _) in position.items()})
    values = dict(zip(model.layout.names, model.standard_parameters(), strict=True))
    values |= {name: x for name, x in plant.truth.items() if name in values}
    entries = drive_entries(plant)
    for joint, (terms, parameters) in position.items():
        for term, x in zip(terms, parameters, strict=True):
            name = f"{joint}.{term.name}"
            values[name] = x
            entries.append({"name": name, "value": x, "std_error": 0.1 * abs(x), "unit": "N m"})
    folder.mkdir(exist_ok=True)
    sidecar = write_urdf(model, np.array([*values.values()]), folder / "robot.urdf")
    recording = {"path": "log.csv", "sha256": None, "start": 0.0, "end": 1.0, "rows_used": 100}
    content = {
        "schema_version": 1,
        "robotid": "0",
        "robot": model.name,
        "joints": list(model.joints),
        "settings": {"estimator": {"name": "simulation"}},
        "inputs": [
            {"role": "urdf", "path": model.tree.path, "sha256": None},
            {"role": "identification", "signals": {}, **recording},
        ],
        "outputs": {"urdf": "robot.urdf", "sidecar": sidecar.name},
        "structure": {"base": 0, "undetermined": []},
        "consistency": {"is_consistent": True},
        "base_parameters": [],
        "standard_parameters": [],
        "drive_parameters": entries,
        "drive_moments": _moments(model, np.array([*values.values()])),
        "identification": {"per_joint": {}},
        "validation": [],
        "verdict": {"status": "good", "reasons": ["it follows"]},
        "simulation": {"controller": {"kind": "pd", "effort_limit": limits}},
    }
    (folder / "result.json").write_text(json.dumps(content | changes))
    return folder
