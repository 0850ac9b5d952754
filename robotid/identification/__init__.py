"""Model and logs -> Identification: priors, errors, determined parameters, verdict."""

__all__: list[str] = []
