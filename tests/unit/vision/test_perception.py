"""The tracker on rendered seams: accuracy against the oracle, lost frames, resets, independence of rows."""

import numpy as np
import pytest

from seal_gym.core.errors import ConfigError
from seal_gym.core.frames import tip_rotation, transform
from seal_gym.envs.config import SealCfg
from seal_gym.envs.core import SealCore
from seal_gym.vision.edges import EdgeStage
from seal_gym.vision.features import RoiFeatures, ViewGeometry, oracle_lines, update_features
from seal_gym.vision.perception import GrooveCfg, Perception, PerceptionCfg
from seal_gym.workpieces.seam import seam_in_world
from seal_gym.workpieces.workpiece import Workpiece

FRAME_S = 1 / 30


class Ride:
    """A gun carried along the seam at 10 mm/s with small errors, and what its cameras see."""

    def __init__(self, part, seeds, start):
        self.core = SealCore(SealCfg(workpiece=part, observation="features+images"), len(seeds))
        self.views = ViewGeometry.of(self.core.cfg.cell)
        for i, seed in enumerate(seeds):
            self.core.reset(i, np.random.default_rng(seed))
        self.s0, self.n = start, len(seeds)
        self.phase = np.array(seeds) * 1.7

    def perception(self, n=None, **kwargs):
        nozzle, width = self.core.sensors.nozzle, self.core.scene.workpiece.groove_width
        return Perception(
            n or self.n,
            self.views,
            nozzle,
            FRAME_S,
            PerceptionCfg(**kwargs),
            plate=self.core._start[2, :3] if width else None,
            groove=GrooveCfg(width_m=width, depth_m=width) if width else None,
        )

    def frame(self, k):
        """Images, tip poses and the oracle's lines of a frame."""
        seam, s = self.core._seam, self.s0 + 0.01 * k * FRAME_S
        at = seam.at(s)
        nominal = transform(tip_rotation(at.tangent, at.approach), at.position + 0.003 * at.approach)
        poses = []
        for part, phase in zip(self.core.arm.part_pose, self.phase, strict=True):
            wave = 3e-4 * np.array([np.sin(phase + 0.1 * k), 0.0, np.cos(phase + 0.07 * k)])
            poses.append(part @ nominal @ transform(np.eye(3), wave))
        tips = np.array(poses)
        images = self.core.sensors.images(tips, self.core.arm, np.full(self.n, k))
        point, tangent = seam_in_world(seam, np.full(self.n, s), self.core.arm.part_pose)
        return images, tips, oracle_lines(point, tangent, tips, self.views)

    def errors(self, lines, truth):
        """d_px and theta_px of both views against the truth, deg."""
        out = []
        for each in (lines, truth):
            features = RoiFeatures.zeros(self.n)
            update_features(features, each, self.views)
            assert features.valid.all()
            out.append(np.concatenate((features.d_px, np.degrees(features.theta_px_rad)), axis=1))
        return out[0] - out[1]


def run(ride, frames, **kwargs):
    eyes, errors = ride.perception(**kwargs), []
    for k in range(frames):
        images, tips, truth = ride.frame(k)
        errors.append(ride.errors(eyes.update(images.front, images.side, tips), truth))
    return np.array(errors)


@pytest.mark.parametrize("part", ["flat", "cylinder", "rectangular"])
def test_straights_and_wide_bends_within_the_targets(part):
    error = run(Ride(part, range(6), 0.04), 60)[20:]
    rms = np.sqrt((error**2).mean(axis=(0, 1)))
    assert (rms[:2] <= 0.2).all() and (rms[2:] <= 0.6).all()


def test_a_corner_within_the_targets():
    """From 10 mm before the corner's middle to 10 mm behind."""
    error = run(Ride("rectangular", range(6), 0.095), 87)[27:]
    rms = np.sqrt((error**2).mean(axis=(0, 1)))
    assert (rms[:2] <= 0.3).all() and (rms[2:] <= 2.0).all()


def groove(points, lean_deg=0.0, width=2e-3):
    lean = np.deg2rad(lean_deg)
    approach = np.array([0.0, -np.sin(lean), np.cos(lean)])  # right of a travel along x
    return Workpiece.from_polyline(points, approach, joint="groove", groove_width=width)


