"""The replay of a log in a browser."""
