"""Riemannian Motion Policies: leaves, pullback, sum, resolve. Knows neither MuJoCo nor Gymnasium.

Leaves on the tip (``leaves``) or on distances (``barriers``) become ``Leaf`` tuples; ``resolve`` pulls them
back, sums them and solves for joint accelerations::

    policies = seam_policies(errors, twist, reference) + fixed_policies(errors, twist, reference, previous)
    leaves = [on_tip(*policy, jacobian, drift) for policy in policies]
    qdd = resolve([*leaves, joint_limits(q, qd, lower, upper)], jacobian)
"""

from seal_gym.rmp.algebra import Leaf, Rmp, combine, gather, pullback
from seal_gym.rmp.barriers import BarrierCfg, JointLimitCfg, ObstacleCfg, joint_limits, obstacle
from seal_gym.rmp.cholesky import cholesky_metric, metric_size, metric_to_cholesky
from seal_gym.rmp.clearance import (
    SEALING_GUN,
    Capsules,
    Clearances,
    LetPassCfg,
    allowed_speed,
    clearances,
    let_pass,
)
from seal_gym.rmp.leaves import (
    AttractionCfg,
    DampingCfg,
    ForwardSpeedCfg,
    HeadingCfg,
    LeanCfg,
    RegularisationCfg,
    ServoCfg,
    TipRmp,
    attraction_front,
    attraction_side,
    blend,
    damping,
    forward_speed,
    heading_front,
    heading_side,
    lean,
    on_tip,
    regularisation,
    saturate,
    sigma,
)
from seal_gym.rmp.resolve import ResolveCfg, damping_squared, resolve
from seal_gym.rmp.sealing import (
    SealingCfg,
    SeamErrors,
    TravelCfg,
    axis_errors,
    fixed_policies,
    reference_twist,
    seam_policies,
)

__all__ = [
    "SEALING_GUN",
    "AttractionCfg",
    "BarrierCfg",
    "Capsules",
    "Clearances",
    "DampingCfg",
    "ForwardSpeedCfg",
    "HeadingCfg",
    "JointLimitCfg",
    "Leaf",
    "LeanCfg",
    "LetPassCfg",
    "ObstacleCfg",
    "RegularisationCfg",
    "ResolveCfg",
    "Rmp",
    "SealingCfg",
    "SeamErrors",
    "ServoCfg",
    "TipRmp",
    "TravelCfg",
    "allowed_speed",
    "attraction_front",
    "attraction_side",
    "axis_errors",
    "blend",
    "cholesky_metric",
    "clearances",
    "combine",
    "damping",
    "damping_squared",
    "fixed_policies",
    "forward_speed",
    "gather",
    "heading_front",
    "heading_side",
    "joint_limits",
    "lean",
    "let_pass",
    "metric_size",
    "metric_to_cholesky",
    "obstacle",
    "on_tip",
    "pullback",
    "reference_twist",
    "regularisation",
    "resolve",
    "saturate",
    "seam_policies",
    "sigma",
]
