"""Seams of every shape: what the reach check takes the expert seals, what it refuses it gives reasons for."""

from collections.abc import Callable

import numpy as np
import pytest

from agents.expert import RmpExpert
from seal_gym.core.errors import SeamError
from seal_gym.envs.config import SealCfg
from seal_gym.envs.core import SealCore
from seal_gym.workpieces.workpiece import Workpiece

UP = np.array([0.0, 0.0, 1.0])
X = np.linspace(-0.12, 0.12, 49)
MM = 1e-3


def part(points, *, lean=45.0, side=1.0, **options) -> Workpiece:
    """A fillet whose gun leans to the right (side 1) or left of travel, by degrees from the normal."""
    p = np.asarray(points, dtype=float)
    u = np.diff(p, axis=0) / np.linalg.norm(np.diff(p, axis=0), axis=1, keepdims=True)
    t = np.concatenate((u[:1], u[:-1] + u[1:], u[-1:]))
    right = np.cross(t, UP)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    up = np.cross(right, t / np.linalg.norm(t, axis=1, keepdims=True))
    angle = np.deg2rad(lean)
    return Workpiece.from_polyline(p, np.cos(angle) * up + side * np.sin(angle) * right, **options)


def corner(turn_deg, radius, wall=0.03, side=1.0, leg=0.08, **options) -> Workpiece:
    """Turns left by an angle: round the wall's outside if the gun leans to the right, else in its corner."""
    a = np.deg2rad(turn_deg)
    points = leg * np.array([[-1, 0, 0], [0, 0, 0], [np.cos(a), np.sin(a), 0]])
    if options.get("joint") != "groove":
        options["wall_height"] = wall
    return part(points, side=side, corner_radius=radius, **options)


def wave(amplitude, period, **options) -> Workpiece:
    return part(np.column_stack((X, amplitude * np.sin(2 * np.pi * X / period), 0 * X)), **options)


def zigzag(amplitude, radius) -> Workpiece:
    y = amplitude * np.array([0, 1, 0, 1, 0])
    return part(np.column_stack((np.linspace(-0.12, 0.12, 5), y, 0 * y)), corner_radius=radius)


def ellipse(a, b, **options) -> Workpiece:
    """Half of one, travelled counter-clockwise."""
    t = np.linspace(-np.pi / 2, np.pi / 2, 91)
    return part(np.column_stack((a * np.cos(t), b * np.sin(t), 0 * t)), **options)


def hexagon(side, radius) -> Workpiece:
    t = np.deg2rad([-90.0, -30.0, 30.0, 90.0])
    return part(side * np.column_stack((np.cos(t), np.sin(t), 0 * t)), corner_radius=radius)


def ramp(slope_deg, radius, *, rising, first) -> Workpiece:
    """Level, then up or down by a slope, or the slope first."""
    climb = 0.08 * np.tan(np.deg2rad(slope_deg))
    z = np.array([0, 0, climb]) if first == "level" else np.array([0, climb, climb])
    z = z if rising else z[-1] - z
    # The run-on goes 30 mm further: it must not dive below the plate.
    z = z + 0.03 * np.tan(np.deg2rad(slope_deg))
    return part(np.column_stack(([-0.08, 0.0, 0.08], np.zeros(3), z)), corner_radius=radius)


def straight(length, **options) -> Workpiece:
    return part([[-length / 2, 0, 0], [length / 2, 0, 0]], **options)


def groove(points, lean=0.0, **options) -> Workpiece:
    return part(points, lean=lean, joint="groove", **options)


