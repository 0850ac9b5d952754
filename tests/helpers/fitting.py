"""``identify`` for tests of fits: the doctor, whose findings they do not read, is not asked."""

from robotid.identification import pipeline


def identify(model, logs, **settings):
    return pipeline.identify(model, logs, **{"doctor": False, **settings})
