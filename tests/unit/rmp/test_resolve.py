"""Resolve at full rank and at the UR5's singularities."""

import numpy as np
import pytest
from scipy.optimize import brentq

from seal_gym.core.errors import ConfigError
from seal_gym.rmp import Leaf, ResolveCfg, Rmp, damping_squared, on_tip, resolve

D = (0.089159, 0.0, 0.0, 0.10915, 0.09465, 0.0823 + 0.25)
A = (0.0, -0.425, -0.39225, 0.0, 0.0, 0.0)
ALPHA = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)

WRIST = np.radians([-4.0, -117.8, -94.7, -102.4, 0.0, -92.8])
ELBOW = np.radians([-4.0, -60.0, 0.0, -102.4, 87.2, -92.8])


def shoulder():
    """A posture with the wrist on the axis of joint 1, found by turning joint 2."""
    q = np.radians([0.0, 0.0, -100.0, -60.0, 60.0, 0.0])

    def determinant(angle):
        return np.linalg.det(ur5_jacobian(q + angle * np.eye(6)[1]))

    q[1] = brentq(determinant, np.radians(-60.0), 0.0, xtol=1e-14)
    return q


def ur5_jacobian(q):
    """Body Jacobian of the nozzle mouth from the standard DH table. (..., 6) to (..., 6, 6)."""
    pose = np.broadcast_to(np.eye(4), (*q.shape[:-1], 4, 4))
    axes, origins = [], []
    for joint, (d, a, alpha) in enumerate(zip(D, A, ALPHA, strict=True)):
        axes.append(pose[..., :3, 2])
        origins.append(pose[..., :3, 3])
        c, s, ca, sa = np.cos(q[..., joint]), np.sin(q[..., joint]), np.cos(alpha), np.sin(alpha)
        zero, one = np.zeros_like(c), np.ones_like(c)
        entries = [c, -s * ca, s * sa, a * c, s, c * ca, -c * sa, a * s]
        entries += [zero, sa * one, ca * one, d * one, zero, zero, zero, one]
        pose = pose @ np.stack(entries, axis=-1).reshape(*c.shape, 4, 4)
    tip, turn = pose[..., :3, 3], pose[..., :3, :3].mT
    linear = np.stack([np.cross(z, tip - o) for z, o in zip(axes, origins, strict=True)], axis=-1)
    return np.concatenate([turn @ linear, turn @ np.stack(axes, axis=-1)], axis=-2)


def tip_leaf(jacobian, accel):
    return on_tip(accel, np.eye(6), jacobian, np.zeros(6))


def test_the_test_postures_are_singular():
    for q in (WRIST, ELBOW, shoulder()):
        assert np.linalg.svd(ur5_jacobian(q), compute_uv=False)[-1] < 1e-6


@pytest.mark.parametrize(("posture", "joint"), [("wrist", 4), ("elbow", 2), ("shoulder", 1)])
def test_crossing_a_singularity_is_bounded_and_continuous(posture, joint):
    q = {"wrist": WRIST, "elbow": ELBOW, "shoulder": shoulder()}[posture]
    rng = np.random.default_rng(0)
    accel = rng.normal(size=6)
    accel /= np.linalg.norm(accel)

    def sweep(count):
        offsets = np.linspace(-0.4, 0.4, count)
        jacobians = ur5_jacobian(q + offsets[:, None] * np.eye(6)[joint])
        leaf = tip_leaf(jacobians, np.broadcast_to(accel, (count, 6)))
        return resolve([leaf], jacobians), np.linalg.solve(jacobians + 1e-12, leaf.accel[..., None])[..., 0]

    damped, plain = sweep(4002)
    assert np.abs(plain).max() > 100.0
    assert np.linalg.norm(damped, axis=1).max() < 30.0
    coarse = np.abs(np.diff(damped, axis=0)).max()
    fine = np.abs(np.diff(sweep(16008)[0], axis=0)).max()
    assert fine < 0.3 * coarse, "steps must shrink with the spacing: no jump"


def test_at_the_wrist_singularity_the_offset_1e_5_is_harmless():
    jacobian = ur5_jacobian(WRIST + 1e-5 * np.eye(6)[4])
    accel = np.array([0.0, 0.0, 0.0, 0.3, 0.3, 0.3])
    assert np.linalg.norm(np.linalg.solve(jacobian, accel)) > 1e3
    assert np.linalg.norm(resolve([tip_leaf(jacobian, accel)], jacobian)) < 10.0


