"""What a fit says of its parameters, by figures that are given."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.estimation.fitting.fitted import Fit


def test_a_bound_is_the_source_of_what_it_moved_and_the_data_do_not_show(identified):
    names = np.array(identified.model.layout.names)
    spread, body = identified.prior_std, "forearm_link"
    share = np.full(len(names), 0.5)
    moved = np.zeros(len(names))
    own = np.flatnonzero([name.startswith(f"{body}.") for name in names])
    # 0 data and moved, 1 in part and moved, 2 nothing and moved, 3 in part, 4 nothing, 5 data
    share[own[:6]] = 0.29, 0.31, 0.95, 0.5, 0.95, 0.1
    moved[own[:6]] = 0.4, -0.4, 0.31, 0.29, -0.29, 0.0
    details = {**identified.estimate.details, "active": (f"extent {body}",), "pinned": ()}
    found = replace(
        identified,
        standard=identified.prior + moved * spread,
        errors=replace(identified.errors, unbounded=share * spread),
        estimate=replace(identified.estimate, details=details | {"constraints": False}),
    )
    wanted = np.full(len(names), "mixed", dtype=object)
    wanted[own[:6]] = "data", "bound", "bound", "mixed", "prior", "data"
    assert found.sources == tuple(wanted)
    pinned = details | {"constraints": False, "pinned": (body,)}
    held = replace(found, estimate=replace(found.estimate, details=pinned))
    assert {held.sources[i] for i in own} == {"prior"}


def test_the_quantile_of_a_standard_parameter_is_the_largest_of_its_base_parameters():
    K = np.array([[1.0, 0.0, 2.0, 0.0], [0.0, 0.0, -0.5, 0.0], [0.0, 0.0, 0.0, 3.0]])
    errors = SimpleNamespace(quantile=np.array([2.125, 2.5, 1.97]))
    found = SimpleNamespace(mapping=SimpleNamespace(K=K), errors=errors)
    assert Fit.standard_quantile.fget(found).tolist() == [2.125, 1.96, 2.5, 1.97]


def test_a_stated_mass_is_the_prior_and_a_range_of_masses_is_not(identified):
    names, spread = np.array(identified.model.layout.names), identified.prior_std
    details = {**identified.estimate.details, "active": (), "pinned": (), "constraints": False}
    stated = {"mass": {"forearm_link": 2.5, "upper_arm_link": [1.0, 30.0]}}
    found = replace(
        identified,
        estimator=EstimatorSettings("consistent", constraints=stated),
        standard=identified.prior + 0.4 * spread,
        errors=replace(identified.errors, unbounded=0.5 * spread),
        estimate=replace(identified.estimate, details=details),
    )
    assert {name for name, x in zip(names, found.sources, strict=True) if x != "mixed"} == {
        "forearm_link.m"
    }
    assert found.sources[names.tolist().index("forearm_link.m")] == "prior"


def test_intervals_are_each_value_s_own_quantile_times_its_own_error():
    half = {"base_quantile": np.array([2.0, 3.0]), "base_error": np.array([0.5, 0.25])}
    half |= {"standard_quantile": np.array([4.0, 1.5]), "standard_error": np.array([0.5, np.inf])}
    found = SimpleNamespace(base=np.array([1.0, -2.0]), standard=np.array([7.0, 5.0]), **half)
    found.is_consistent = False
    assert Fit.base_interval.fget(found).tolist() == [[0.0, 2.0], [-2.75, -1.25]]
    assert Fit.standard_interval.fget(found).tolist() == [[5.0, 9.0], [-np.inf, np.inf]]
    layout = SimpleNamespace(names=("a.m", "a.mcx"), is_nonnegative=lambda: np.zeros(2, bool))
    found.is_consistent, found.model = True, SimpleNamespace(layout=layout)
    found.standard_error = np.array([2.0, 4.0])
    assert Fit.standard_interval.fget(found).tolist() == [[0.0, 15.0], [-1.0, 11.0]], "a mass"


def test_wls_is_overfitted_where_it_predicts_every_unseen_log_by_a_fifth_worse(identified):
    def log(is_refitted=False, **errors):
        metrics = {
            name: SimpleNamespace(
                per_joint={joint: SimpleNamespace(rmse=x[k]) for joint, x in errors.items()}
            )
            for k, name in enumerate(("estimate", "wls"))
        }
        return SimpleNamespace(is_refitted=is_refitted, metrics=metrics)

    def overfitted(*logs):
        return replace(identified, validation=logs).overfitted

    first = log(a=(1.0, 1.21), b=(2.0, 2.39), c=(3.0, 9.0))
    second = log(a=(0.5, 0.61), b=(1.0, 9.0), c=(3.0, 3.0))
    assert overfitted(first, second) == {"a"}
    assert overfitted(first) == {"a", "c"}
    seen = log(is_refitted=True, a=(1.0, 1.0), b=(1.0, 2.0), c=(1.0, 1.0))
    assert overfitted(seen, first) == {"a", "c"}
    assert overfitted(seen) == overfitted() == frozenset()
