"""From rows or factors to estimates, and from recordings to fits with standard errors."""
