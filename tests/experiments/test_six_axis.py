"""The paper's six-axis arm: its Jacobian against symbolic derivatives of its forward kinematics."""

import numpy as np
import pytest

from experiments import six_axis
from seal_gym.planning import newton

sympy = pytest.importorskip("sympy")

PHI = sympy.symbols("phi0:6")
L1, L2, L3 = sympy.symbols("l1:4")


def sin(*joints):
    return sympy.sin(sum(PHI[j] for j in joints))


def cos(*joints):
    return sympy.cos(sum(PHI[j] for j in joints))


S0, C0, S1, C1, S2, C2, S4, C4 = sin(0), cos(0), sin(1), cos(1), sin(2), cos(2), sin(4), cos(4)
S13, C13, S135, C135 = sin(1, 3), cos(1, 3), sin(1, 3, 5), cos(1, 3, 5)
X = (
    L1 * C1 * S0
    + L2 * (C13 * S0 * C2 + S13 * S2)
    + L3 * (C135 * S0 * C2 * C4 + S135 * C2 * S4 - C135 * S0 * S2 * S4 + S135 * S2 * C4)
)
Y = (L1 * C1 + L2 * C13 + L3 * C135) * C0


def height(first, sign):
    """z with its two disputed terms: Eq. 3 prints first = l1 s1 s0 and sign = -1."""
    last = C135 * S0 * S2 * C4 + sign * S135 * S2 * S4 + C135 * S0 * C2 * S4 - S135 * C2 * C4
    return first - L2 * (C13 * S0 * S2 - S13 * C2) - L3 * last


Z = height(L1 * S1, 1)
Z5 = L3 * (S135 * S0 * S2 * C4 - C135 * S2 * S4 + S135 * S0 * C2 * S4 + C135 * C2 * C4)
Z3 = L2 * (S13 * S0 * S2 + C13 * C2) + Z5
Z4 = -L3 * (C135 * S0 * C2 * C4 + S135 * C2 * S4 - C135 * S0 * S2 * S4 + S135 * S2 * C4)
# The entries that differ from the print.
MENDED = {
    ("x", 2): -L2 * (C13 * S0 * S2 - S13 * C2)
    - L3 * (C135 * S0 * S2 * C4 + S135 * S2 * S4 + C135 * S0 * C2 * S4 - S135 * C2 * C4),
    ("z", 0): -L2 * C13 * C0 * S2 - L3 * C135 * C0 * (S2 * C4 + C2 * S4),
    ("z", 1): L1 * C1 + Z3,
    ("z", 2): -L2 * (C13 * S0 * C2 + S13 * S2) + Z4,
    ("z", 3): Z3,
    ("z", 4): Z4,
    ("z", 5): Z5,
}


def value(expression, q):
    lengths = zip((L1, L2, L3), six_axis.LENGTHS_M, strict=True)
    return sympy.lambdify(PHI, expression.subs(dict(lengths)), "numpy")(*q.T) + np.zeros(len(q))


@pytest.fixture(scope="module")
def postures():
    return np.random.default_rng(0).uniform(-np.pi, np.pi, (200, 6))


@pytest.mark.parametrize("row", ["x", "y", "z"])
def test_position_and_jacobian_are_the_symbolic_ones(postures, row):
    k, expression = "xyz".index(row), {"x": X, "y": Y, "z": Z}[row]
    np.testing.assert_allclose(six_axis.pose(postures)[:, k], value(expression, postures), atol=1e-14)
    for joint in range(6):
        expected = value(sympy.diff(expression, PHI[joint]), postures)
        np.testing.assert_allclose(six_axis.jacobian(postures)[:, k, joint], expected, atol=1e-14)


@pytest.mark.parametrize(("row", "joint"), MENDED)
def test_mended_entries_are_the_derivatives(row, joint):
    difference = MENDED[row, joint] - sympy.diff({"x": X, "z": Z}[row], PHI[joint])
    assert sympy.simplify(sympy.expand_trig(sympy.expand(difference))) == 0


def test_angles_are_sums_of_joints(postures):
    alpha, beta, gamma = six_axis.pose(postures)[:, 3:].T
    np.testing.assert_allclose(alpha, postures[:, 1] + postures[:, 3] + postures[:, 5], atol=1e-14)
    np.testing.assert_allclose(beta, postures[:, 2] + postures[:, 4], atol=1e-14)
    np.testing.assert_array_equal(gamma, postures[:, 0])
    step = 1e-6 * np.eye(6)
    for joint in range(6):
        moved = (six_axis.pose(postures + step[joint]) - six_axis.pose(postures - step[joint])) / 2e-6
        np.testing.assert_allclose(six_axis.jacobian(postures)[:, 3:, joint], moved[:, 3:], atol=1e-8)


@pytest.mark.parametrize(("link", "printed"), [(L1, (L1 * S1 * S0, 1)), (L3, (L1 * S1, -1))])
def test_links_keep_their_lengths_and_as_printed_they_do_not(link, printed):
    alone = {other: 0 for other in (L1, L2, L3) if other is not link} | {link: 1}
    lengths = [
        sympy.lambdify(PHI, (X**2 + Y**2 + z**2).subs(alone), "numpy")(*np.linspace(0.3, 1.4, 6))
        for z in (Z, height(*printed))
    ]
    assert lengths[0] == pytest.approx(1.0, abs=1e-14)
    assert abs(lengths[1] - 1.0) > 0.01


def test_newton_finds_postures_with_the_target_and_none_without(postures):
    target = six_axis.pose(postures)
    limit = np.full(6, np.pi)
    found = newton.solve(
        target,
        np.full(6, 0.4),
        np.random.default_rng(1),
        model=six_axis.linearised,
        lower=-limit,
        upper=limit,
    ).q
    assert np.isfinite(found).all()
    apart = six_axis.pose(found) - target
    apart[:, 3:] = np.angle(np.exp(1j * apart[:, 3:]))
    assert np.abs(apart).max() < 1e-7

    # Eqs. 36-37 as printed: zeta without the target drives the pose to zero.
    def printed(q, _):
        return six_axis.linearised(q, np.zeros((len(q), 6)))

    lost = newton.solve(
        target,
        np.full(6, 0.4),
        np.random.default_rng(1),
        model=printed,
        lower=-limit,
        upper=limit,
        cfg=newton.NewtonCfg(restarts=0),
    ).q
    reached = np.abs(six_axis.pose(np.where(np.isnan(lost), 0.0, lost)) - target).max(axis=1) < 1e-6
    assert not reached.any()
