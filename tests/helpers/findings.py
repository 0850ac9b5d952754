"""Findings in tests: the figures that a test names."""


class Figures:
    """The figures of a finding; only those of the other side are compared."""

    def __init__(self, found):
        self.values = found.evidence

    def __eq__(self, wanted):
        names = getattr(wanted, "expected", wanted)
        return {name: self.values[name] for name in names} == wanted

    __hash__ = None