def test_damping_follows_the_formula_and_is_off_at_the_cells_postures():
    cfg = ResolveCfg(damping=0.1, epsilon=0.2)
    diagonal = np.diag([1.0, 1.0, 0.1, 8.0, 8.0, 8.0])
    np.testing.assert_allclose(damping_squared(diagonal, cfg), 0.01 * 0.75)
    for posture in (
        (-4, -117.8, -94.7, -102.4, 87.2, -92.8),
        (-22.8, -111.4, -110.8, -68.9, 130.7, -30.7),
        (-26, -106.8, -116.9, -70, 129.5, -34.6),
    ):
        assert damping_squared(ur5_jacobian(np.radians(posture))) == 0.0


def test_rotations_are_scaled_by_the_length():
    jacobian = np.diag([1.0, 1.0, 1.0, 1.0, 1.0, 0.16])
    assert damping_squared(jacobian, ResolveCfg(length_m=1.0)) == 0.0
    np.testing.assert_allclose(damping_squared(jacobian), 0.05**2 * (1 - 0.8**2))


def test_one_full_rank_leaf_is_obeyed_whatever_its_metric():
    rng = np.random.default_rng(1)
    jacobian, accel, drift = (
        ur5_jacobian(np.radians((-26, -106.8, -116.9, -70, 129.5, -34.6))),
        *rng.normal(size=(2, 6)),
    )
    expected = np.linalg.solve(jacobian, accel - drift)
    for _ in range(5):
        root = rng.normal(size=(6, 6))
        leaf = on_tip(accel, root @ root.T + 0.1 * np.eye(6), jacobian, drift)
        np.testing.assert_allclose(resolve([leaf], jacobian), expected, rtol=1e-6, atol=1e-6)


def test_the_metric_matters_beside_another_leaf():
    rng = np.random.default_rng(2)
    jacobian, accel, drift = rng.normal(size=(6, 6)), *rng.normal(size=(2, 6))
    other = on_tip(np.zeros(6), np.eye(6), jacobian, drift)

    def with_metric(metric):
        return resolve([on_tip(accel, metric, jacobian, drift), other], jacobian)

    light, heavy = with_metric(np.eye(6)), with_metric(np.diag([100.0, 1, 1, 1, 1, 1]))
    assert np.abs(light - heavy).max() > 1e-2
    np.testing.assert_allclose(jacobian @ light + drift, accel / 2, atol=1e-8)
    np.testing.assert_allclose((jacobian @ heavy + drift)[0], accel[0] * 100 / 101, rtol=1e-7)


def test_scaling_every_metric_changes_nothing_even_at_a_singularity():
    jacobian, accel = ur5_jacobian(WRIST), np.arange(1.0, 7.0)
    one = resolve([tip_leaf(jacobian, accel)], jacobian)
    thousand = resolve([tip_leaf(jacobian, accel)._replace(metric=1e3 * np.eye(6))], jacobian)
    np.testing.assert_allclose(one, thousand, rtol=1e-6)


def test_open_directions_and_empty_metrics_are_solvable():
    jacobian = np.eye(6)
    np.testing.assert_array_equal(resolve(Rmp(np.zeros(6), np.zeros((6, 6))), jacobian), np.zeros(6))
    only_x = np.zeros((6, 6))
    only_x[0, 0] = 2.0
    np.testing.assert_allclose(
        resolve([tip_leaf(jacobian, np.ones(6))._replace(metric=only_x)], jacobian), only_x[0] / 2
    )


def test_a_redundant_arm_gets_the_wanted_task_acceleration():
    rng = np.random.default_rng(3)
    jacobian, accel = rng.normal(size=(3, 7)), rng.normal(size=3)
    qdd = resolve([Leaf(jacobian, np.zeros(3), accel, np.eye(3))], jacobian)
    np.testing.assert_allclose(jacobian @ qdd, accel, rtol=1e-6)


@pytest.mark.parametrize("field", ["damping", "epsilon", "length_m", "floor"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.inf, np.nan])
def test_bad_configurations_are_refused(field, value):
    with pytest.raises(ConfigError, match=f"ResolveCfg.{field}"):
        ResolveCfg(**{field: value})
