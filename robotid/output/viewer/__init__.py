"""The replay in a browser, of a log or live."""

__all__: list[str] = []
