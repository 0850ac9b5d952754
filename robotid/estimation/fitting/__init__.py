"""A robot and its recordings to a fit: what is fitted, its errors, and how well it predicts."""
