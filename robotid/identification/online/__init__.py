"""Online identification."""
