"""The replay in a browser, of a log or live."""