LINE = [[-0.1, 0, 0], [0.1, 0, 0]]
CURVE = np.column_stack((X, 0.02 * np.sin(2 * np.pi * X / 0.24), 0 * X))
TURN = np.linspace(-np.pi, np.pi, 73)
CIRCLE = 0.05 * np.column_stack((np.cos(TURN), np.sin(TURN), 0 * TURN))
PLAIN: dict[str, Callable[[], Workpiece]] = {
    **{f"outer corner {r} mm": lambda r=r: corner(90, r * MM) for r in (5, 10, 20)},
    "outer corner 120 deg": lambda: corner(120, 10 * MM),
    "inner corner 30 mm": lambda: corner(-90, 30 * MM),
    "inner corner 30 mm, wall 25 mm": lambda: corner(-90, 30 * MM, wall=0.025),
    "inner corner 15 mm, 30 deg": lambda: corner(-30, 15 * MM),
    "inner corner 45 deg": lambda: corner(-45, 20 * MM),
    "S-curve": lambda: wave(0.02, 0.24, wall_height=0.04),
    "tighter S-curve": lambda: wave(0.01, 0.12),
    "zig-zag": lambda: zigzag(0.01, 20 * MM),
    "ellipse": lambda: ellipse(0.06, 0.04),
    "hexagon": lambda: hexagon(0.05, 5 * MM),
    "ramp of 10 deg": lambda: ramp(10, 5 * MM, rising=True, first="level"),
    "ramp of 10 deg down": lambda: ramp(10, 5 * MM, rising=False, first="level"),
    "wall of 25 mm": lambda: straight(0.2, wall_height=0.025),
    "wall of 40 mm": lambda: straight(0.2, wall_height=0.04),
    **{f"lean of {v:g} deg": lambda v=v: straight(0.2, lean=v) for v in (35, 55)},
    "short": lambda: straight(0.04),
    "long": lambda: straight(0.5),
    "wall on the right": lambda: straight(0.2, side=-1.0),
    "outer corner, wall on the right": lambda: corner(-90, 10 * MM, side=-1.0),
    "inner corner, wall on the right": lambda: corner(90, 30 * MM, side=-1.0),
    "in a bowl": lambda: ellipse(0.06, 0.04, side=-1.0),
    **{
        f"ramp of {slope} deg, {'up' if rising else 'down'}, {first} first": (
            lambda slope=slope, rising=rising, first=first: ramp(slope, 20 * MM, rising=rising, first=first)
        )
        for slope in (20, 30)
        for rising in (True, False)
        for first in ("level", "slope")
    },
    "groove": lambda: groove(LINE),
    "fine groove": lambda: groove(LINE, groove_width=0.5 * MM),
    "wide groove": lambda: groove(LINE, groove_width=3 * MM),
    "groove, leaning": lambda: groove(LINE, 20.0),
    "groove, leaning to the left": lambda: groove(LINE, 20.0, side=-1.0),
    "fine groove, leaning": lambda: groove(LINE, 20.0, groove_width=0.5 * MM),
    "groove, S-curve": lambda: groove(CURVE),
    "groove, circle": lambda: groove(CIRCLE),
    "fine groove, circle": lambda: groove(CIRCLE, groove_width=0.5 * MM),
    "wide groove, circle": lambda: groove(CIRCLE, groove_width=3 * MM),
    "groove, corner": lambda: corner(90, 5 * MM, lean=0.0, joint="groove"),
    "groove, corner to the right": lambda: corner(-90, 5 * MM, lean=0.0, joint="groove"),
}
# What vision cannot see: the wall hides the seam.
HARD: dict[str, Callable[[], Workpiece]] = {
    "inner corner 20 mm": lambda: corner(-90, 20 * MM, wall=0.025),
    "inner corner 30 mm, wall 40 mm": lambda: corner(-90, 30 * MM, wall=0.04),
}
SEEDS = tuple(range(500_000, 500_004))


def play(workpiece: Workpiece, perception: str, seeds=SEEDS) -> list[dict]:
    """The metrics of the expert's episodes, all at once."""
    core = SealCore(SealCfg.of(workpiece=workpiece, control="rmp", perception=perception), len(seeds))
    for i, seed in enumerate(seeds):
        core.reset(i, np.random.default_rng(seed))
    expert, metrics = RmpExpert(), {}
    while len(metrics) < len(seeds):
        result = core.step(expert.predict(core.observe())[0])
        for i in np.flatnonzero(result.terminated | result.timeout):
            metrics.setdefault(int(i), core.episode_metrics(i, result))
    return [metrics[i] for i in range(len(seeds))]


def check(workpiece: Workpiece, perception: str, rmse_mm: float, seeds=SEEDS) -> None:
    metrics = play(workpiece, perception, seeds)
    assert [m["outcome"] for m in metrics] == ["reached"] * len(seeds)
    assert max(m["rmse_mm"] for m in metrics) < rmse_mm


@pytest.mark.parametrize("name", ["short", "groove, corner"])
def test_the_expert_seals_it_on_the_oracle(name: str) -> None:
    check((PLAIN | HARD)[name](), "oracle", 0.15, SEEDS[:2])


def test_the_expert_seals_a_short_seam_by_vision() -> None:
    check(PLAIN["short"](), "vision", 0.15, SEEDS[:2])


@pytest.mark.slow
@pytest.mark.parametrize("name", PLAIN | HARD)
def test_the_expert_seals_every_shape_on_the_oracle(name: str) -> None:
    check((PLAIN | HARD)[name](), "oracle", 0.15)


@pytest.mark.slow
@pytest.mark.parametrize("name", PLAIN)
def test_the_expert_seals_plain_shapes_by_vision(name: str) -> None:
    check(PLAIN[name](), "vision", 0.15)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: corner(-90, 5 * MM), r"hollow bend at 75 mm .* radius of 5.0 mm"),
        (lambda: wave(0.02, 0.12), r"hollow bend at .*more points along the bend"),
        (lambda: corner(-90, 20 * MM), r"no room: gun/col_cartridge.*widen the bend, lower the wall"),
        (lambda: ellipse(0.03, 0.03, side=-1.0), r"no room: gun/col_cartridge"),
        (lambda: straight(0.2, lean=34), r"leans 34.0\.\.34.0 deg .* a fillet needs 35\.\.55 deg"),
        (lambda: straight(0.2, wall_height=0.015), r"wall_height = 0.015: must be in 0.025\.\.0.04 m"),
        (lambda: straight(0.039), r"the seam is 39.0 mm long: at least 40 mm"),
    ],
)
def test_what_cannot_be_sealed_is_refused_with_place_and_reason(make, message) -> None:
    with pytest.raises(SeamError, match=message):
        SealCore(SealCfg.of(workpiece=make(), perception="oracle"), 1)


def test_what_cannot_be_seen_is_refused_by_vision_alone() -> None:
    SealCore(SealCfg.of(workpiece=HARD["inner corner 20 mm"](), perception="oracle"), 1)
    with pytest.raises(SeamError, match=r"hides the seam from the front camera at 5\d mm"):
        SealCore(SealCfg.of(workpiece=HARD["inner corner 20 mm"](), perception="vision"), 1)
