"""A right-invariant filter of a legged base in plain NumPy, written from its source and apart from the library.

Source: Hartley, Ghaffari, Eustice & Grizzle 2020, Contact-aided invariant extended Kalman filtering for robot state
estimation, IJRR 39(4), with the same gate and the same new anchors as the filter it is compared with.
"""

import numpy as np


def hat(a):
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


def rotation(a):
    angle, skew = np.linalg.norm(a), hat(a)
    if angle < 1e-6:
        return np.eye(3) + skew + skew @ skew / 2
    return np.eye(3) + np.sin(angle) / angle * skew + (1 - np.cos(angle)) / angle**2 * skew @ skew


def left_jacobian(a):
    angle, skew = np.linalg.norm(a), hat(a)
    if angle < 1e-4:
        return np.eye(3) + skew / 2 + skew @ skew / 6
    return np.eye(3) + (1 - np.cos(angle)) / angle**2 * skew + (angle - np.sin(angle)) / angle**3 * skew @ skew


def run(gyro, acc, feet, slopes, turning, dt, *, gyro_std, acc_std, slip, encoder, gate, radius, attitude, velocity):
    """Velocities of the base in its axes (T, 3), and their standard deviations.

    `feet` (T, F, 3) are the centres of the feet in the axes of the base, `slopes` (T, F, 3, n) their derivatives by the
    joints, `turning` (T, F, 3) the angular velocity of the links of the feet in the base.
    """
    count, size = feet.shape[1], 15 + 3 * feet.shape[1]
    gravity, up = np.array([0.0, 0.0, -9.81]), np.array([0.0, 0.0, radius])
    R, v, p = attitude.copy(), velocity.copy(), np.zeros(3)
    anchors = p + feet[0] @ R.T
    P = np.zeros((size, size))
    for at, std in ((0, 0.03), (3, 0.3), (6, 1e-3), (size - 6, 0.05), (size - 3, 0.4)):
        P[at : at + 3, at : at + 3] = std**2 * np.eye(3)
    P[9 : size - 6, 9 : size - 6] = 1e-4 * np.eye(3 * count)
    gyro_bias, acc_bias = np.zeros(3), np.zeros(3)
    eye, velocities, stds, stood = np.eye(size), [], [], []
    for k in range(len(feet)):
        standing = np.zeros(count, bool)
        for i in range(count):
            at = slice(9 + 3 * i, 12 + 3 * i)
            noise = encoder**2 * R @ slopes[k, i] @ slopes[k, i].T @ R.T + 1e-10 * np.eye(3)
            H = np.zeros((3, size))
            H[:, 6:9], H[:, at] = -np.eye(3), np.eye(3)
            innovation = R @ feet[k, i] - (anchors[i] - p)
            S = H @ P @ H.T + noise
            standing[i] = k > 0 and innovation @ np.linalg.solve(S, innovation) < gate
            if standing[i]:
                K = np.linalg.solve(S, H @ P).T
                x, A = K @ innovation, eye - K @ H
                P = A @ P @ A.T + K @ noise @ K.T
                turn, lift = rotation(x[:3]), left_jacobian(x[:3])
                R, v, p = turn @ R, turn @ v + lift @ x[3:6], turn @ p + lift @ x[6:9]
                anchors = anchors @ turn.T + x[9 : size - 6].reshape(count, 3) @ lift.T
                gyro_bias, acc_bias = gyro_bias + x[-6:-3], acc_bias + x[-3:]
            else:
                anchors[i] = p + R @ feet[k, i]
                A = eye.copy()
                A[at], A[at, 6:9] = 0.0, np.eye(3)
                P = A @ P @ A.T
                P[at, at] += noise
        velocities.append(R.T @ v)
        stds.append(np.sqrt(np.diag(R.T @ P[3:6, 3:6] @ R)))
        stood.append(standing)
        w, a = gyro[k] - gyro_bias, acc[k] - acc_bias
        force = R @ left_jacobian(w * dt) @ a + gravity
        F, G = np.zeros((size, size)), np.zeros((size, 6))
        F[3:6, :3], F[6:9, 3:6] = hat(gravity), np.eye(3)
        G[:3, :3], G[3:6, 3:] = R, R
        for at, x in ((3, v), (6, p), *((9 + 3 * i, anchors[i]) for i in range(count))):
            G[at : at + 3, :3] = hat(x) @ R
        F[:, size - 6 :] = -G
        white = G * np.repeat([gyro_std, acc_std], 3) * np.sqrt(dt)
        creep = np.concatenate([np.zeros(9), np.full(3 * count, slip**2), np.full(3, 1e-8), np.full(3, 1e-6)])
        step = eye + F * dt + F @ F * dt**2 / 2
        P = step @ P @ step.T + dt * (white @ white.T + np.diag(creep))
        P = (P + P.T) / 2
        p, v = p + v * dt + force * dt**2 / 2, v + force * dt
        anchors = anchors + dt * np.cross((w + turning[k]) @ R.T, up)
        R = R @ rotation(w * dt)
    return np.array(velocities), np.array(stds), np.array(stood)
