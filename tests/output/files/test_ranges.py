"""Ranges for randomisation: the intervals of what was identified, possible whatever is drawn."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.stats
import yaml
from helpers.commanded_results import written_result
from helpers.mujoco_plant import plant
from helpers.robots import motion
from scipy.spatial.transform import Rotation

import robotid
from robotid.base.exceptions import DataError
from robotid.cli import main
from robotid.data.log import Trajectory
from robotid.dynamics.friction_projection import drive_moments, project_friction
from robotid.estimation.variation.variation import SCORES
from robotid.output.files.entries import build_result
from robotid.output.files.ranges import (
    _projected,
    parameter_ranges,
    projected_ranges,
    ranges_text,
    sample,
    stated_ranges,
)
from robotid.output.files.result_file import load_result
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
            expected = (figure["high"] + figure["low"]) / 2
            assert figure["nominal"] == pytest.approx(expected, rel=1e-3)


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


COUNT = 400


@pytest.fixture(scope="module")
def folder(identified, tmp_path_factory):
    where = tmp_path_factory.mktemp("samples") / "result"
    robotid.save_result(identified, where)
    return where


@pytest.fixture(scope="module")
def drawn(folder):
    return sample(load_result(folder), COUNT, np.random.default_rng(0))


def test_each_sample_is_possible_and_its_sums_are_those_of_the_fit(identified, drawn):
    names, values = drawn
    found, size = identified, identified.model.layout.n_inertial
    assert tuple(names) == found.model.layout.names
    J = pseudo_inertia(values[:, :size].reshape(-1))
    assert np.linalg.eigvalsh(J).min() > 0
    assert (values[:, found.model.layout.is_nonnegative()] >= 0).all()
    bound = found.model.layout.names.index("elbow_joint.viscous")
    assert found.at_bound[bound]
    assert (values[:, bound] == found.standard[bound]).all()


def test_small_samples_have_the_covariance_of_the_fit(identified, folder):
    """So small that all are possible; sums are known better than their parts."""
    result, found = load_result(folder), identified
    stated = result.content["covariance"]
    root = [[0.01 * x for x in row] for row in stated["root"]]
    small = replace(result, content={**result.content, "covariance": {**stated, "root": root}})
    _, values = sample(small, COUNT, np.random.default_rng(0))
    is_free = ~found.at_bound
    K = found.mapping.K[(found.mapping.K[:, found.at_bound] == 0).all(axis=1)]
    C = found.standard_covariance * np.outer(is_free, is_free)
    error = 0.01 * np.sqrt(np.diag(K @ C @ K.T)) * np.median(found.standard_quantile) / 1.96
    z = (values - found.standard) @ K.T / error
    # 400 draws: 3.5 % of a standard deviation, 5 % of the mean
    assert z.std(axis=0) == pytest.approx(np.ones(len(K)), abs=0.15)
    assert np.abs(z.mean(axis=0)).max() < 0.25
    alone = 0.01 * np.sqrt(K**2 @ np.diag(C))
    assert (alone / error).max() > 2  # what independent draws would have


def test_file_has_bodies_as_simulators_read_them(folder, drawn, tmp_path, capsys):
    target = tmp_path / "arm.yaml"
    command = ["export", str(folder), "--format", "ranges", "--out", str(target)]
    assert main([*command, "--samples", "30", "--seed", "7"]) == 0
    text = (tmp_path / "arm.samples.json").read_text()
    assert "arm.samples.json" in capsys.readouterr().out
    content = json.loads(text)
    assert (content["samples"], content["seed"]) == (30, 7)
    names, values = sample(load_result(folder), 30, np.random.default_rng(7))
    result = load_result(folder)
    assert content["parameters"]["names"] == names
    assert content["parameters"]["covariance"] == pytest.approx(np.cov(values.T))
    assert content["parameters"]["mean"] == pytest.approx(values.mean(axis=0))
    assert content["parameters"]["nominal"] == result.parameters.tolist()
    body = result.robot.layout.bodies[1]
    own = content["bodies"][body]
    pi = values[4, 10:20]
    assert own["mass"][4] == pytest.approx(pi[0])
    c = np.array(own["com"][4])
    assert c == pytest.approx(pi[1:4] / pi[0])
    xx, yy, zz, xy, xz, yz = own["inertia"][4]
    about_origin = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) + pi[0] * (
        c @ c * np.eye(3) - np.outer(c, c)
    )
    wanted = dict(zip(("xx", "xy", "yy", "xz", "yz", "zz"), pi[4:], strict=True))
    assert about_origin[0, 1] == pytest.approx(wanted["xy"], rel=1e-9)
    assert about_origin[0, 2] == pytest.approx(wanted["xz"], rel=1e-9)
    assert np.diag(about_origin) == pytest.approx([wanted[a] for a in ("xx", "yy", "zz")])
    drive = content["drives"]["elbow_joint"]["viscous"]
    assert drive == values[:, names.index("elbow_joint.viscous")].tolist()
    assert main([*command, "--samples", "30", "--seed", "7"]) == 0
    assert (tmp_path / "arm.samples.json").read_text() == text


def test_drives_have_the_quantiles_of_the_next_log_and_its_correlation(folder):
    result = load_result(folder)
    names = ["wrist_1_joint.viscous", "wrist_1_joint.coulomb", "elbow_joint.coulomb"]
    spread, R = np.array([2.0, 0.2, 0.1]), np.array([[1, 0.8, 0.0], [0.8, 1, 0], [0, 0, 1.0]])
    centre = {name: result.parameters[result.robot.layout.names.index(name)] for name in names}
    # as if 100 logs had determined the means
    entries = {
        name: {
            "std_error": 0.1 * s,
            "next_interval": [centre[name] - 1.96 * s, centre[name] + 1.96 * s],
            "next_quantiles": (centre[name] + s * SCORES).tolist(),
        }
        for name, s in zip(names, spread, strict=True)
    }  # fmt: skip
    variation = {"parameters": entries, "correlation": R.tolist()}
    varying = replace(result, content={**result.content, "variation": variation})
    every, values = sample(varying, 1000, np.random.default_rng(1))
    x = values[:, [every.index(name) for name in names]]
    assert (x >= 0).all()
    for k, name in enumerate(names):
        truncated = scipy.stats.truncnorm(
            -centre[name] / spread[k], np.inf, centre[name], spread[k]
        )
        assert scipy.stats.kstest(x[:, k], truncated.cdf).pvalue > 1e-3
    found = scipy.stats.spearmanr(x).statistic
    assert found[0, 1] == pytest.approx(6 / np.pi * np.arcsin(0.4), abs=0.08)
    assert abs(found[0, 2]) < 0.12


def test_drives_correlate_as_the_fit_by_its_share_of_the_next_error(folder):
    """A mean of 0.8 of the next log's error: 0.64 of its variance correlates as the fit does."""
    result = load_result(folder)
    names, every = ["wrist_1_joint.viscous", "wrist_1_joint.coulomb"], result.content["covariance"]
    root = [[] for _ in every["names"]]
    first, second = (every["names"].index(name) for name in names)
    root[first] = [*[0.0] * first, 100.0]
    root[second] = [*[0.0] * first, 95.0, *[0.0] * (second - first - 1), 31.2]
    entries = {}
    for name in names:
        mean = result.parameters[result.robot.layout.names.index(name)]
        s = 0.01 * mean
        ends = [mean - 1.96 * s, mean + 1.96 * s]
        entries[name] = {"std_error": 0.8 * s, "next_interval": ends,
                         "next_quantiles": (mean + s * SCORES).tolist()}  # fmt: skip
    variation = {"parameters": entries, "correlation": np.eye(2).tolist()}
    covariance = {"names": every["names"], "root": root}
    content = {**result.content, "covariance": covariance, "variation": variation}
    _, values = sample(replace(result, content=content), 2000, np.random.default_rng(2))
    R = np.corrcoef(values[:, [first, second]].T)
    assert R[0, 1] == pytest.approx(0.64 * 0.95, abs=0.06)


