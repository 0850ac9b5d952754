"""Samples of a written result: possible robots with the covariance of the fit and the logs."""

import json
from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
from helpers.commanded_results import written_result
from helpers.mujoco_plant import plant

import robotid
from robotid.cli import main
from robotid.estimation.variation.variation import SCORES
from robotid.output.files.ranges import sample
from robotid.output.files.result_file import load_result
from robotid.robot.parameters import pseudo_inertia

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
    names = [*robot.model.layout.names, *(n for n in robot.truth if n.endswith((".kd", ".delay")))]
    free = {n: x for n, x in robot.truth.items() if n.endswith((".kd", ".delay", ".viscous"))}
    root = np.diag([2.0 * free.get(name, 0.0) for name in names])  # twice their size
    covariance = {"names": names, "root": [row[: k + 1] for k, row in enumerate(root.tolist())]}
    every, values = sample(
        load_result(written_result(robot, tmp_path / "r", covariance=covariance)),
        COUNT, np.random.default_rng(0),
    )  # fmt: skip
    assert every == names
    assert len(names) > size
    for name in free:
        drawn = values[:, every.index(name)]
        assert drawn.min() >= 0.0
        assert np.std(drawn) > 0.5 * free[name]


@pytest.mark.parametrize(("flags", "words"), [
    (["--samples", "0"], "samples is 0, wanted a whole number from 1 to 1000000"),
    (["--samples", "5", "--seed", "-1"], "seed is -1, wanted a whole number, 0 or more"),
    (["--seed", "5"], "seed is an option of samples; state their number, samples, too"),
])  # fmt: skip
def test_bad_options_are_named(folder, tmp_path, flags, words, capsys):
    target = tmp_path / "ranges.yaml"
    command = ["export", str(folder), "--format", "ranges", "--out", str(target), *flags]
    assert main(command) != 0
    assert words in capsys.readouterr().err
    assert not target.exists()
    assert not list(tmp_path.iterdir())
