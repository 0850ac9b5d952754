"""What commands print, figure by figure: every value of a made-up content at its place and unit."""

from argparse import Namespace
from functools import partial

import pytest

from robotid.base.findings import Finding
from robotid.cli import (
    compare,
    convert,
    excite,
    export,
    fleet,
    identify,
    inspect,
    paper,
    payload,
    preview,
    simulate,
    track,
    validate,
)


@pytest.fixture
def shown(capsys, monkeypatch):
    """Print by a command's own function; return the lines, of a terminal of 88 columns."""
    monkeypatch.setenv("COLUMNS", "88")

    def lines(show, *content, **options):
        show(*content, **options)
        return capsys.readouterr().out.splitlines()

    return lines


def test_excite(shown):
    collision = {
        "margin": 0.0123, "kept": 0.05, "where": "hand and post", "time": 3.4567,
        "unread": ["a.stl"], "left_alone": ["b", "c"], "built_near": ["d"],
    }  # fmt: skip
    content = {
        "robot": "arm", "joints": ["one", "two"], "duration": 4.5, "seconds": 2.34, "starts": 3,
        "converged": True, "condition_number": 123.4,
        "widest": ["p1", "p2"],
        "limits": {
            "position": {"margin": 0.1234, "where": "two"},
            "velocity": {"margin": -0.02, "where": "one"},
            "collision": collision,
        },
        "payload": {"words": ["a word", "another"]},
    }  # fmt: skip
    assert shown(excite._show, content) == [
        "arm: a motion of 4.5 s for 2 joints, condition number 123 (regressor, columns in units",
        "of the prior); 3 starts in 2.3 s, converged",
        "designed for the parameters with the widest intervals: p1, p2",
        "",
        "smallest margin to each limit",
        "  position            12.3 %  two",
        "  velocity            -2.0 %  one",
        "  collision           12.3 mm above the clearance of 50 mm, hand and post at 3.46 s; not",
        "                       checked, shapes not readable: a.stl; not checked, in contact by",
        "                       design: b, c; smaller clearance, close by design: d",
        "",
        "a word",
        "another",
    ]
    other = content | {"starts": 1, "converged": False, "condition_number": None}
    assert shown(excite._show, other)[:2] == [
        "arm: a motion of 4.5 s for 2 joints, condition number infinite (regressor, columns in",
        "units of the prior); 1 start in 2.3 s, not converged: increase --seconds",
    ]


def test_simulate(shown):
    content = {
        "robot": "arm", "samples": 801, "duration": 4.5, "joints": ["one", "slide"],
        "settings": {"seed": 7, "sensors": {"noise": {"q": 1e-5}}},
        "following": [
            {"joint": "one", "rms": 0.01234, "largest": 0.0456, "range": 0.9, "commanded": 1.0,
             "unit": "rad", "at_limit": 0.123},
            {"joint": "slide", "rms": 2e-4, "largest": 3e-3, "range": 0.1, "commanded": 0.1,
             "unit": "m", "at_limit": 0.0},
        ],
    }  # fmt: skip
    assert shown(simulate._show, content) == [
        "arm: 801 samples over 4.5 s, seed 7",
        "the torques have no noise: errors of parameters from this log are smaller than those",
        "from a recorded log, and than those of a preview, which assumes noise. Add noise with",
        "--torque-noise 0.02, a share of the torque",
        "",
        "position error  rms, largest",
        "one             0.012, 0.046 rad; at the effort limit for 12 % of the time",
        "slide           0.0002, 0.003 m",
    ]
    for kind in ("tau", "torque"):
        noisy = content | {"settings": {"seed": 7, "sensors": {"noise": {kind: 0.02}}}}
        assert shown(simulate._show, noisy)[1:3] == ["", "position error  rms, largest"]


