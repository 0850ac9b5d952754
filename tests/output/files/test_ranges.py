"""Ranges for randomisation: the intervals of what was identified, possible whatever is drawn."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from helpers.robots import motion
from scipy.spatial.transform import Rotation

from robotid.data.log import Trajectory
from robotid.dynamics.friction_projection import drive_moments, project_friction
from robotid.output.files.entries import build_result
from robotid.output.files.ranges import (
    _projected,
    parameter_ranges,
    projected_ranges,
    ranges_text,
)
from robotid.robot.drives import Stribeck
from robotid.robot.parameters import pseudo_inertia

AXES = ("x", "y", "z")


@pytest.fixture(scope="module")
def ranges(identified):
    return parameter_ranges(identified)


def figures(content):
    """Yield every figure with its keys."""
    for group in ("bodies", "drives"):
        for owner, entries in content[group].items():
            for key, entry in entries.items():
                if key == "principal_axes":
                    continue
                for inner, figure in ({"": entry} if "source" in entry else entry).items():
                    yield (owner, key, inner), figure


def test_nominal_values_are_those_identified(identified, ranges):
    J = pseudo_inertia(identified.standard[: identified.model.layout.n_inertial])
    for body, J_i in zip(identified.model.layout.bodies, J, strict=True):
        found = ranges["bodies"][body]
        m = found["mass"]["nominal"]
        c = np.array([found["com"][axis]["nominal"] for axis in AXES])
        w, x, y, z = found["principal_axes"]
        R = Rotation.from_quat([x, y, z, w]).as_matrix()
        second = [found["second_moments"][axis]["nominal"] for axis in AXES]
        again = np.zeros((4, 4))
        again[:3, :3] = R @ np.diag(second) @ R.T + m * np.outer(c, c)
        again[:3, 3] = again[3, :3] = m * c
        again[3, 3] = m
        np.testing.assert_allclose(again, J_i, atol=1e-12 * abs(J_i).max())
        moments = [found["principal_moments"][f"I{axis}{axis}"]["nominal"] for axis in AXES]
        np.testing.assert_allclose(moments, np.sum(second) - second)
    values = dict(zip(identified.model.layout.names, identified.standard, strict=True))
    for drive, terms in ranges["drives"].items():
        for term, figure in terms.items():
            assert figure["nominal"] == values.pop(f"{drive}.{term}")
    assert len(values) == identified.model.layout.n_inertial


def test_widths_are_those_of_draws_from_the_covariance(identified):
    """Small ones: the ranges are to first order."""
    small = replace(identified, standard_covariance=1e-6 * identified.standard_covariance)
    content, body = parameter_ranges(small), identified.model.layout.bodies[1]
    found = content["bodies"][body]
    rng, part = np.random.default_rng(0), slice(10, 20)
    w, V = np.linalg.eigh(small.standard_covariance[part, part])
    draws = rng.standard_normal((20_000, 10)) @ (V * np.sqrt(w.clip(0))).T
    J = pseudo_inertia((identified.standard[part] + draws).reshape(-1)).reshape(-1, 4, 4)
    c = J[:, :3, 3] / J[:, 3:, 3]
    about = J[:, :3, :3] - J[:, 3, 3, None, None] * c[:, :, None] * c[:, None, :]
    w, x, y, z = found["principal_axes"]
    R = Rotation.from_quat([x, y, z, w]).as_matrix()
    second = np.einsum("ak,nab,bk->nk", R, about, R)
    drawn, reach = {"mass": {"": J[:, 3, 3]}}, identified.standard_quantile[part].max()
    assert reach > 1.98  # few segments: Student's quantile
    drawn["com"] = dict(zip(AXES, c.T, strict=True))
    drawn["second_moments"] = dict(zip(AXES, second.T, strict=True))
    sums = second.sum(axis=1, keepdims=True) - second
    drawn["principal_moments"] = {f"I{a}{a}": x for a, x in zip(AXES, sums.T, strict=True)}
    for key, parts in drawn.items():
        for inner, values in parts.items():
            figure = found[key][inner] if inner else found[key]
            width = figure["high"] - figure["low"]
            assert width == pytest.approx(2 * reach * values.std(), rel=0.04), (key, inner)
            assert figure["nominal"] == pytest.approx(
                (figure["high"] + figure["low"]) / 2, rel=1e-3
            )


def test_what_is_drawn_is_possible_however_wide_the_intervals(identified):
    wide = replace(identified, standard_covariance=25.0 * identified.standard_covariance)
    for (_, key, _), figure in figures(parameter_ranges(wide)):
        if key in ("mass", "second_moments", "principal_moments"):
            assert 0 < figure["low"] < figure["nominal"] < figure["high"]
        elif key in ("armature", "viscous", "coulomb") and "low" in figure:
            assert 0 <= figure["low"] <= figure["nominal"] <= figure["high"]


def test_yaml_and_result_have_the_same_figures(identified, ranges):
    read = yaml.safe_load(ranges_text(ranges))
    assert read.keys() == ranges.keys()
    wanted = dict(figures(ranges))
    for at, figure in figures(read):
        exact = wanted.pop(at)
        assert figure.keys() == exact.keys()
        for key, value in figure.items():  # 1e-05 would be text
            is_text = isinstance(exact[key], str)
            assert value == (exact[key] if is_text else pytest.approx(exact[key], rel=1e-5, abs=0))
    assert not wanted
    assert build_result(identified, {"estimator": {"name": "consistent"}})["ranges"] == ranges


def test_projected_friction_is_as_wide_as_draws_of_what_it_replaces(ur5):
    """Of terms whose intervals reach differently far, the farthest."""
    elbow, rng = "elbow_joint", np.random.default_rng(3)
    model = ur5.with_terms({elbow: (Stribeck(data_range=(0.05, 2.0), speed=0.3),)})
    names, pi = list(model.layout.names), model.standard_parameters()
    own = [names.index(f"{elbow}.{term}") for term in ("viscous", "coulomb", "stribeck", "offset")]
    pi[own] = 3.0, 9.0, 2.0, 0.4
    m = motion(model, rng, 400)
    still = np.zeros_like(m.q)
    log = Trajectory(
        np.arange(400) / 100.0, m.q, m.v, m.a, still, m.joints, None, np.zeros(400, dtype=int)
    )
    moments = drive_moments(model.with_reference(pi), [(log, np.ones(m.q.shape, dtype=bool))])
    A, covariance = 0.1 * rng.standard_normal((4, 4)), np.zeros((len(pi), len(pi)))
    covariance[np.ix_(own, own)] = A @ A.T
    reach = np.full(len(pi), 5.0)  # of other drives
    reach[own] = 2.0, 2.1, 2.6, 2.2
    found = SimpleNamespace(
        model=model, standard=pi, moments=moments, standard_covariance=covariance,
        standard_quantile=reach,
    )  # fmt: skip
    ranges = projected_ranges(found)["projected_drives"][elbow]
    simple = ("viscous", "coulomb", "offset")
    drawn, values = [], np.tile(pi, (500, 1))
    values[:, own] += rng.standard_normal((500, 4)) @ A.T
    values[:100, own[-1]] -= 0.8  # an offset may be negative
    for x in values:
        [drive] = project_friction(model, x, moments, simple).drives
        drawn.append([drive.values[term] for term in simple])
    sampled = _projected(SimpleNamespace(identified=(model, pi), drive_moments=moments), values)
    for term, column in zip(simple, np.transpose(drawn), strict=True):
        np.testing.assert_allclose(sampled[elbow][term], column, rtol=1e-9)
    for term, values in zip(simple, np.transpose(drawn[100:]), strict=True):
        width = ranges[term]["high"] - ranges[term]["low"]
        # 400 draws determine a standard deviation to 4 %
        assert width == pytest.approx(2 * 2.6 * values.std(), rel=0.1), term
    covariance *= 1e4  # wider than the values: an offset may be negative, friction may not
    ranges = projected_ranges(found)["projected_drives"][elbow]
    assert (ranges["viscous"]["low"], ranges["coulomb"]["low"]) == (0.0, 0.0)
    assert ranges["offset"]["low"] < -1.0
