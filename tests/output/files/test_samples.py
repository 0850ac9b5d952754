"""Samples of a written result: possible robots with the covariance of the fit and the logs."""

import json
from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
from helpers.commanded_results import written_result
from helpers.mujoco_plant import plant

import robotid
from robotid.base.exceptions import DataError
from robotid.cli import main
from robotid.estimation.variation.variation import SCORES
from robotid.output.files.result_file import load_result
from robotid.output.files.samples import (
    _between,
    _positive_definite,
    _quantile,
    sample,
    write_samples,
)
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


def test_results_of_earlier_versions_have_no_covariance(folder):
    result = load_result(folder)
    content = {key: value for key, value in result.content.items() if key != "covariance"}
    with pytest.raises(DataError, match="of an earlier version has no covariance; identify"):
        sample(replace(result, content=content), 3, np.random.default_rng(0))


def test_samples_of_gains_are_positive_and_vary_with_the_logs(tmp_path):
    leg = plant("leg", np.random.default_rng(0), delay=0.004)
    result = load_result(written_result(leg, tmp_path / "out"))
    names, first = list(result.robot.layout.names), leg.drives[0]
    own = [f"{first.joint}.delay", f"{first.joint}.kp", f"{leg.drives[1].joint}.kp"]
    root = [[]] * len(names) + [[0.004], [0.0, 0.5], [0.0, 0.3, 0.4]]
    spread = 0.8 * first.kp
    variation = {
        "parameters": {
            own[1]: {
                "std_error": 0.1 * spread,
                "next_interval": [first.kp - 1.96 * spread, first.kp + 1.96 * spread],
                "next_quantiles": (first.kp + spread * SCORES).tolist(),
            }
        },
        "correlation": [[1.0]],
    }
    stated = {"covariance": {"names": [*names, *own], "root": root}, "variation": variation}
    every, values = sample(
        replace(result, content={**result.content, **stated}), 1500, np.random.default_rng(2)
    )
    assert every == [*names, *own]
    assert (values[:, : len(names)] == result.parameters).all()
    delay, kp, other = values[:, len(names) :].T
    half = scipy.stats.truncnorm(-1.0, np.inf, 0.004, 0.004)
    assert scipy.stats.kstest(delay, half.cdf).pvalue > 1e-3
    wide = scipy.stats.truncnorm(-1 / 0.8, np.inf, first.kp, spread)
    assert scipy.stats.kstest(kp, wide.cdf).pvalue > 1e-3
    assert other.std() == pytest.approx(0.5, rel=0.1)
    # of the error of the mean, a tenth of the deviation, the other gain knows 0.6
    assert np.corrcoef(kp, other)[0, 1] == pytest.approx(0.06, abs=0.08)
    plain = replace(result, content={**result.content, "covariance": stated["covariance"]})
    write_samples(plain, tmp_path / "x.json", 20, 1)
    content = json.loads((tmp_path / "x.json").read_text())
    assert content["parameters"]["units"][-3:] == ["s", "N m/rad", "N m/rad"]
    assert len(content["drives"][first.joint]["kp"]) == 20


@pytest.mark.parametrize(("std_error", "of_gain"), [(0.8, 0.5), (0.3, 0.3)])
def test_a_gain_of_the_next_log_has_the_part_of_the_fit_in_its_error(tmp_path, std_error, of_gain):
    """Its deviation is 1 % of it, its error in the fit half of that, with r = 0.6 to another."""
    leg = plant("leg", np.random.default_rng(0))
    result = load_result(written_result(leg, tmp_path / "out"))
    names, first = list(result.robot.layout.names), leg.drives[0]
    own, size = [f"{drive.joint}.kp" for drive in leg.drives[:2]], 0.01 * first.kp
    entry = {
        "std_error": std_error * size,
        "next_interval": [first.kp - 1.96 * size, first.kp + 1.96 * size],
        "next_quantiles": (first.kp + size * SCORES).tolist(),
    }
    root = [[]] * len(names) + [[0.5 * size], [0.3 * size, 0.4 * size]]
    stated = {
        "covariance": {"names": [*names, *own], "root": root},
        "variation": {"parameters": {own[0]: entry}, "correlation": [[1.0]]},
    }
    varying = replace(result, content={**result.content, **stated})
    _, values = sample(varying, 800, np.random.default_rng(3))
    kp, other = values[:, -2:].T
    assert kp.std() == pytest.approx(size, rel=0.1)
    assert np.corrcoef(kp, other)[0, 1] == pytest.approx(0.6 * of_gain, abs=0.08)


def test_positive_definite_matrices_have_positive_eigenvalues(rng):
    A = rng.standard_normal((400, 4, 4))
    J = A @ A.mT - rng.uniform(0.0, 1.0, 400)[:, None, None] * np.eye(4)
    wanted = np.linalg.eigvalsh(J)[:, 0] > 0.0
    assert 50 < wanted.sum() < 350
    np.testing.assert_array_equal(_positive_definite(J), wanted)
    assert _positive_definite(np.diag([1.0, 2.0, 3.0, 0.0])[None]).tolist() == [False]


def test_parameters_at_a_bound_have_no_quantiles_of_the_next_log():
    """A place is that in the stated variation; an interval is 1.96 errors wide on each side."""
    entries = [{"name": "a.kp"}, {"name": "b.kp", "at_bound": True}, {"name": "c.kd"}]
    low = np.array([1.0, 2.0, 3.0])
    parameters = {
        entry["name"]: {
            "next_interval": [x, x + 0.98], "std_error": x / 10, "next_quantiles": [x, x + 0.5]
        }
        for entry, x in zip(entries, low, strict=True)
    }  # fmt: skip
    found = _between({"drive_parameters": entries, "variation": {"parameters": parameters}})
    assert list(found) == ["a.kp", "c.kd"]
    for name, place, x in (("a.kp", 0, 1.0), ("c.kd", 2, 3.0)):
        assert found[name]["at"] == place
        assert found[name]["errors"] == pytest.approx((x / 10, 0.25), rel=1e-4)
        np.testing.assert_array_equal(found[name]["quantiles"], [x, x + 0.5])
    assert _between({"drive_parameters": entries}) == {}


def test_the_typical_quantile_is_the_median_of_those_of_uncertain_parameters():
    standard = [{"quantile": 2.0, "std_error": 1.0}, {"quantile": 9.0, "std_error": 0.0}, {}]
    drives = [{"quantile": 3.0, "std_error": 0.1}, {"quantile": None, "std_error": 0.1},
              {"quantile": 2.5, "std_error": 0.2}]  # fmt: skip
    content = {"standard_parameters": standard, "drive_parameters": drives}
    assert _quantile(content) == 2.5
    content["drive_parameters"] = content["standard_parameters"] = standard[1:]
    assert _quantile(content) == pytest.approx(1.96, abs=1e-3)
