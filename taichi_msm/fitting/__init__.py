"""Parameter estimation from observations, with confidence intervals."""