LINE = np.array([[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0]])
ARC = np.linspace(-1.0, 1.0, 61)
BEND = 0.06 * np.column_stack((np.sin(ARC), 1.0 - np.cos(ARC), 0 * ARC))


@pytest.mark.parametrize(
    "part",
    [
        groove(LINE),
        groove(LINE, 20.0),
        groove(LINE, -20.0),
        groove(LINE, width=3e-3),
        groove(BEND),
    ],
    ids=["upright", "leaning to the right", "leaning to the left", "wide", "bend"],
)
def test_the_middle_of_a_groove_within_the_targets(part):
    """Its banks are 3 px and more off the middle."""
    error = run(Ride(part, range(4), 0.04), 50)[20:]
    rms = np.sqrt((error**2).mean(axis=(0, 1)))
    assert (rms[:2] <= 0.2).all() and (rms[2:] <= 0.6).all()


def test_a_fine_groove_within_the_targets_where_it_is_seen():
    """It is 1.5 px wide, and where the gun sways it comes under the nozzle in the side view."""
    ride = Ride(groove(LINE, width=5e-4), range(4), 0.04)
    eyes, errors = ride.perception(), []
    for k in range(50):
        images, tips, truth = ride.frame(k)
        lines = eyes.update(images.front, images.side, tips)
        if k >= 20 and lines.valid.all():
            errors.append(ride.errors(lines, truth))
    assert len(errors) >= 25
    rms = np.sqrt((np.array(errors) ** 2).mean(axis=(0, 1)))
    assert (rms[:2] <= 0.2).all() and (rms[2:] <= 0.6).all()


def test_rows_never_mix_and_runs_repeat():
    seeds = [3, 4, 5, 6, 7, 8, 9, 10]
    ride = Ride("cylinder", seeds, 0.05)
    many, again = ride.perception(), ride.perception()
    single = [ride.perception(1) for _ in seeds]
    for k in range(12):
        images, tips, _ = ride.frame(k)
        lines, repeated = (
            many.update(images.front, images.side, tips),
            again.update(images.front, images.side, tips),
        )
        for a, b in zip(lines, repeated, strict=True):
            np.testing.assert_array_equal(a, b)
        for i, eyes in enumerate(single):
            one = eyes.update(images.front[i : i + 1], images.side[i : i + 1], tips[i : i + 1])
            for a, b in zip(lines, one, strict=True):
                np.testing.assert_array_equal(a[i], b[0])


def test_threads_and_the_stage_as_a_detector_change_nothing():
    ride = Ride("rectangular", range(5), 0.09)
    nozzle = ride.core.sensors.nozzle
    eyes = [
        ride.perception(),
        Perception(5, ride.views, nozzle, FRAME_S, threads=3),
        Perception(5, ride.views, nozzle, FRAME_S, detector=EdgeStage()),
    ]
    for k in range(10):
        images, tips, _ = ride.frame(k)
        lines = [e.update(images.front, images.side, tips) for e in eyes]
        for other in lines[1:]:
            for a, b in zip(lines[0], other, strict=True):
                np.testing.assert_array_equal(a, b)


def test_only_rows_with_a_new_frame_look():
    ride = Ride("flat", [1, 2], 0.05)
    eyes, twin = ride.perception(), ride.perception(1)
    images, tips, _ = ride.frame(0)
    first = eyes.update(images.front, images.side, tips)
    twin.update(images.front[:1], images.side[:1], tips[:1])
    later, tips, _ = ride.frame(5)
    second = eyes.update(later.front, later.side, tips, np.array([True, False]))
    alone = twin.update(later.front[:1], later.side[:1], tips[:1])
    for a, b, c in zip(first, second, alone, strict=True):
        np.testing.assert_array_equal(a[1], b[1])
        np.testing.assert_array_equal(b[0], c[0])


