"""Renamed keys of result.json and codes of findings are accepted under their former names."""

import json
import logging

import pytest

from robotid.exceptions import SettingsError
from robotid.export.entries import build_result
from robotid.export.former_keys import FORMER, from_former_keys, with_former_keys
from robotid.export.result import load_result
from robotid.findings import FORMER_CODES, Finding, current_code, not_ignored
from robotid.judgement.verdict import blocking, check_ignored
from robotid.robot.families import term_from_dict

CONTENT = {
    "scale_check": {"factor": 1.25},
    "structure": {"rank": 3, "indistinguishable": [{"names": ["a", "b"]}]},
    "uncertainty": {"segments": 48},
    "inputs": [{"role": "urdf"}, {"role": "identification", "segments": 3}],
    "verdict": {"log_errors": ["clipped"], "warnings": [{"code": "x"}]},
    "friction": {
        "seen": {"data_range": {"v": [0.1, 2.0]}, "tried": [{"p_value": 0.5, "is_selected": False}]}
    },
    "own_terms": {"one": [{"term": "Cubic", "data_range": [0.0, 1.5]}, {"term": "Lag"}]},
    "validation": [{"band": {"reach": {"coverage_pct": 94.0}}}],
    "standard_parameters": [{"name": "l.mass", "quantile": 2.25}],
    "drive_parameters": [{"name": "one.kp", "quantile": None}],
    "warnings": [{"code": "beyond_range"}],
}


def old(content):
    """The same with former names alone."""
    text = json.dumps(content)
    for path, former in FORMER.items():
        if path not in ("verdict.warnings",):
            text = text.replace(f'"{path.rpartition(".")[2]}":', f'"{former}":')
    text = text.replace('"warnings": [{"code": "x"}]', '"doubts": [{"code": "x"}]')
    return json.loads(text.replace("beyond_range", "beyond_seen"))


def test_each_renamed_key_is_written_under_both_names_and_nothing_else_changes():
    both = with_former_keys(CONTENT)
    assert both["witness"] == both["scale_check"] == {"factor": 1.25}
    assert both["structure"]["not_told_apart"] == [{"names": ["a", "b"]}]
    assert both["uncertainty"] == {"segments": 48, "stretches": 48}
    assert both["inputs"][0] == {"role": "urdf"}
    assert both["inputs"][1] == {"role": "identification", "segments": 3, "stretches": 3}
    assert both["verdict"]["alarms"] == ["clipped"]
    assert both["verdict"]["doubts"] == [{"code": "x"}]
    joint = both["friction"]["seen"]  # a joint of that name stays
    assert joint["seen"] == joint["data_range"] == {"v": [0.1, 2.0]}
    assert joint["tried"] == [
        {"p_value": 0.5, "chance": 0.5, "is_selected": False, "is_taken": False}
    ]
    assert both["own_terms"]["one"][0]["seen"] == [0.0, 1.5]
    assert both["own_terms"]["one"][1] == {"term": "Lag"}
    assert both["validation"] == [{"band": {"reach": {"coverage_pct": 94.0, "held_pct": 94.0}}}]
    assert both["standard_parameters"] == [{"name": "l.mass", "quantile": 2.25, "reach": 2.25}]
    assert both["drive_parameters"][0]["reach"] is None
    assert "witness" not in CONTENT
    assert "stretches" not in CONTENT["uncertainty"]


@pytest.mark.parametrize("read", [old, with_former_keys, lambda content: content])
def test_former_names_both_names_and_current_names_are_read_alike(read):
    assert from_former_keys(read(CONTENT)) == CONTENT


def test_a_result_of_before_is_loaded(identified, tmp_path):
    content = build_result(identified, {"estimator": identified.estimator.to_dict()})
    former = json.loads(json.dumps(content))
    former.pop("scale_check")  # "witness" stands beside it
    former["verdict"].pop("log_errors")
    (tmp_path / "result.json").write_text(json.dumps(former))
    loaded = load_result(tmp_path).content
    assert loaded["scale_check"] == content["scale_check"]
    assert loaded["verdict"]["log_errors"] == content["verdict"]["log_errors"] == []
    assert "witness" not in loaded


def test_former_codes_can_be_ignored_and_are_named(caplog):
    late = Finding("delayed_command", "error", "log", "the command is delayed")
    with caplog.at_level(logging.WARNING, logger="robotid"):
        check_ignored(["late_command", "gravity"])
    assert caplog.messages == [
        "doctor: ignore has the code 'late_command', which is named 'delayed_command' since 0.2"
    ]
    assert blocking([late], ["late_command"]) == blocking([late], ["delayed_command"]) == ()
    assert blocking([late], ["gravity"]) == (late,)
    other = Finding("clipped", "warning", "log", "clipped")
    assert not_ignored([late, other], ["gravity", "late_command"]) == (other,)
    assert not_ignored([late, other], ["clipped", "delayed_command"]) == ()
    assert not_ignored([late, other], []) == (late, other)
    with pytest.raises(SettingsError, match=r"has the code 'nothing', which is unknown or changes"):
        check_ignored(["nothing"])


def test_no_code_is_both_former_and_current():
    assert not set(FORMER_CODES) & set(FORMER_CODES.values())
    assert current_code("held_torque") == "repeated_torque"
    assert current_code("clipped") == "clipped"


def test_the_former_field_of_a_drive_term_is_read():
    term = term_from_dict({"term": "Cubic", "seen": [0.25, 1.5]})
    assert term.data_range == (0.25, 1.5)
