"""Families of friction by name: the turns that they need, and their lines in a job."""

import tomllib

import numpy as np

from robotid.robot.drives import (
    FAMILIES,
    Harmonic,
    Spring,
    drive_line,
    has_turned,
    spring_family,
    term_from_dict,
)


def test_a_family_is_advised_a_tenth_beyond_the_turns_that_it_needs():
    needs = {name: family.needs for name, family in FAMILIES.items() if family.needs}
    assert needs == {"harmonics1": 0.1, "harmonics2": 0.5, "harmonics4": 0.5}
    for name, turns in needs.items():
        enough = 1.1 * turns * 2 * np.pi  # [rad]
        assert has_turned(name, enough * (1 + 1e-9))
        assert not has_turned(name, enough * (1 - 1e-9))
    assert has_turned("spring", 0.0)
    for turned, wanted in ((4.0, "harmonics2"), (3.4, "harmonics1"), (0.7, "harmonics1"),
                           (0.68, "spring")):  # fmt: skip
        assert spring_family(turned, "harmonics2", "harmonics1") == wanted


def test_the_line_of_a_drive_is_read_back_as_it_was():
    wave = Harmonic(data_range=(-1.0, 2.0), order=3.0, is_sine=True)
    [(joint, entries)] = tomllib.loads(drive_line("a joint", wave, "load", Spring())).items()
    assert joint == "a joint"
    assert entries[1] == "load"
    assert term_from_dict(entries[0]) == Harmonic(order=3.0, is_sine=True), "the range is the log's"
    assert term_from_dict(entries[2]) == Spring()
