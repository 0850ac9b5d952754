"""Figures of an identification, worked out again from parameters and trajectories."""

import numpy as np

from robotid.dynamics.torque import joint_torque_regressor


def torques(found, trajectory):
    """Return the torque of each model by name, shape (N, n) each, from the regressor alone."""
    direction = trajectory.direction  # the signs of friction, filtered as the torque is
    W = joint_torque_regressor(found.model, trajectory.q, trajectory.v, trajectory.a, direction)
    still = np.zeros_like(trajectory.q)
    G = joint_torque_regressor(found.model, trajectory.q, still, still)
    inertial = np.arange(len(found.prior)) < found.model.layout.n_inertial
    urdf = np.where(inertial, found.prior, 0.0)
    return {
        "estimate": (W @ found.standard).reshape(still.shape),
        "wls": (W[:, found.mapping.independent] @ found.wls.theta).reshape(still.shape),
        "urdf": (W @ urdf).reshape(still.shape),
        "gravity_only": (G @ urdf).reshape(still.shape),
        "urdf_with_drives": (W @ found.urdf_with_drives).reshape(still.shape),
    }


def figures(found, evaluations, name="estimate"):
    """Return error, RMSE, R^2, rows and baselines of each joint over some recordings."""
    taus, masks, predictions = [], [], []
    for evaluation in evaluations:
        trajectory = evaluation.recording.trajectory
        taus.append(trajectory.tau)
        masks.append(evaluation.recording.mask.astype(bool))
        predictions.append(torques(found, trajectory))
    tau, mask = np.vstack(taus), np.vstack(masks)
    predicted = {key: np.vstack([p[key] for p in predictions]) for key in predictions[0]}
    table = {}
    for j, joint in enumerate(found.model.joints):
        y, used = tau[mask[:, j], j], mask[:, j]
        size, r = np.linalg.norm(y), y - predicted[name][used, j]
        others = {
            key: 100 * np.linalg.norm(y - predicted[key][used, j]) / size
            for key in ("wls", "urdf", "gravity_only", "urdf_with_drives")
        }
        table[joint] = {
            "error": 100 * np.linalg.norm(r) / size,
            "rmse": np.sqrt(np.mean(r**2)),
            "r2": 1 - np.sum(r**2) / np.sum((y - y.mean()) ** 2),
            "rows": len(y),
            **others,
        }
    return table
