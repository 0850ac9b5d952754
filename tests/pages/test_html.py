"""Blocks that several pages share: the verdict, figures beside their names, commands to copy."""

from decimal import Decimal

import numpy as np
import pytest

from robotid.pages.html import command_html, facts_html, steps_html, verdict_html, with_error


def test_a_verdict_shows_three_reasons_and_folds_all_others():
    html = verdict_html("<arm>", "not evaluated", ["a & b", "c", "d", "e", "f"])
    assert html == (
        '<div class="verdict not-evaluated"><h1>&lt;arm&gt; '
        "<span>Verdict: <strong>not evaluated</strong></span></h1>"
        "<ul><li>a &amp; b</li><li>c</li><li>d</li></ul>"
        "<details><summary>2 more reasons</summary><ul><li>e</li><li>f</li></ul></details></div>\n"
    )
    assert "<summary>1 more reason</summary>" in verdict_html("arm", "poor", "abcd")
    assert "<details>" not in verdict_html("arm", "good", "abc")


def test_facts_end_with_links_to_the_files():
    html = facts_html({"Mass": "<b>2 kg</b>"}, {"urdf": "a b.urdf", "result": 'r".json'})
    assert html == (
        '<dl class="facts"><div><dt>Mass</dt><dd><b>2 kg</b></dd></div>'
        '<div><dt>Files</dt><dd><a href="a b.urdf">URDF</a>, '
        '<a href="r&quot;.json">result</a></dd></div></dl>\n'
    )
    assert "Files" not in facts_html({"Mass": "2 kg"})


def test_a_step_has_each_of_its_blocks_to_copy():
    html = steps_html([("Try <it>.", ("one", "a & b")), ("Read.", ())])
    assert html == (
        '<h2 id="next">Do next</h2>\n<ol class="next"><li><p>Try &lt;it&gt;.</p>'
        '<div class="copy"><pre class="command">one</pre></div>'
        '<div class="copy"><pre class="command">a &amp; b</pre></div></li>\n'
        "<li><p>Read.</p></li>\n</ol>\n"
    )
    assert steps_html([]) == ""


def test_a_command_breaks_between_arguments_only():
    assert command_html("robotid replay 'my log.csv' --lock a=0 <x>") == (
        '<pre class="command"><span>robotid</span> <span>replay</span> '
        "<span>&#x27;my log.csv&#x27;</span> <span>--lock</span> <span>a=0</span> "
        "<span>&lt;x&gt;</span></pre>"
    )
    assert command_html("[locked]\na = 0") == '<pre class="command">[locked]\na = 0</pre>'


def test_a_small_error_of_a_plain_number_is_written_in_full():
    """Powers of ten are for numbers that are small, too, and for errors of 100,000 and more."""
    for value, error, wanted in (
        (1.5, 1.2e-5, ("1.500000", "0.000012")), (0.00123, 2e-4, ("0.00123", "0.00020")),
        (1.5e-4, 0.0012, ("0.0001", "0.0012")), (2e-4, 3e-4, ("2.0e−04", "3.0e−04")),
        (-1.5e6, 9.94e4, ("−1500000", "99400")), (-1.5e6, 1.2e5, ("−1.50e+06", "1.2e+05")),
    ):  # fmt: skip
        assert tuple(cell.html for cell in with_error(value, error)) == wanted


def test_a_number_ends_at_the_second_digit_of_its_error(rng):
    sizes = zip(rng.uniform(-6, 6, 300), rng.uniform(-7, 5, 300), strict=True)
    for value, error in ((rng.choice([-1, 1]) * 10.0**a, 10.0**b) for a, b in sizes):
        cells = with_error(value, error)
        shown, half = (Decimal(cell.html.replace("−", "-")) for cell in cells)
        assert [cell.value for cell in cells] == [value, error]
        ends, digits = half.as_tuple().exponent, len(half.as_tuple().digits)
        if error < 99.5:
            assert digits == 2 or half == 0
        assert float(half) == pytest.approx(error, rel=0.051)
        assert shown.as_tuple().exponent == ends or abs(value) < error
        assert abs(float(shown) - value) <= 0.5001 * 10.0 ** shown.as_tuple().exponent
    assert [cell.html for cell in with_error(1.234, np.inf)] == ["1.234", "–"]
    assert with_error(0.5, 0.25, sign="+")[0].html == "+0.50"
