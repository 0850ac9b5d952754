import pickle
from dataclasses import replace

import numpy as np
import pytest
from helpers.driven import arm
from helpers.fitting import fit
from helpers.synthetic import exact_log, truth

from robotid.base.exceptions import SettingsError
from robotid.data.signal_settings import SignalSettings
from robotid.estimation.fitting.estimator_settings import (
    ESTIMATORS,
    EstimatorSettings,
    RecursiveSettings,
)

RECURSIVE = [name for name, kind in ESTIMATORS.items() if issubclass(kind, RecursiveSettings)]
EXACT = SignalSettings(cutoff=None, trim=0.0, min_velocity=0.0, velocity="measured")


@pytest.mark.parametrize("name", RECURSIVE)
def test_standard_errors_of_recursive_estimators_are_honest(rng, name):
    model, noise = arm(), np.array([4.0, 2.0, 0.3])
    pi = truth(model)
    log = exact_log(model, pi, rng, samples=2000, noise=noise)
    found = fit(model, [log], signals=EXACT, estimator=name)
    error = np.abs(found.base - found.mapping.to_base(pi)) / found.base_error
    assert np.sqrt(np.mean(error**2)) < 1.3
    assert np.isfinite(found.base_error).all()
    wls = np.sqrt(np.diag(found.wls.covariance))
    assert (found.base_error < 30 * wls).all()


@pytest.mark.parametrize("name", RECURSIVE)
def test_a_recursive_estimate_is_made_physical_on_request(model, rng, name):
    log = exact_log(model, truth(model), rng, noise=20 * np.array([4.0, 2.0, 0.3]))
    free = fit(model, [log], signals=EXACT, estimator=name)
    assert not free.is_consistent
    settings = EstimatorSettings(name, physical=True)
    found = fit(model, [log], signals=EXACT, estimator=settings)
    assert found.is_consistent
    assert "projected onto physically consistent" in found.estimate.message


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"name": "rls", "walk": 0.1}, "'rls' has no setting 'walk'; it has forgetting, "),
        ({"name": "ols", "margin": 1.0}, "'ols' has no setting 'margin'; it has none"),
        ({"name": "rls", "forgetting": 1.1}, "forgetting is 1.1, expected 0 < x <= 1"),
        ({"name": "kalman", "walk": -1.0}, "walk is -1.0, expected x >= 0"),
        ({"name": "kalman", "gate": True}, "gate is True, expected 0.5 <= x < 1, or false"),
        ({"name": "consistent", "prior_weight": "x"}, "finite number or one of auto, cv, evidence"),
    ],
)
def test_a_setting_that_does_not_fit_is_refused(options, text):
    with pytest.raises(SettingsError, match=text):
        EstimatorSettings(**options)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_settings_of_each_estimator_survive_a_round_trip(name):
    settings = EstimatorSettings(name)
    assert type(settings) is ESTIMATORS[name]
    assert EstimatorSettings(**settings.to_dict()) == settings
    assert replace(settings) == settings
    assert pickle.loads(pickle.dumps(settings)) == settings