def test_payload(shown):
    found = {
        "link": "tool", "mass": 2.0123, "mass_std_error": 0.0456, "mass_interval": [1.9111, 2.1357],
        "com": [0.01, -0.02, 0.3], "com_std_error": [0.001, 0.02, 0.0035],
        "inertia": [[0.1, 0.2, 0.3], [0.2, 0.4, 0.5], [0.3, 0.5, 0.6]],
        "inertia_std_error": [[0.01, 0.02, 0.03], [0.02, 0.04, 0.05], [0.03, 0.05, 0.06]],
        "inertia_at_link": [[1.1, 1.2, 1.3], [1.2, 1.4, 1.5], [1.3, 1.5, 1.6]],
        "reasons": {},
    }  # fmt: skip
    other = found | {
        "link": "hand", "mass": 3.25, "mass_std_error": 0.0, "com": None, "inertia": None,
        "reasons": {"com": "it hardly turns", "inertia": "it is light"},
    }  # fmt: skip
    content = {
        "payloads": [found, other],
        "relative_error_pct": {"one": 1.234, "two": 12.34},
        "gains": {"one": {"gain": 14.123, "std_error": 0.21, "interval": [13.7, 14.55]}},
    }
    assert shown(payload._show, content) == [
        "payload on tool",
        "  mass 2.012 kg (95 % interval 1.911 to 2.136). It is proportional to the torque scale:",
        "    torque gains that are too large give a mass that is too large",
        "  centre of mass in the frame of tool [m]",
        "    x  0.0100  +- 0.0010",
        "    y  -0.020  +- 0.020",
        "    z  0.3000  +- 0.0035",
        "  inertia about its centre of mass, axes of tool [kg m^2]",
        "    Ixx  0.100  +- 0.010",
        "    Ixy  0.200  +- 0.020",
        "    Ixz  0.300  +- 0.030",
        "    Iyy  0.400  +- 0.040",
        "    Iyz  0.500  +- 0.050",
        "    Izz  0.600  +- 0.060",
        "  inertia about the origin of tool, axes of tool [kg m^2]",
        "    Ixx  1.1",
        "    Ixy  1.2",
        "    Ixz  1.3",
        "    Iyy  1.4",
        "    Iyz  1.5",
        "    Izz  1.6",
        "payload on hand",
        "  mass 3.25 kg, stated",
        "  centre of mass: not determined; it hardly turns",
        "  inertia: not determined; it is light",
        "torque prediction error: one 1.2 %, two 12.3 %",
        "the gains are those with which this payload has the stated mass; verify them with",
        "  another payload or another log of it",
        "",
        "[torque.gains]",
        "one = 14.12  # 95 % interval 13.7 to 14.55",
    ]


def test_preview(shown):
    entry = {
        "name": "a.m", "expression": "a.m + b.m - 0.5 c.mcx", "std_error": 0.0123,
        "plausible": 0.05,
        "unit": "kg", "std_error_before": 0.2, "gain": 4.0, "achieved_std_error": 0.03,
        "ratio": 2.5,
    }  # fmt: skip
    content = {
        "robot": "arm", "estimator": "wls", "structure": {"base": 2},
        "motions": [{"role": "motion", "path": "x/m.csv", "start": 0.5, "end": 7.25}],
        "base_parameters": [entry, entry | {"name": "b.m", "expression": "b.m", "std_error": None}],
        "standard_parameters": [
            {"name": "a.m", "prior": 1.5, "std_error": 0.25, "unit": "kg", "source": "data"},
            {"name": "a.mcx", "prior": 0.1, "std_error": 0.5, "unit": "kg m", "source": "prior"},
        ],
        "drive_parameters": [
            {"name": "one.viscous", "prior": 0.0, "std_error": 2.0, "unit": "N m s/rad",
             "source": "data"},
        ],
        "noise": {
            "one": {"std": 0.25, "unit": "N m", "correlation": 0.1, "is": "assumed"},
            "two": {"std": 0.5, "unit": "N", "correlation": 0.2, "is": "stated"},
        },
        "torque": {
            "one": {"rms": 10.123, "half_width": 0.5678, "of_parameters": 0.1234, "unit": "N m"},
            "two": {"rms": 20.0, "half_width": 1.5, "of_parameters": 0.75, "unit": "N"},
        },
        "words": "so it is",
        "achieved": {"count": 2, "range_80": [0.5, 1.5], "median": 0.9},
    }  # fmt: skip
    assert shown(preview._show, content, is_verbose=False) == [
        "arm: m.csv 0.5-7.25 s; 2 base parameters, by wls",
        "",
        "base parameters: expected standard errors, and their share of the plausible spread",
        "                   +-      left  before  gain  achieved  ratio",
        "  a.m + 2 more  0.012  kg  25 %     0.2     4      0.03    2.5",
        "  b.m               -  kg  open     0.2     4      0.03    2.5",
        "",
        "standard parameters, given the URDF: by 2 data, 1 prior",
        "each standard parameter, and the terms of each base parameter: --verbose",
        "",
        "RMS torque of the motion, half width of the 95 % prediction band, and the part of it",
        "that the uncertainty of the parameters causes",
        "  joint  torque   band   part  noise        over",
        "  one      10.1  0.568  0.123   0.25  N m  0.1 s  assumed",
        "  two        20    1.5   0.75    0.5  N    0.2 s  stated",
        "assumed noise: 1 % of the URDF's effort limit, or of the largest torque of the bodies",
        "  where there is no limit. Standard errors are proportional to the noise. State it with",
        "  --noise JOINT=N_M, or use that of an earlier run with --given RESULT",
        "",
        "so it is",
        "",
        "these logs were identified: of 2 achieved standard errors, 80 % are 0.50 to 1.50 times",
        "the expected ones; median 0.90",
    ]
    assert shown(preview._show, content, is_verbose=True)[12:] == [
        "",
        "RMS torque of the motion, half width of the 95 % prediction band, and the part of it",
        "that the uncertainty of the parameters causes",
        "  joint  torque   band   part  noise        over",
        "  one      10.1  0.568  0.123   0.25  N m  0.1 s  assumed",
        "  two        20    1.5   0.75    0.5  N    0.2 s  stated",
        "assumed noise: 1 % of the URDF's effort limit, or of the largest torque of the bodies",
        "  where there is no limit. Standard errors are proportional to the noise. State it with",
        "  --noise JOINT=N_M, or use that of an earlier run with --given RESULT",
        "",
        "so it is",
        "",
        "these logs were identified: of 2 achieved standard errors, 80 % are 0.50 to 1.50 times",
        "the expected ones; median 0.90",
    ]


