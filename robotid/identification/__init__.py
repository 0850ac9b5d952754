"""Model and logs -> Identification: priors, errors, what is determined, verdict."""

__all__: list[str] = []
