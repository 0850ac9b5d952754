"""Variation of parameters between recordings and between robots of one kind."""