METRICS = {
    "one": {
        "relative_error_pct": 1.23, "rmse": 0.4567, "unit": "N m", "better_than_constant": True,
        "urdf_with_drives_relative_error_pct": 5.6, "urdf_relative_error_pct": 34.5,
        "gravity_only_relative_error_pct": 56.7,
    },
    "slide": {
        "relative_error_pct": 101.0, "rmse": 12.0, "unit": "N", "better_than_constant": False,
        "urdf_with_drives_relative_error_pct": None, "urdf_relative_error_pct": 210.0,
        "gravity_only_relative_error_pct": 98.0,
    },
}  # fmt: skip
WORSE = METRICS["slide"] | {"relative_error_pct": 150.0}
LEAST = {"one": {"relative_error_pct": 1.1}, "slide": {"relative_error_pct": 99.0}}
VERDICT = {
    "status": "poor", "reasons": ["slide: worse"], "log_errors": [], "warnings": [],
    "per_joint": {
        "one": {"status": "good", "reasons": []},
        "slide": {"status": "poor", "reasons": ["slide: worse"]},
    },
}  # fmt: skip


def test_identify(shown):
    tried = [
        {"held_out_error_pct": 9.0, "is_selected": True, "families": []},
        {"held_out_error_pct": 7.0, "is_selected": True, "families": ["tanh"]},
        {"held_out_error_pct": 5.0, "is_selected": True, "families": ["tanh", "load"]},
        {"held_out_error_pct": 4.0, "is_selected": False, "families": ["load"]},
    ]
    content = {
        "robot": "arm", "joints": ["one", "slide"],
        "structure": {"base": 12, "base_inertial": 8, "condition": 45.67},
        "scale_check": {"masses": [11.9, 10.234, 0.1]},
        "inputs": [
            {"role": "urdf", "path": "x/arm.urdf"},
            {"role": "identification", "path": "x/fit.csv", "start": 0.5, "end": 9.75},
            {"role": "validation", "path": "x/keep.csv", "start": 1.0, "end": 4.0},
            {"role": "validation", "path": "y/keep.csv", "start": 2.0, "end": 5.0},
        ],
        "identification": {"per_joint": METRICS},
        "validation": [{"per_joint": METRICS}, {"per_joint": {"one": WORSE}}],
        "wls": {
            "identification": {"per_joint": LEAST},
            "validation": [{"per_joint": LEAST}, {"per_joint": {"one": LEAST["slide"]}}],
        },
        "friction": {
            "one": {"families": ["tanh", "load"], "tried": tried},
            "slide": {"families": [], "tried": tried[:1]},
        },
        "warnings": [
            {"code": "slow", "severity": "warning", "where": "one", "message": "one: it is slow"},
            {"code": "dull", "severity": "note", "where": "slide", "message": "slide: it is dull"},
        ],
        "verdict": VERDICT,
    }  # fmt: skip
    assert shown(identify.show_result, content) == [
        "",
        "arm: 2 joints, 12 base parameters (8 inertial), condition number 45.7 (regressor, unit",
        "columns), total mass 11.90 -> 10.23 kg",
        "",
        "fitted: fit.csv 0.5-9.75 s",
        "  joint    error   rmse         URDF +   WLS   URDF  gravity",
        "               %              drives %     %      %   only %",
        "  one        1.2  0.457  N m       5.6   1.1   34.5     56.7",
        "  slide *  101.0   12.0  N           -  99.0  210.0     98.0",
        "  * worse than a constant",
        "",
        "not fitted: x/keep.csv 1-4 s",
        "  joint    error   rmse         URDF +   WLS   URDF  gravity",
        "               %              drives %     %      %   only %",
        "  one        1.2  0.457  N m       5.6   1.1   34.5     56.7",
        "  slide *  101.0   12.0  N           -  99.0  210.0     98.0",
        "  * worse than a constant",
        "",
        "not fitted: y/keep.csv 2-5 s",
        "  joint  error  rmse      WLS   URDF  gravity",
        "             %              %      %   only %",
        "  one *  150.0  12.0  N  99.0  210.0     98.0",
        "  * worse than a constant",
        "",
        "friction besides viscous and Coulomb:",
        "  one: tanh + load (held-out error 9.0 -> 5.0 %)",
        "",
        "warning: slow: one: it is slow",
        "1 finding, 1 cause; worst: one, torque error 150.0 %; 1 note hidden (--verbose)",
        "",
        "verdict: poor",
        "  slide: poor: worse",
        "  one: good",
    ]


