"""``identify`` and ``fit`` for tests: neither doctor nor choice of friction is asked."""

from robotid.cli.identify import identify as identify_all
from robotid.data.signal_settings import SignalSettings
from robotid.dynamics.base_parameters import structural_mapping
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.estimation.fitting.fit import fit_recordings
from robotid.estimation.fitting.recorded import Recordings, hold_log

PLAIN = {"doctor": False, "friction": "viscous+coulomb"}  # what tests of fits do not read


def identify(model, logs, **settings):
    return identify_all(model, logs, **{**PLAIN, **settings})


def fit(model, logs, *, validation=(), signals=None, estimator="consistent"):
    """Return the fit of a model as it is to logs in memory, before anything is judged."""
    fitted, kept = (
        [hold_log(model, log, signals or SignalSettings()) for log in some]
        for some in (logs, validation)
    )
    choice = EstimatorSettings(estimator) if isinstance(estimator, str) else estimator
    return fit_recordings(Recordings(model, structural_mapping(model), fitted, kept), choice)
