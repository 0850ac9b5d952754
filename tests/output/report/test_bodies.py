"""The picture of the parameters of all links: figures, places, sources."""

import re
from html import unescape
from types import SimpleNamespace

import numpy as np
import pytest

from robotid.diagnosis.verdict.central import CENTRAL_TERMS, central_parameters
from robotid.output.report.body_table import parameter_picture
from robotid.robot.bodies import central_inertial

UNITS = dict(zip(CENTRAL_TERMS, ["kg", *["m"] * 3, *["kg m²"] * 6], strict=True))


@pytest.fixture(scope="module")
def central(identified):
    return central_parameters(identified)


@pytest.fixture(scope="module")
def picture(identified):
    return parameter_picture(identified)


def test_values_are_those_about_the_centre_of_mass(identified, central):
    for i in (1, 4):
        for pi, row in ((identified.prior, central.urdf), (identified.standard, central.values)):
            m, c, _, (xx, xy, xz, yy, yz, zz) = (lambda x: (x.mass, x.com, x.rpy, x.inertia))(
                central_inertial(pi[10 * i : 10 * i + 10])
            )
            np.testing.assert_allclose(row[i], [m, *c, xx, yy, zz, xy, xz, yz], atol=1e-12)


@pytest.mark.parametrize("i", [1, 5])
def test_intervals_contain_those_of_sampled_parameters(identified, central, i):
    own = slice(10 * i, 10 * i + 10)
    pi, C = identified.standard[own], 1e-8 * identified.standard_covariance[own, own]
    rng = np.random.default_rng(0)
    drawn = rng.multivariate_normal(pi, C, 4000, method="eigh")
    m, c = drawn[:, 0], drawn[:, 1:4] / drawn[:, :1]
    yy = drawn[:, 6] - m * (c[:, 0] ** 2 + c[:, 2] ** 2)
    xz = drawn[:, 7] + m * c[:, 0] * c[:, 2]
    quantile = identified.standard_quantile[own].max()
    wanted = quantile * np.column_stack([m, c, yy, xz]).std(axis=0) * 1e4
    np.testing.assert_allclose(central.half[i][[0, 1, 2, 3, 5, 8]], wanted, rtol=0.05)


def test_a_body_with_a_parameter_of_unknown_error_has_no_intervals(identified, central):
    names = "model standard prior standard_quantile standard_covariance prior_std sources"
    own = {name: getattr(identified, name) for name in names.split()}
    error, free = identified.standard_error.copy(), np.array(identified.errors.unbounded)
    error[23] = np.inf
    found = central_parameters(
        SimpleNamespace(**own, standard_error=error, errors=SimpleNamespace(unbounded=free))
    )
    assert np.isposinf(found.half[2]).all()
    others = np.arange(6) != 2
    np.testing.assert_array_equal(found.half[others], central.half[others])


def test_sources_are_those_of_the_parameters(identified, central):
    named = np.array(identified.sources[: central.sources.size]).reshape(central.sources.shape)
    assert central.sources[:, 0].tolist() == named[:, 0].tolist()
    is_kept = (named == "prior").all(axis=1)
    assert set(central.sources[is_kept].ravel()) <= {"prior"}
    assert {"data", "mixed", "prior"} == set(central.sources.ravel())


def test_sources_follow_from_the_errors_over_the_priors_spreads(identified, central):
    pi, spread, quantile = (
        x[:60].reshape(6, 10)
        for x in (identified.standard, identified.prior_std, identified.standard_quantile)
    )
    m, c = pi[:, 0], pi[:, 2] / pi[:, 0]
    prior = np.hypot(spread[:, 2], c * spread[:, 0]) / m  # of cy = mcy / m
    share = central.half[:, 2] / quantile.max(axis=1) / prior
    stayed = np.abs(c - central.urdf[:, 2]) <= 0.3 * prior
    wanted = np.where(share < 0.3, "data", np.where((share > 0.9) & stayed, "prior", "mixed"))
    assert len(set(wanted)) > 1
    assert central.sources[:, 2].tolist() == wanted.tolist()


@pytest.mark.parametrize("body", ["forearm_link", "wrist_2_link"])
@pytest.mark.parametrize("term", ["m", "cy", "Ixx", "Ixz"])
def test_the_figures_of_each_mark_are_those_of_the_result(identified, central, picture, body, term):
    i, k = identified.model.layout.bodies.index(body), CENTRAL_TERMS.index(term)
    words, unit, source = re.search(
        rf"<title>{body} {term}: (.*?) (k?g? ?m?²?), (.*?)</title>", unescape(picture)
    ).groups()
    found = [float(x.replace("−", "-")) for x in re.split(" → | ± ", words)]
    wanted = [central.urdf[i, k], central.values[i, k], central.half[i, k]]
    np.testing.assert_allclose(found, wanted, rtol=0.0, atol=0.051 * wanted[2])  # two digits
    assert unit == UNITS[term]
    assert (
        source
        == {"data": "data", "mixed": "data and prior", "prior": "prior"}[central.sources[i, k]]
    )


