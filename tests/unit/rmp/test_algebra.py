"""Pullback and sum against independent truths: a composed map, finite differences, energy."""

import itertools

import numpy as np
import pytest

from seal_gym.rmp import Leaf, Rmp, combine, gather, pullback, resolve

LENGTHS = np.array([0.5, 0.4, 0.2])


def fk(q):
    """Planar arm with three links: (x, y, heading)."""
    absolute = np.cumsum(q)
    return np.array([LENGTHS @ np.cos(absolute), LENGTHS @ np.sin(absolute), absolute[-1]])


def jacobian(q):
    """Its derivative, by hand."""
    absolute = np.cumsum(q)
    rows = np.ones((3, 3))
    for joint in range(3):
        rows[0, joint] = -LENGTHS[joint:] @ np.sin(absolute[joint:])
        rows[1, joint] = LENGTHS[joint:] @ np.cos(absolute[joint:])
    return rows


def drift(q, qd):
    """Jdot qdot: the centripetal accelerations of the links, by hand."""
    absolute, rates = np.cumsum(q), np.cumsum(qd)
    return np.array([-LENGTHS @ (np.cos(absolute) * rates**2), -LENGTHS @ (np.sin(absolute) * rates**2), 0.0])


def definite(rng, size):
    root = rng.normal(size=(size, size))
    return root @ root.T + 0.1 * np.eye(size)


def random_leaf(rng, m=6, n=6):
    return Leaf(rng.normal(size=(m, n)), rng.normal(size=m), rng.normal(size=m), definite(rng, m))


def close(left, right, rtol=1e-12):
    for a, b in zip(left, right, strict=True):
        np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol)


def test_the_test_arms_derivatives_match_finite_differences():
    rng = np.random.default_rng(0)
    q, qd, h = rng.normal(size=3), rng.normal(size=3), 1e-6
    numeric = np.column_stack([(fk(q + h * e) - fk(q - h * e)) / (2 * h) for e in np.eye(3)])
    np.testing.assert_allclose(jacobian(q), numeric, atol=1e-9)
    numeric_drift = (jacobian(q + h * qd) - jacobian(q - h * qd)) @ qd / (2 * h)
    np.testing.assert_allclose(drift(q, qd), numeric_drift, atol=1e-8)


def test_pullback_by_hand():
    leaf = Leaf(np.array([[2.0, 0.0, 1.0]]), np.array([0.5]), np.array([3.5]), np.array([[4.0]]))
    rmp = pullback(leaf)
    np.testing.assert_array_equal(rmp.metric, 4.0 * np.array([[4, 0, 2], [0, 0, 0], [2, 0, 1.0]]))
    np.testing.assert_array_equal(rmp.force, [24.0, 0.0, 12.0])


def test_pullback_keeps_metrics_symmetric_and_semidefinite():
    rng = np.random.default_rng(1)
    metric = pullback(random_leaf(rng, m=4, n=7)).metric
    np.testing.assert_allclose(metric, metric.T, atol=1e-13)
    assert np.linalg.eigvalsh(metric)[0] > -1e-12


def test_pullback_composes():
    rng = np.random.default_rng(2)
    first, second, qd = rng.normal(size=(4, 7)), rng.normal(size=(6, 4)), rng.normal(size=7)
    first_dot, second_dot = rng.normal(size=(4, 7)), rng.normal(size=(6, 4))
    accel, metric = rng.normal(size=6), definite(rng, 6)

    middle = pullback(Leaf(second, second_dot @ (first @ qd), accel, metric))
    middle_accel = np.linalg.solve(middle.metric, middle.force)
    twice = pullback(Leaf(first, first_dot @ qd, middle_accel, middle.metric))

    whole_dot = second_dot @ first + second @ first_dot
    once = pullback(Leaf(second @ first, whole_dot @ qd, accel, metric))
    close(twice, once, rtol=1e-10)


def test_sum_is_commutative_and_associative():
    rng = np.random.default_rng(3)
    a, b, c = (Rmp(rng.normal(size=5), definite(rng, 5)) for _ in range(3))
    close(combine([a, b, c]), combine([c, a, b]))
    close(combine([combine([a, b]), c]), combine([a, combine([b, c])]))


def test_sum_adds_metrics_and_does_not_average_them():
    rmp = Rmp(np.array([2.0]), np.array([[3.0]]))
    assert combine([rmp, rmp]).metric == 6.0


def test_gather_equals_pullback_and_combine():
    rng = np.random.default_rng(4)
    shared = random_leaf(rng)
    leaves = [shared._replace(accel=rng.normal(size=6), metric=definite(rng, 6)) for _ in range(3)]
    leaves += [random_leaf(rng, m=1), random_leaf(rng, m=3)]
    close(gather(leaves), combine(pullback(leaf) for leaf in leaves), rtol=1e-11)


