"""Poses of the reference UR5: pinocchio's."""

import numpy as np
import pytest

from experiments.reference_arm import ReferenceArm
from seal_gym.core.kinematics import JOINT_LOWER, JOINT_UPPER

N = 10_000


@pytest.fixture(scope="session")
def reference_arm():
    pytest.importorskip("pinocchio", reason="the reference UR5 needs pin and example-robot-data")
    return ReferenceArm()


@pytest.fixture(scope="session")
def reachable(reference_arm):
    """Postures drawn over the joints' whole range, and their poses by the reference. (N, 6), (N, 4, 4)."""
    q = np.random.default_rng(500_000).uniform(JOINT_LOWER, JOINT_UPPER, (N, 6))
    return q, reference_arm.tip(q)