def test_marks_lie_on_one_axis_per_group(central, picture):
    assert re.findall(r'<svg height="(\d+)"', picture) == 10 * ["132"]
    rows = re.search(r'aria-label="m of each link">(.*?)</svg>', picture)[1]
    heights = re.findall(r'cy="(\d+)" r="3.5"', rows)
    assert heights == ["11", "33", "55", "77", "99", "121"]
    column = re.search(r'aria-label="m of each link">(.*?)</svg>', picture)[1]
    places = [float(x) for x in re.findall(r'<circle cx="([\d.]+)%"', column)]
    slope, zero = np.polyfit(central.values[:, 0], places, 1)
    np.testing.assert_allclose(places, slope * central.values[:, 0] + zero, atol=0.1)
    tick = re.search(r'class="tick" x1="([\d.]+)%"', column)[1]
    assert float(tick) == pytest.approx(zero, abs=0.11)  # of rounded places
    column = re.search(r'aria-label="Iyy of each link">(.*?)</svg>', picture)[1]
    places = [float(x) for x in re.findall(r'<circle cx="([\d.]+)%"', column)]
    slope, zero = np.polyfit(np.sqrt(central.values[:, 5]), places, 1)
    np.testing.assert_allclose(places, slope * np.sqrt(central.values[:, 5]) + zero, atol=0.1)


def test_many_links_are_folded(identified, monkeypatch):
    monkeypatch.setattr("robotid.output.report.body_table._LINKS", 5)
    assert '<details id="inertials"><summary>Parameters of 6 links' in parameter_picture(identified)


def test_intervals_and_values_of_the_urdf_are_on_the_axis_of_their_group(central, picture):
    for term, scaled in (("m", lambda x: x), ("Iyy", lambda x: np.sign(x) * np.sqrt(np.abs(x)))):
        k = CENTRAL_TERMS.index(term)
        column = re.search(rf'aria-label="{term} of each link">(.*?)</svg>', picture)[1]
        places = [float(x) for x in re.findall(r'<circle cx="([-\d.]+)%"', column)]
        slope, zero = np.polyfit(scaled(central.values[:, k]), places, 1)

        def at(x, scaled=scaled, slope=slope, zero=zero):
            return np.clip(slope * scaled(x) + zero, -5.0, 105.0)

        marks = re.findall(r"<g class=.*?</g>", column)
        for mark, urdf, value, half in zip(
            marks, central.urdf[:, k], central.values[:, k], central.half[:, k], strict=True
        ):
            (was,) = re.findall(r'<circle class="urdf" cx="([-\d.]+)%"', mark)
            assert float(was) == pytest.approx(at(urdf), abs=0.15)
            if np.isfinite(half):
                ends = re.search(r'class="half" x1="([-\d.]+)%" x2="([-\d.]+)%"', mark).groups()
                wanted = [at(value - half), at(value + half)]
                assert [float(x) for x in ends] == pytest.approx(wanted, abs=0.3)


@pytest.mark.parametrize(("term", "columns"), [("m", [0]), ("cy", [1, 2, 3]), ("Ixz", [7, 8, 9])])
def test_the_numbers_below_an_axis_are_zero_and_a_round_one_at_their_places(
    central, picture, term, columns
):
    def scaled(x):
        return np.sign(x) * np.sqrt(np.abs(x)) if term[0] == "I" else np.asarray(x)

    every = np.concatenate(
        [[0.0], *(x[:, columns].ravel() for x in (central.urdf, central.values))]
    )
    low, high = scaled(every).min(), scaled(every).max()
    low, high = low - 0.06 * (high - low), high + 0.06 * (high - low)  # the ends of the axis
    end = max(low, high, key=abs)
    end = np.sign(end) * end**2 if term[0] == "I" else end
    _, drawn = picture.split(f'aria-label="{term} of each link">')
    lines = [float(x) for x in re.findall(r'class="tick" x1="([\d.]+)%"', drawn.split("</svg>")[0])]
    spans = re.findall(r'<span style="(left|right): (\d+)%">(.*?)</span>', drawn.split("</div>")[0])
    said = [float(words.replace("−", "-")) for _, _, words in spans]
    digit = 10.0 ** np.floor(np.log10(abs(end)))
    assert said == [0.0, pytest.approx(np.sign(end) * np.floor(abs(end) / digit) * digit)]
    at = [100 * (scaled(x) - low) / (high - low) for x in said]
    assert lines == pytest.approx(at, abs=0.06)
    assert [side for side, _, _ in spans] == ["left" if x < 85.0 else "right" for x in at]
    places = [float(x) if side == "left" else 100 - float(x) for side, x, _ in spans]
    assert places == pytest.approx(at, abs=0.51)
