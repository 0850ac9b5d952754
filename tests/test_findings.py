from robotid.findings import Finding, by_severity, listed


def test_names_stand_in_a_sentence_and_a_long_list_is_cut():
    assert listed([]) == "none"
    assert listed(["a", "b"]) == "a, b"
    assert listed("abcdef", 2) == "a, b and 4 more"
    assert listed("ab", 2) == "a, b"


def test_errors_come_first_and_the_order_of_each_kind_is_kept():
    kinds = ["note", "error", "warning", "error", "note"]
    found = [Finding(str(k), kind, "x", "y") for k, kind in enumerate(kinds)]
    assert [f.code for f in by_severity(found)] == ["1", "3", "2", "0", "4"]
