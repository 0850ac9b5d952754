"""Model and logs -> Identification: priors, errors, determined parameters, verdict."""
