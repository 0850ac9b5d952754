"""What people watch: the replay in a browser, recorded or live."""

__all__: list[str] = []
