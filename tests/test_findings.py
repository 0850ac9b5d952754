from robotid.findings import Finding, by_severity, grouped, listed


def test_names_stand_in_a_sentence_and_a_long_list_is_cut():
    assert listed([]) == "none"
    assert listed(["a", "b"]) == "a, b"
    assert listed("abcdef", 2) == "a, b and 4 more"
    assert listed("ab", 2) == "a, b"


def test_errors_come_first_and_the_order_of_each_kind_is_kept():
    kinds = ["note", "error", "warning", "error", "note"]
    found = [Finding(str(k), kind, "x", "y") for k, kind in enumerate(kinds)]
    assert [f.code for f in by_severity(found)] == ["1", "3", "2", "0", "4"]


def quantised(log, joint, share, severity="warning"):
    message = f"{log}: {share} % of {joint}'s torque is one step of 0.02"
    return Finding("quantised", severity, f"{log}: tau_{joint}", message)


def test_findings_of_one_code_are_one_cause_and_say_what_they_share_once():
    findings = [
        quantised("b.csv", "arm_7", "9.5"),
        quantised("a.csv", "arm_1", "37"),
        quantised("a.csv", "arm_7", "12", "error"),
        Finding("bent", "warning", "arm_1.coulomb", "arm_1: bent in 2 places"),
        Finding("bent", "warning", "arm_1.viscous", "arm_1: bent throughout"),
        Finding("old", "note", "urdf", "the URDF is of 2020"),
    ]
    quantised_, bent, old = grouped(findings, ["arm_1", "arm_7", "arm_70"])
    assert (quantised_.code, quantised_.severity) == ("quantised", "error")
    assert quantised_.joints == ("arm_1", "arm_7")  # in the order of the robot
    assert quantised_.findings == (findings[2], findings[0], findings[1])
    said = "a.csv, b.csv: 9.5 to 37 % of arm_7, arm_1's torque is one step of 0.02"
    assert quantised_.messages == (said,)
    assert bent.messages == ("arm_1: bent in 2 places", "arm_1: bent throughout")
    assert (bent.severity, bent.joints) == ("warning", ("arm_1",))
    assert (old.severity, old.joints, old.messages) == ("note", (), ("the URDF is of 2020",))


def test_quoted_names_are_quoted_one_by_one():
    findings = [Finding("odd", "note", x, f"link '{x}': {x} weighs 1 kg") for x in ("a b", "c")]
    assert grouped(findings, ["a b", "c"])[0].messages == ("link 'a b', 'c': a b, c weighs 1 kg",)


def test_no_finding_has_no_cause():
    assert grouped([]) == ()
