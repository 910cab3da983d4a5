"""Independent NumPy counterparts of what casacal computes; nothing here imports casacal."""

import math

import numpy as np


def rot_x(angle):
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1.0]])


def rot_z(angle):
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])


def shift(x, y, z):
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def dh_chain(alpha, a, d, theta):
    """Standard DH, by multiplying the four elementary motions."""
    pose = np.eye(4)
    for row in zip(alpha, a, d, theta, strict=True):
        pose = pose @ rot_z(row[3]) @ shift(0, 0, row[2]) @ shift(row[1], 0, 0) @ rot_x(row[0])
    return pose


def modified_dh_chain(alpha, a, d, theta):
    """Craig's DH, by multiplying the four elementary motions."""
    pose = np.eye(4)
    for row in zip(alpha, a, d, theta, strict=True):
        pose = pose @ rot_x(row[0]) @ shift(row[1], 0, 0) @ rot_z(row[3]) @ shift(0, 0, row[2])
    return pose


def central_difference(function, x, steps):
    """Jacobian (m, n) of a function R^n -> R^m by central differences with a step for each variable."""
    columns = []
    for j, step in enumerate(steps):
        e = np.zeros(len(x))
        e[j] = step
        columns.append((function(x + e) - function(x - e)) / (2 * step))
    return np.stack(columns, axis=-1)


def cubature_step(mean, covariance, h, measured, variance):
    """The plain cubature Kalman filter's update of a static state by one scalar, with full covariances."""
    n = len(mean)
    root = np.linalg.cholesky(covariance)
    points = np.array([mean + sign * math.sqrt(n) * root[:, i] for sign in (1, -1) for i in range(n)])
    predictions = np.array([h(point) for point in points])
    predicted = predictions.mean()
    p_zz = ((predictions - predicted) ** 2).mean() + variance
    p_xz = ((points - mean) * (predictions - predicted)[:, None]).mean(axis=0)
    gain = p_xz / p_zz
    return mean + gain * (measured - predicted), covariance - np.outer(gain, gain) * p_zz


def posterior(matrix, measured, x0, prior_std):
    """Closed form of a linear least-squares problem with a Gaussian prior, by an augmented QR."""
    stacked = np.vstack([matrix, np.diag(1 / prior_std)])
    target = np.concatenate([measured, x0 / prior_std])
    q, r = np.linalg.qr(stacked)
    inverse = np.linalg.inv(r)
    return inverse @ (q.T @ target), inverse @ inverse.T
