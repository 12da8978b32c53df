"""Leaves to add to an environment: ``env.unwrapped.add_leaf(ObstacleLeaf())``, or the ``leaves`` keyword."""

import numpy as np

from seal_gym.envs.adapters import ArmState
from seal_gym.rmp import LetPassCfg, clearances, let_pass
from seal_gym.rmp.algebra import Leaf


class ObstacleLeaf:
    """Lets ``MovingObstacle`` pass: the gun waits on the seam, and goes on when the way is free.

    It works beside any policy with ``control="rmp"``, which need not know of it.
    """

    def __init__(self, cfg: LetPassCfg | None = None) -> None:
        """Takes the gains.

        Args:
            cfg: Margins and gains.
        """
        self._cfg = cfg or LetPassCfg()

    def __call__(self, state: ArmState) -> Leaf:
        """The leaf of N simulations, see ``seal_gym.rmp.let_pass``.

        Args:
            state: Of the arms.

        Returns:
            A metric of zero where no obstacle is near.
        """
        ball = state.obstacle
        if ball is None:
            n = len(state.q)
            nothing = np.zeros((n, 1))
            return Leaf(np.zeros((n, 1, 6)), nothing, nothing, np.zeros((n, 1, 1)))
        near = clearances(state.tip, ball.position, ball.velocity, ball.radius)
        return let_pass(state.tip, near, self._cfg)
