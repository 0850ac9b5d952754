"""What is wrong, with evidence: the URDF, the logs, the residual, the verdict."""
