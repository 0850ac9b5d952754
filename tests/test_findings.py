import tomllib

from robotid.base.findings import Finding, by_severity, grouped, listed, toml_key


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


def test_logs_with_other_joints_are_named_one_by_one():
    """No sentence on all three joints, because none of the logs has them all."""
    joints = ["j1", "j2", "j3"]

    def rest(log, joint, size):
        message = f"{log}: {joint} at rest (range {size} rad): move it, or lock it"
        return Finding("static_joint", "warning", f"{log}: {joint}", message)

    sizes = {"a.csv": {"j2": 1e-4, "j3": 3e-4}, "b.csv": {"j1": 2e-4, "j3": 5e-4},
             "c.csv": {"j2": 4e-4, "j3": 2e-4}}  # fmt: skip
    findings = [rest(log, *pair) for log, own in sizes.items() for pair in own.items()]
    (cause,) = grouped(findings, joints)
    assert cause.messages == (
        "a.csv, c.csv: j2, j3 at rest (range 0.0001 to 0.0004 rad): move it, or lock it",
        "b.csv: j1, j3 at rest (range 0.0002 to 0.0005 rad): move it, or lock it",
    )
    assert cause.joints == tuple(joints)
    whole = [rest("d.csv", joint, 6e-4) for joint in joints]  # true of d.csv
    (cause,) = grouped([*findings, *whole], joints)
    assert cause.messages == (
        "a.csv, b.csv, c.csv, d.csv: j2, j3, j1 at rest (range 0.0001 to 0.0006 rad): move it, or "
        "lock it",
    )


def late(log, seconds, rows="4"):
    message = (
        f"{log}: {1e3 * seconds:.1f} ms late, held for {rows} rows; set torque_delay = "
        f"{seconds:.4f} (--torque-delay {seconds:.4f})"
    )
    return Finding("late", "warning", log, message)


def test_what_is_typed_keeps_one_value_and_ranges_of_ranges_are_one_range():
    findings = [late("c", 0.0201, "4 to 6"), late("a", 0.0199), late("b", 0.02, "1 to 4")]
    (cause,) = grouped(findings)
    assert cause.messages == (
        "c, a, b: 19.9 to 20.1 ms late, held for 1 to 6 rows; set torque_delay = 0.0200 "
        "(--torque-delay 0.0200)",
    )
    (cause,) = grouped(findings[:2])
    assert "torque_delay = 0.0199 (--torque-delay 0.0199)" in cause.messages[0]


def test_of_decreases_the_smallest_is_stated_as_a_decrease():
    def exchanged(log, before, after):
        message = (
            f"{log}: with these columns exchanged, the share decreases from {before} to {after} %"
        )
        return Finding("torque_order", "error", log, message)

    (cause,) = grouped([exchanged("a", "102", "0.39"), exchanged("b", "87", "0.56")])
    assert cause.messages == (
        "a, b: with these columns exchanged, the share decreases from 87 to 0.56 %",
    )


def cut(log, start, end):
    message = f"{log}: at rest for {start} s; cut it with start = {start} and end = {end}"
    return Finding("standstill", "note", log, message)


def test_settings_that_differ_by_log_are_stated_log_by_log():
    (cause,) = grouped([cut("a", "2.33", "54.03"), cut("b", "4.1", "46.98")])
    assert cause.messages == (
        "a: at rest for 2.33 s; cut it with start = 2.33 and end = 54.03",
        "b: at rest for 4.1 s; cut it with start = 4.1 and end = 46.98",
    )
    (cause,) = grouped([cut("a", "2.33", "54.03"), cut("b", "2.4", "54.1")])
    assert cause.messages == (
        "a, b: at rest for 2.33 to 2.4 s; cut it with start = 2.33 and end = 54.03",
    )


def test_settings_of_several_numbers_are_far_if_any_of_them_is():
    texts = [f"{log}: set mass = [1.0, {high}]" for log, high in (("a", 2.0), ("b", 3.0))]
    findings = [Finding("bounds", "note", text[0], text) for text in texts]
    (cause,) = grouped(findings)
    assert cause.messages == tuple(texts)


def test_what_is_typed_for_several_joints_is_typed_for_each():
    todo = "{0} stands at {1}; state locked = {{ {0} = {1} }} (--lock {0}={1})"
    places = (("a", "j6", 0.1824), ("b", "j6", 0.1825), ("a", "j7", 1.0))
    findings = [
        Finding("locked", "error", f"{log}: {joint}", todo.format(joint, at))
        for log, joint, at in places
    ]
    (cause,) = grouped(findings, ["j6", "j7"])
    assert cause.messages == (
        "j6, j7 stands at 0.1824 to 1.0; state locked = { j6 = 0.1824 }, locked = { j7 = 1.0 } "
        "(--lock j6=0.1824 --lock j7=1.0)",
    )


def test_a_name_is_quoted_as_a_key_where_it_needs_it():
    for name in ("arm_1-x", "a.b", 'say "x"', "", "gel\u00e4nk"):
        assert tomllib.loads(f"{toml_key(name)} = 1") == {name: 1}
    assert toml_key("arm_1-x") == "arm_1-x"


def test_quoted_names_are_quoted_one_by_one():
    findings = [Finding("odd", "note", x, f"link '{x}': {x} weighs 1 kg") for x in ("a b", "c")]
    assert grouped(findings, ["a b", "c"])[0].messages == ("link 'a b', 'c': a b, c weighs 1 kg",)


def test_no_finding_has_no_cause():
    assert grouped([]) == ()
