"""Simulations that the tests of laydown share."""

import numpy as np

from seal_gym.sealant.laydown.config import GridCfg, LaydownCfg, NozzleCfg, TcpPath

FLOW_M3S = 12e-6


def straight(
    *,
    length_m: float = 0.03,
    speed_mps: float = 0.3,
    height_m: float = 0.03,
    rotation: np.ndarray | None = None,
    flows_m3s: tuple[float, float] = (FLOW_M3S, FLOW_M3S),
    substrate: str = "plane",
    nozzle: NozzleCfg | None = None,
    grid: GridCfg | None = None,
    gravity_mps2: tuple[float, float, float] = (0.0, 0.0, -9.81),
    x_m: float = 0.0,
) -> LaydownCfg:
    """A tip that moves along y at a constant height."""
    turn = np.eye(3) if rotation is None else rotation
    path = TcpPath(
        times_s=np.array([0.0, length_m / speed_mps]),
        positions=np.array([[x_m, 0.0, height_m], [x_m, length_m, height_m]]),
        rotations=np.stack((turn, turn)),
        flows_m3s=np.array(flows_m3s),
    )
    return LaydownCfg(
        path=path,
        substrate=substrate,
        nozzle=nozzle or NozzleCfg(),
        grid=grid or GridCfg(),
        gravity_mps2=gravity_mps2,
    )