def test_validate(shown):
    of_one = {"relative_error_pct": 0.41, "second_order_relative_error_pct": 5.5}
    of_slide = {"relative_error_pct": 20.0, "second_order_relative_error_pct": None}
    rolled = {
        "name": "roll.csv, 1 to 3.5 s",
        "per_joint": {
            "one": {**of_one, "rmse": 0.00123, "unit": "rad", "urdf_relative_error_pct": 6.7,
                    "command_relative_error_pct": 100.5, "better_than_constant": True},
            "slide": {**of_slide, "rmse": 0.0045, "unit": "m", "urdf_relative_error_pct": None,
                      "command_relative_error_pct": 60.0, "better_than_constant": True},
        },
    }  # fmt: skip
    driven = {
        "name": "driven.csv, 0 to 2 s",
        "per_joint": {
            "one": {"relative_error_pct": 50.0, "rmse": 0.5, "unit": "rad",
                    "rows_relative_error_pct": 60.0, "steady_relative_error_pct": 70.0,
                    "better_than_constant": False},
        },
    }  # fmt: skip
    content = {
        "predicted_with": "arm.urdf",
        "validation": [{"name": "keep.csv 1-4 s", "per_joint": METRICS}, rolled, driven],
        "verdict": VERDICT,
    }
    assert shown(validate._show, content) == [
        "predicted with arm.urdf",
        "",
        "keep.csv 1-4 s",
        "  joint    error   rmse         URDF +   URDF  gravity",
        "               %              drives %      %   only %",
        "  one        1.2  0.457  N m       5.6   34.5     56.7",
        "  slide *  101.0   12.0  N           -  210.0     98.0",
        "  * worse than a constant",
        "",
        "roll.csv, 1 to 3.5 s",
        "  joint  error     rmse           2nd  URDF  command",
        "             %                order %     %        %",
        "  one      0.4  0.00123  rad      5.5   6.7    100.5",
        "  slide   20.0  0.00450  m          -     -     60.0",
        "",
        "driven.csv, 0 to 2 s",
        "  joint  error   rmse       torques  constant",
        "             %              alone %   speed %",
        "  one *   50.0  0.500  rad     60.0      70.0",
        "  * worse than a constant",
        "",
        "verdict: poor",
        "  slide: poor: worse",
        "  one: good",
    ]