def test_gather_takes_a_generator_of_temporaries():
    leaves = [random_leaf(np.random.default_rng(seed)) for seed in range(20)]
    fresh = (Leaf(*(array.copy() for array in leaf)) for leaf in leaves)
    close(gather(fresh), gather(leaves))


@pytest.mark.parametrize("count", [1, 2, 5, 16])
def test_a_batch_gives_the_bits_of_its_members(count):
    rng = np.random.default_rng(5)
    root = rng.normal(size=(4, count, 6, 6))
    shared, bias = rng.normal(size=(count, 6, 6)), rng.normal(size=(count, 6))
    leaves = [Leaf(shared, bias, rng.normal(size=(count, 6)), r @ r.mT) for r in root]
    leaves.append(Leaf(shared[:, :1], bias[:, :1], rng.normal(size=(count, 1)), np.ones((count, 1, 1))))
    shared[0, :, 0] = 1e-3 * shared[0, :, 1]  # one member needs damping
    batch = resolve(leaves, shared)
    for i in range(count):
        one, drift_one = shared[i : i + 1].copy(), bias[i : i + 1].copy()
        alone = [
            Leaf(one, drift_one, leaf.accel[i : i + 1].copy(), leaf.metric[i : i + 1].copy())
            for leaf in leaves[:-1]
        ]
        last = leaves[-1]
        alone.append(Leaf(one[:, :1], drift_one[:, :1], last.accel[i : i + 1], last.metric[i : i + 1]))
        np.testing.assert_array_equal(resolve(alone, one)[0], batch[i])


def test_realised_task_acceleration_is_exact_with_drift_and_off_without():
    rng = np.random.default_rng(6)
    q, qd, wanted, h = np.array([0.3, 0.9, -0.5]), 3.0 * rng.normal(size=3), rng.normal(size=3), 3e-5

    def realised(qdd):
        """Second difference of the forward kinematics along the motion."""
        return (fk(q + h * qd + h * h * qdd / 2) - 2 * fk(q) + fk(q - h * qd + h * h * qdd / 2)) / h**2

    leaf = Leaf(jacobian(q), drift(q, qd), wanted, definite(rng, 3))
    np.testing.assert_allclose(realised(resolve([leaf], leaf.jacobian)), wanted, atol=1e-5)
    without = leaf._replace(drift=np.zeros(3))
    assert np.abs(realised(resolve([without], leaf.jacobian)) - wanted).max() > 0.5


def energies(with_drift, steps=3000, dt=1e-3):
    """Energy of the arm under a spring and damper at its tip and a weak joint-space damper (RK4).

    Kinetic energy is that of the metrics, potential energy that of the spring.
    """
    goal, stiffness, damper, inertia = np.array([0.3, 0.5]), 4.0, 0.1, 0.05

    def accel(q, qd):
        rows, bias = jacobian(q)[:2], drift(q, qd)[:2]
        tip_accel = -stiffness * (fk(q)[:2] - goal) - damper * (rows @ qd)
        tip = Leaf(rows, bias if with_drift else np.zeros(2), tip_accel, np.eye(2))
        joints = Leaf(np.eye(3), np.zeros(3), -damper * qd, inertia * np.eye(3))
        return resolve([tip, joints], np.eye(3))

    def energy(q, qd):
        velocity, offset = jacobian(q)[:2] @ qd, fk(q)[:2] - goal
        return (velocity @ velocity + inertia * qd @ qd + stiffness * offset @ offset) / 2

    state = np.array([0.2, 0.8, 0.4, 2.0, -1.0, 1.5])

    def derivative(s):
        return np.concatenate([s[3:], accel(s[:3], s[3:])])

    history = [energy(state[:3], state[3:])]
    for _ in range(steps):
        k1 = derivative(state)
        k2 = derivative(state + dt / 2 * k1)
        k3 = derivative(state + dt / 2 * k2)
        k4 = derivative(state + dt * k3)
        state = state + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        history.append(energy(state[:3], state[3:]))
    return np.array(history)


def test_energy_of_a_damped_arm_never_rises():
    assert np.all(np.diff(energies(with_drift=True)) < 0.0)


def test_energy_rises_when_the_drift_is_left_out():
    rises = np.mean(np.diff(energies(with_drift=False)) > 0.0)
    assert rises > 0.1, "the drift term must matter in this test, or the one above shows nothing"


def test_resolve_does_not_depend_on_the_order_of_leaves():
    rng = np.random.default_rng(7)
    shared = random_leaf(rng)
    leaves = [shared._replace(accel=rng.normal(size=6)), shared, random_leaf(rng, m=2), random_leaf(rng, m=1)]
    results = [resolve(list(order), shared.jacobian) for order in itertools.permutations(leaves)]
    np.testing.assert_allclose(results, np.broadcast_to(results[0], (24, 6)), rtol=1e-9)