@pytest.mark.parametrize("view", [0, 1])
def test_lost_frames_coast_for_a_while_and_are_then_invalid(view):
    ride = Ride("cylinder", [1, 2, 3], 0.05)
    eyes, valid = ride.perception(), []
    for k in range(45):
        images, tips, truth = ride.frame(k)
        pictures = [images.front.copy(), images.side.copy()]
        if 15 <= k < 30:
            pictures[view][:] = 130
        lines = eyes.update(*pictures, tips)
        valid.append(lines.valid.all())
        if 15 <= k < 24:  # 0.3 s
            assert lines.valid.all()
            assert np.abs(ride.errors(lines, truth)[:, :2]).max() < 2.5  # 3 mm on a radius of 70 mm
        elif 24 <= k < 30:
            assert not lines.valid[:, view].any() and lines.valid[:, 1 - view].all()
    assert all(valid[:24]) and all(valid[31:])
    assert np.abs(ride.errors(lines, truth)[:, :2]).max() < 0.6


def test_a_seam_that_was_never_seen_is_invalid_and_harmless():
    ride = Ride("flat", [1], 0.05)
    eyes = ride.perception()
    _, tips, _ = ride.frame(0)
    rng = np.random.default_rng(0)
    for level in (0, 100, 255):
        for sigma in (0, 8):
            front = np.clip(rng.normal(level, sigma, (1, 100, 50, 1)), 0, 255).astype(np.uint8).repeat(3, 3)
            side = np.clip(rng.normal(level, sigma, (1, 50, 100, 1)), 0, 255).astype(np.uint8).repeat(3, 3)
            lines = eyes.update(front, side, tips)
            assert not lines.valid.any()
            assert np.isfinite(lines.point).all() and np.isfinite(lines.direction).all()


def test_a_reset_forgets_everything():
    ride = Ride("rectangular", [1], 0.05)
    used, new = ride.perception(), ride.perception()
    for k in range(8):
        images, tips, _ = ride.frame(k)
        used.update(images.front, images.side, tips)
    used.reset(0)
    for k in range(20, 24):
        images, tips, _ = ride.frame(k)
        a, b = used.update(images.front, images.side, tips), new.update(images.front, images.side, tips)
        for x, y in zip(a, b, strict=True):
            np.testing.assert_array_equal(x, y)


def test_a_part_that_is_shoved_is_found_again():
    ride = Ride("flat", [1, 2, 3], 0.05)
    eyes = ride.perception()
    for k in range(30):
        if k == 15:
            ride.core.arm.part_pose[:, :2, 3] += 6e-4
        images, tips, truth = ride.frame(k)
        # The gun follows the part in this ride: only the world's seam jumps.
        lines = eyes.update(images.front, images.side, tips)
    assert np.abs(ride.errors(lines, truth)[:, :2]).max() < 0.5


@pytest.mark.parametrize("name", ["coast_s", "memory_s", "sigma_m", "gate"])
def test_bad_parameters_are_refused(name):
    with pytest.raises(ConfigError, match=name):
        PerceptionCfg(**{name: 0.0})


def test_views_of_other_shapes_are_refused():
    ride = Ride("flat", [1], 0.05)
    odd = ride.views._replace(size=np.array([[50.0, 100.0], [90.0, 50.0]]))
    with pytest.raises(ConfigError, match="ROIs"):
        Perception(1, odd, ride.core.sensors.nozzle, FRAME_S)


@pytest.mark.parametrize("part", ["flat", "cylinder"])
def test_the_memory_follows_a_part_that_moves(part):
    """At 10 mm/s, in any direction; without following, the seam is off by 0.6 px and 5 deg."""
    ride = Ride(part, range(6), 0.05)
    base, eyes, errors = ride.core.arm.part_pose.copy(), ride.perception(), []
    phase = np.arange(6) * 1.05
    for k in range(75):
        ride.core.arm.part_pose[:, 0, 3] = base[:, 0, 3] + 0.02 * np.sin(0.5 * k * FRAME_S + phase)
        ride.core.arm.part_pose[:, 1, 3] = base[:, 1, 3] + 0.02 * np.cos(0.5 * k * FRAME_S + phase)
        images, tips, truth = ride.frame(k)
        errors.append(ride.errors(eyes.update(images.front, images.side, tips), truth))
    rms = np.sqrt((np.array(errors[25:]) ** 2).mean(axis=(0, 1)))
    assert (rms[:2] <= 0.3).all() and (rms[2:] <= 2.0).all()
