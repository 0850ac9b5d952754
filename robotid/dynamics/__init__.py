"""Torque linear in the parameters: rows of W theta = tau, base parameters, factors, prediction."""
