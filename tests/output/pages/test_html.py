"""Blocks that several pages share: the verdict, figures beside their names, commands to copy."""

import numpy as np

from robotid.output.pages.html import (
    Section,
    asset,
    code,
    command_html,
    number,
    page,
    percent,
    text,
    verdict_html,
    with_error,
)


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
    assert verdict_html("arm", "good", [], "a < b").endswith(
        '<ul></ul><p class="uses">a &lt; b</p></div>\n'
    )


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


def test_a_cell_has_the_style_of_its_content_and_its_number_in_full():
    for cell, wanted in (
        (text("<" * 23), ("&lt;" * 23, "text", None)), (text("a" * 24), ("a" * 24, "", None)),
        (text("a", flag=True), ("a", "flag", None)),
        (code("a.b_c/<"), ("a.<wbr>b_<wbr>c/<wbr>&lt;", "code", None)),
        (number(-12.3456), ("−12.35", "number", -12.3456)), (number(None), ("–", "number", None)),
        (number(np.nan), ("–", "number", None)), (number(2.0, "+.2f"), ("+2.00", "number", 2.0)),
        (percent(1000.4), ("1000", "number", 1000.4)),
        (percent(999.94), ("999.9", "number", 999.94)),
        (percent(0.995), ("1.0", "number", 0.995)), (percent(0.994), ("0.99", "number", 0.994)),
        (percent(-0.5), ("−0.50", "number", -0.5)), (percent(None), ("–", "number", None)),
    ):  # fmt: skip
        assert (cell.html, cell.kind, cell.value) == wanted


def test_a_page_links_to_its_sections_and_runs_the_scripts_that_they_need():
    plain, folds, still = (
        page("<p>", "<h1>h</h1>", sections)
        for sections in (
            {"a": ("A", "text a"), "b": Section("B", "text b")},
            {
                "a": Section("A", "text", "in short", is_open=False),
                "b": Section("B", "x", "", True),
            },
            {"a": ("A", '<table class="data">')},
        )
    )
    assert "<title>&lt;p&gt;</title>" in plain
    assert (
        '<div><a href="#content">&lt;p&gt;</a> <a href="#a">A</a> <a href="#b">B</a> </div>'
        in plain
    )
    assert (
        '<header>\n<h1>h</h1></header>\n<section aria-labelledby="a">\n<h2 id="a">A</h2>\n'
        'text a</section>\n<section aria-labelledby="b">\n<h2 id="b">B</h2>\ntext b</section>\n'
        "</main>" in plain
    )
    assert (
        '<section aria-labelledby="a">\n<details id="a-fold"><summary><h2 id="a">A</h2>'
        "<span>in short</span></summary>\ntext</details>\n</section>\n" in folds
    )
    assert '<details id="b-fold" open><summary><h2 id="b">B</h2></summary>\nx</details>' in folds
    for html, names in ((plain, []), (folds, ["page.js"]), (still, ["page.js", "tables.js"])):
        run = [n for n in ("page.js", "tables.js", "dock.js", "charts.js") if asset(n) in html]
        assert run == names
        assert html.count("sha256-") == len(names)
        assert "frame-src" not in html
        assert asset("tones.css") in html