def test_drives_of_commands_have_no_sample_below_zero(tmp_path):
    robot = plant("planar", np.random.default_rng(0))
    size = len(robot.model.standard_parameters())
    of_loops = (n for n in robot.truth if n.endswith((".kp", ".kd", ".delay")))
    names = [*robot.model.layout.names, *of_loops]
    free = {n: x for n, x in robot.truth.items() if n.endswith((".kd", ".delay", ".viscous"))}
    root = np.diag([2.0 * free.get(name, 0.0) for name in names])  # twice their size
    covariance = {"names": names, "root": [row[: k + 1] for k, row in enumerate(root.tolist())]}
    result = load_result(written_result(robot, tmp_path / "r", covariance=covariance))
    delay = next(e for e in result.content["drive_parameters"] if e["name"].endswith(".delay"))
    delay["value"] = -0.002  # of a command that goes on between rows: no simulator has it
    drives = stated_ranges(result.content)["drives"].values()
    assert min(x["delay"]["nominal"] for x in drives if "delay" in x) == 0.0
    every, values = sample(result, COUNT, np.random.default_rng(0))
    assert every == names
    assert len(names) > size
    for name in free:
        drawn = values[:, every.index(name)]
        assert drawn.min() >= 0.0
        assert np.std(drawn) > 0.5 * free[name]
    next(e for e in result.content["drive_parameters"] if e["name"].endswith(".kp"))["value"] = 0.0
    with pytest.raises(DataError, match=r"result.json: no samples .*: kp or limit is 0"):
        sample(result, COUNT, np.random.default_rng(0))


def test_a_gain_that_varies_between_logs_has_no_range_below_zero(tmp_path):
    result = load_result(written_result(plant("planar", np.random.default_rng(0)), tmp_path / "r"))
    gain = next(e for e in result.content["drive_parameters"] if e["name"].endswith(".kp"))
    changed = {
        "drive_parameters": [{**gain, "std_error": 1.0}],
        "variation": {"parameters": {gain["name"]: {"next_interval": [-1.0, 40.0]}}},
    }
    drive = gain["name"].removesuffix(".kp")
    found = stated_ranges({**result.content, **changed})["drives"][drive]["kp"]
    assert (found["low"], found["high"], found["source"]) == (0.0, 40.0, "logs")


@pytest.mark.parametrize(("flags", "words"), [
    (["--samples", "0"], "samples is 0, expected a whole number from 1 to 1000000"),
    (["--samples", "5", "--seed", "-1"], "seed is -1, expected a whole number, 0 or more"),
    (["--seed", "5"], "seed is an option of samples; set their number, samples, too"),
])  # fmt: skip
def test_bad_options_are_named(folder, tmp_path, flags, words, capsys):
    target = tmp_path / "ranges.yaml"
    command = ["export", str(folder), "--format", "ranges", "--out", str(target), *flags]
    assert main(command) != 0
    assert words in capsys.readouterr().err
    assert not target.exists()
    assert not list(tmp_path.iterdir())
