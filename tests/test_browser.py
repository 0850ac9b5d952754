"""What only a browser can show. Pages are opened from files; nothing is fetched."""

from browsing import visit


def test_the_browser_draws_in_three_dimensions_and_tells_what_goes_wrong(browser, tmp_path):
    page = tmp_path / "page.html"
    page.write_text(
        "<canvas></canvas><img src='http://127.0.0.1:9/x.png'><script>"
        "console.log(1); document.title = !!document.querySelector('canvas').getContext('webgl');"
        "throw Error('oh')</script>"
    )
    with visit(browser, page) as seen:
        assert seen.page.title() == "true"
        assert seen.requests == ["http://127.0.0.1:9/x.png"]
        assert any("oh" in text for text in seen.errors)
