"""Loops fitted to commands and logs that are wrong: figures as stored, and beside what is true."""

import re

import numpy as np
import pytest
from helpers.figure_runs import LOOP, LOOP_DRIVES, LOOP_STEP


@pytest.mark.parametrize("name", ["commands", "faults"])
def test_all_figures_are_those_that_are_stored(same, name):
    same(name)


def test_loops_have_the_drives_of_the_robot(ran):
    found = {e["name"]: e for e in ran("commands")[1]["result"]["drive_parameters"]}
    z = []
    for joint, drive in LOOP_DRIVES.items():
        for key in ("armature", "viscous", "coulomb", "offset"):
            entry = found[f"{joint}.{key}"]
            z.append((entry["value"] - getattr(drive, key)) / entry["std_error"])
        delay = found[f"{joint}.delay"]
        z.append((delay["value"] - (LOOP.delay - LOOP_STEP / 2)) / delay["std_error"])
        assert found[f"{joint}.kp"]["value"] == LOOP.kp[joint]
    assert np.abs(z).max() < 6
    assert np.sqrt(np.mean(np.square(z))) < 3


def test_what_was_done_to_a_log_is_what_the_doctor_says(ran):
    documents = ran("faults")[0].documents

    def codes(name):
        return {(f["code"], f["severity"]) for f in documents[name]["findings"]}

    assert ("torque_delay", "warning") in codes("late")
    late = [f for f in documents["late"]["findings"] if f["code"] == "torque_delay"]
    for finding in late:  # by 40 ms, of which 12 are stated
        size, error = re.search(
            r"torque lags the position by ([\d.]+) \+- ([\d.]+) ms", finding["message"]
        ).groups()
        assert abs(float(size) - 28) < 3 * float(error)
    assert ("torque_order", "error") in codes("swapped")
    assert ("torque_sign", "error") in codes("turned")
    assert ("velocity_scale", "error") in codes("scaled")
    assert {"gap", "clipped", "spikes", "quantised"} <= {code for code, _ in codes("spoilt")}