def test_inspect(shown):
    content = {
        "robot": "arm", "joints": ["one", "two"],
        "structure": {"standard": 20, "base_inertial": 8, "base": 16},
        "base_groups": ["one.Izz + two.m", "two.mcx"],
    }  # fmt: skip
    findings = [
        Finding("light", "warning", "link hand", "hand: 1 g"),
        Finding("bare", "note", "joint two", "two: no limits"),
    ]
    options = partial(Namespace, urdf="my arm.urdf", free_flyer=True)
    show = partial(inspect._show, findings=findings)
    assert shown(show, content, options=options(base=False, verbose=False)) == [
        "arm: 2 joints: one, two",
        "20 standard inertial parameters, 8 base; with drives 16",
        "warning: light: hand: 1 g",
        "1 finding, 1 cause; 1 note hidden (--verbose)",
        "list of base parameters:",
        "  robotid inspect 'my arm.urdf' --free-flyer --base",
    ]
    assert shown(show, content, options=options(base=True, verbose=True)) == [
        "arm: 2 joints: one, two",
        "20 standard inertial parameters, 8 base; with drives 16",
        "warning: light: hand: 1 g",
        "note: bare: two: no limits",
        "2 findings, 2 causes",
        "",
        "base parameters, inertial",
        "  one.Izz + two.m",
        "  two.mcx",
    ]


def test_export_and_convert(shown):
    done = {"files": ["a.xml", "b.yaml"], "not_stated": ["one: no delay"]}
    assert shown(export._show, done) == [
        "written: a.xml, b.yaml",
        "  one: no delay",
    ]
    done = {"path": "o.csv", "samples": 7, "joints": ["a", "b"], "columns": ["q", "tau"],
            "ignored": ["x"], "local": ["sole"]}  # fmt: skip
    assert shown(convert._show, done) == [
        "o.csv: 7 samples of 2 joints",
        "  columns q, tau",
        "  wrenches have the axes of their links: axes = 'link' in [[contact]]",
        "  not written, not of a joint: x",
    ]


def test_paper(shown):
    runs = {"printed": [0.5, 0.25, 0.1, 0.05], "corrected": [0.6, 0.3, 0.2, 0.01]}
    models = {name: {"relative_error": errors, "NA": 10 + k}
              for k, (name, errors) in enumerate(runs.items())}  # fmt: skip
    cases = {
        case: {name: {"relative_error": [1.0, 0.001 * (k + 1)]} for name in models}
        for k, case in enumerate(("disturbed", "noisy", "on_program"))
    }
    found = {"printed": {"converged": 3, "runs": 5}, "corrected": {"converged": 4, "runs": 5}}
    assert shown(paper._show, {"models": models, "trajectories": found, **cases}) == [
        "relative error of the parameters; the last three columns at the last iteration",
        "  model       start   after 1   at end   disturbed  noisy  on program   NA",
        "  printed         0.5     0.25     0.05    0.001    0.002    0.003   10",
        "  corrected       0.6      0.3     0.01    0.001    0.002    0.003   11",
        "",
        "random motions that converged to 1e-3",
        "  printed    3 of 5",
        "  corrected  4 of 5",
    ]


def test_track(shown):
    change = {"onset": 10.014, "flagged": 10.25,
              "payload": {"body": "hand", "mass": 2.013, "std_error": 0.021}}  # fmt: skip
    content = {
        "robot": "arm", "samples": 3000, "delay": 0.047, "converged_at": 4.567, "excitation": 0.876,
        "changes": [change],
        "base_parameters": [
            {"name": "a.m", "value": 1.2345, "std_error": 0.0123, "unit": "kg"},
            {"name": "b.mcx", "value": -0.5, "std_error": 0.25, "unit": "kg m"},
        ],
    }  # fmt: skip
    assert shown(track._show, content) == [
        "arm: 3000 samples, delay of the estimate 47 ms, converged at 4.57 s, excitation 0.88",
        "step change at 10.01 s, detected at 10.25 s; equivalent payload on hand: 2.013 +-",
        "  0.021 kg",
        "  a.m    1.234  +- 0.012  kg",
        "  b.mcx  -0.50  +- 0.25   kg m",
    ]
    assert "not converged" in shown(track._show, content | {"converged_at": None})[0]


def test_compare(shown):
    result = {"label": "r1", "verdict": {"status": "good"}, "estimator": "wls", "path": "x/r.json"}
    other = {"label": "r2", "verdict": {"status": "poor"}, "estimator": "ols", "path": "y/r.json"}
    errors = [{"joint": "one", "relative_error_pct": [1.23, 4.56]},
              {"joint": "two", "relative_error_pct": [None, 78.9]}]  # fmt: skip
    content = {
        "results": [result, other], "notes": ["they differ"], "fitted_alike": False,
        "validation": [{"name": "keep.csv", "start": 1.0, "end": 2.5, "per_joint": errors}],
        "fitted": errors[::-1],
        "base_parameters": [
            {"name": "a.m", "values": [1.2345, 1.3], "std_errors": [0.012, 0.12], "unit": "kg",
             "differences": [0.54]},
            {"name": "b.m", "values": [2.0, None], "std_errors": [0.3, None], "unit": "kg",
             "differences": [None]},
        ],
        "changes": [], "findings": [],
        "settings": [{"name": "signals.cutoff", "values": ["8", None]}],
        "versions": [{"name": "numpy", "values": ["1", "2"]}],
        "inputs": [
            {"path": "a.csv", "role": "validation", "start": 1.0, "end": 2.0, "in": [True, False]},
            {"path": "b.csv", "role": "urdf", "start": None, "end": None, "in": [True, True]},
        ],
    }  # fmt: skip
    assert shown(compare._show, content) == [
        "r1  good    wls        x/r.json",
        "r2  poor    ols        y/r.json",
        "- they differ",
        "",
        "not fitted: keep.csv 1-2.5 s, error %",
        "  joint   r1    r2",
        "  one    1.2   4.6",
        "  two      -  78.9",
        "",
        "fitted recordings of each, error %; other recordings, not comparable",
        "  joint   r1    r2",
        "  two      -  78.9",
        "  one    1.2   4.6",
        "",
        "base parameters to the second digit of their standard errors; last columns: difference",
        "to r1 divided by the combined standard error, in descending order",
        "          r1    r2      r2-r1",
        "  a.m  1.234  1.30  kg    0.5",
        "  b.m   2.00     -  kg      -",
        "settings: signals.cutoff: 8 | -",
        "versions: numpy: 1 | 2",
        "only r1 read a.csv 1-2 s (validation)",
    ]


def test_fleet(shown):
    failures = [
        {"unit": "u1", "log": "", "error": "no URDF"}, {"unit": "u2", "log": "x.csv", "error": "?"},
    ]  # fmt: skip
    unlike = [
        {"unit": f"r{k}", "parameter": "one.coulomb", "value": 1.23456, "std_error": 0.0123,
         "parameter_unit": "N m", "others": [0.51234, 0.98765]} for k in range(13)
    ]  # fmt: skip
    content = {
        "units": 30, "done": 28, "logs": 75, "verdicts": {"good": 20, "poor": 8},
        "failures": failures, "unlike": unlike,
    }  # fmt: skip
    lines = shown(fleet._show, content)
    assert lines[:5] == [
        "28 of 30 units identified (20 good, 8 poor), 75 logs",
        "failed: u1: no URDF",
        "failed: u2: x.csv: ?",
        "differs: r0: one.coulomb is 1.235 +- 0.012 N m; the other units predict 0.512 to 0.988",
        "differs: r1: one.coulomb is 1.235 +- 0.012 N m; the other units predict 0.512 to 0.988",
    ]
    assert len(lines) == 1 + 2 + 10 + 1
    assert lines[-1] == "3 more failures or differences: fleet.html"
    few = content | {"verdicts": {}, "done": 0, "failures": 12 * failures[:1], "unlike": unlike[:2]}
    lines = shown(fleet._show, few)
    assert lines[0] == "0 of 30 units identified, 75 logs"
    assert lines[-1] == "2 more failures or differences: fleet.html"
    assert len(shown(fleet._show, content | {"unlike": unlike[:10]})) == 13
