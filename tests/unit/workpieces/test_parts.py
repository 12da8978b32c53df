"""Parts: what a camera sees agrees with what the gun can hit, nothing is inside out, bad input is refused."""

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from seal_gym.core.errors import SeamError
from seal_gym.workpieces import catalogue
from seal_gym.workpieces.mesh import convex_pieces, read_mesh
from seal_gym.workpieces.solids import Solid
from seal_gym.workpieces.surface import PLATE, WALL, Surface
from seal_gym.workpieces.workpiece import Workpiece

Array = NDArray[np.float64]
R = np.sqrt(0.5)
UP = np.array([0.0, 0.0, 1.0])
STRAIGHT = [[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0]]
TO_RIGHT = [0.0, -R, R]


def leaning(points: Array, side: float = 1.0) -> tuple[Array, Array]:
    """Approach directions at 45 deg between floor and wall, the wall on the left (side 1) of travel."""
    u = np.diff(points, axis=0)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    t = np.concatenate((u[:1], u[:-1] + u[1:], u[-1:]))
    right = np.cross(t, [0, 0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    up = np.cross(right, t)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    return points, R * (side * right + up)


def s_curve() -> Workpiece:
    y = np.linspace(-0.1, 0.1, 41)
    points = np.column_stack((0.024 * np.sin(y / 0.1 * np.pi), y, 0 * y))
    return Workpiece.from_polyline(*leaning(points), name="s curve")


def hollow() -> Workpiece:
    points = np.array([[-0.1, -0.08, 0], [0.03, -0.08, 0], [0.03, 0.1, 0]])
    return Workpiece.from_polyline(*leaning(points, -1.0), corner_radius=0.03, name="hollow corner")


def ramp() -> Workpiece:
    y = np.linspace(-0.1, 0.1, 41)
    points = np.column_stack((0 * y, y, 0.01 + 0.008 * np.sin(y / 0.1 * 2.5)))
    return Workpiece.from_polyline(*leaning(points), name="ramp")


def ramp_left() -> Workpiece:
    y = np.linspace(-0.1, 0.1, 41)
    points = np.column_stack((0.01 * np.sin(20 * y), y, 0.01 + 0.008 * np.sin(y / 0.1 * 2.5)))
    return Workpiece.from_polyline(*leaning(points, -1.0), name="ramp, wall on the right")


def groove() -> Workpiece:
    y = np.linspace(-0.1, 0.1, 31)
    points = np.column_stack((0.02 * np.sin(y / 0.1 * np.pi), y, 0 * y))
    return Workpiece.from_polyline(points, [0, 0, 1.0], joint="groove", name="groove")


def closed_groove() -> Workpiece:
    t = np.linspace(-np.pi, np.pi, 73)
    points = 0.05 * np.column_stack((np.cos(t), np.sin(t), 0 * t))
    return Workpiece.from_polyline(points, [0, 0, 1.0], joint="groove", name="closed groove")


def post() -> Workpiece:
    t = np.linspace(-np.pi, np.pi, 73)
    out = np.column_stack((np.cos(t), np.sin(t), 0 * t))
    return Workpiece.from_polyline(0.06 * out, R * (out + UP), name="post")


PARTS: dict[str, Callable[[], Workpiece]] = {
    "flat": catalogue.flat,
    "cylinder": catalogue.cylinder,
    "rectangular": catalogue.rectangular,
    "s_curve": s_curve,
    "hollow": hollow,
    "ramp": ramp,
    "ramp_left": ramp_left,
    "groove": groove,
    "closed_groove": closed_groove,
    "post": post,
}


def first_hit(triangles: Array, origin: Array, direction: Array) -> tuple[Array, Array]:
    """Distance to the first triangle along each ray and its index, by Moeller and Trumbore."""
    a, e1, e2 = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    distance, which = np.full(len(origin), np.inf), np.full(len(origin), -1)
    for k, (o, d) in enumerate(zip(origin, direction, strict=True)):
        h = np.cross(d, e2)
        det = np.sum(e1 * h, axis=1)
        ok = np.abs(det) > 1e-16
        inverse = 1.0 / np.where(ok, det, 1.0)
        u = np.sum((o - a) * h, axis=1) * inverse
        q = np.cross(o - a, e1)
        v, t = q @ d * inverse, np.sum(e2 * q, axis=1) * inverse
        hit = ok & (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (t > 0)
        if hit.any():
            which[k] = np.argmin(np.where(hit, t, np.inf))
            distance[k] = t[which[k]]
    return distance, which


def into_solids(solids: tuple[Solid, ...], origin: Array, direction: Array) -> Array:
    """Distance at which each ray enters the first solid, by clipping it with half spaces."""
    best = np.full(len(origin), np.inf)
    for solid in solids:
        if solid.kind == "box":
            corners = np.array(np.meshgrid(*([-1, 1],) * 3)).reshape(3, -1).T * solid.size
        elif solid.kind == "cylinder":
            t = np.linspace(0, 2 * np.pi, 721)
            foot = solid.size[0] * np.column_stack((np.cos(t), np.sin(t)))
            corners = np.concatenate(
                [np.column_stack((foot, np.full(len(foot), z))) for z in solid.size[1] * np.array([-1, 1])]
            )
        else:
            corners = solid.points
        planes = ConvexHull(corners @ solid.pose[:3, :3].T + solid.pose[:3, 3]).equations
        speed, height = direction @ planes[:, :3].T, origin @ planes[:, :3].T + planes[:, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -height / speed
        enter = np.where(speed < -1e-12, t, -np.inf).max(axis=1)
        leave = np.where(speed > 1e-12, t, np.inf).min(axis=1)
        misses = ((np.abs(speed) <= 1e-12) & (height > 0)).any(axis=1)
        hit = (enter < leave) & ~misses & (enter > 0)
        best = np.where(hit, np.minimum(best, enter), best)
    return best


def rays(part: Workpiece, n: int) -> tuple[Array, Array]:
    """From a dome above the plate to points near the seam."""
    rng = np.random.default_rng(7)
    target = part.seam.at(rng.uniform(0, part.seam.length, n)).position + rng.uniform(-0.03, 0.03, (n, 3))
    direction = rng.normal(size=(n, 3))
    direction[:, 2] = -np.abs(direction[:, 2]) - 0.2
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return target - 0.5 * direction, direction


@pytest.mark.parametrize("name", PARTS)
def test_surface_and_solids_agree_and_faces_look_outward(name: str) -> None:
    part = PARTS[name]()
    origin, direction = rays(part, 400)
    seen, which = first_hit(part.surface.triangles, origin, direction)
    felt = into_solids(part.solids, origin, direction)
    seeing = np.isfinite(seen)
    assert seeing.mean() > 0.9
    facing = np.sum(part.surface.normals[which[seeing]] * direction[seeing], axis=1)
    assert facing.max() < 1e-6, "a ray from outside meets the back of a face"
    np.testing.assert_array_equal(seeing, np.isfinite(felt))
    # Across an edge of the wall a ray may pass one and meet the other, both within 0.1 mm of it; and the
    # camera looks into a groove that the gun cannot enter.
    gap = np.abs(seen[seeing] - felt[seeing])
    if "groove" in name:
        into = part.surface.material[which[seeing]] == WALL
        assert into.any()
        gap = gap[~into]
    assert np.quantile(gap, 0.98) < 2e-4
    assert (gap > 1e-3).mean() < 0.01


@pytest.mark.parametrize("name", PARTS)
def test_no_crack_along_the_seam_and_the_wall_on_the_right_side(name: str) -> None:
    part = PARTS[name]()
    rng = np.random.default_rng(3)
    s = rng.uniform(-0.025, part.seam.length + 0.025, 300)
    p, t, a = part.seam.at(s)
    x = np.cross(t, a)
    offset = rng.choice([-1.0, 1.0], len(s)) * 10 ** rng.uniform(-4.5, -3, len(s))
    if "groove" in name:
        return  # its walls are vertical: the mouth's own axis looks straight down them
    origin = p + 0.004 * a + offset[:, None] * x
    distance, which = first_hit(part.surface.triangles, origin, -a)
    # 45 deg to both faces: the surface lies on the gun's side of the seam by the sideways offset.
    np.testing.assert_allclose(distance, 0.004 - np.abs(offset), atol=4e-5)
    # The tip's x points away from the wall or towards it, whichever side the approach leans to.
    away = np.sign(np.sum(x * [0, 0, -1], axis=1)) * np.sign(offset)
    np.testing.assert_array_equal(part.surface.material[which][away > 0], PLATE)
    np.testing.assert_array_equal(part.surface.material[which][away < 0], WALL)


@pytest.mark.parametrize("make", [groove, closed_groove])
def test_groove_is_open_along_its_whole_length_and_the_plate_has_no_hole(
    make: Callable[[], Workpiece],
) -> None:
    part = make()
    rng = np.random.default_rng(5)
    p, t, _ = part.seam.at(rng.uniform(0, part.seam.length, 300))
    right = np.cross(t, [0, 0, 1.0])
    down = np.tile([0.0, 0.0, -1.0], (300, 1))
    inside, _ = first_hit(
        part.surface.triangles, p + rng.uniform(-9e-4, 9e-4, (300, 1)) * right + [0, 0, 0.01], down
    )
    np.testing.assert_allclose(inside, 0.012, atol=1e-9)
    for side in (-1, 1):
        beside, _ = first_hit(
            part.surface.triangles,
            p + side * rng.uniform(1.1e-3, 8e-3, (300, 1)) * right + [0, 0, 0.01],
            down,
        )
        np.testing.assert_allclose(beside, 0.01, atol=1e-9)


def test_plate_has_sides() -> None:
    part = catalogue.flat()
    origin, direction = np.array([[0.0, -0.5, -0.01]]), np.array([[0.0, 1.0, 0.0]])
    assert first_hit(part.surface.triangles, origin, direction)[0][0] == pytest.approx(0.41)


def test_default_pose_centres_the_seam_in_front_of_the_robot() -> None:
    far = np.array([[1.0, 1.5, 0.0], [1.2, 1.5, 0.0]])
    part = Workpiece.from_polyline(far, TO_RIGHT)
    middle = part.pose[:3, :3] @ far.mean(axis=0) + part.pose[:3, 3]
    np.testing.assert_allclose(middle, [0.45, 0.0, -0.05], atol=1e-12)
    placed = Workpiece.from_polyline(far, TO_RIGHT, pose=(0.1, 0.2, 0.3, np.pi / 2))
    np.testing.assert_allclose(placed.pose[:3, 3], [0.1, 0.2, 0.3])
    np.testing.assert_allclose(placed.pose[:3, 0], [0, 1, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"joint": "butt"}, r"joint = 'butt': must be one of \['fillet', 'groove'\]"),
        ({"wall_height": 0.008}, r"wall_height = 0.008: must be in 0.025..0.04 m"),
        ({"wall_height": 0.08}, r"wall_height = 0.08: must be in 0.025..0.04 m"),
        ({"wall_height": np.nan}, r"wall_height = nan"),
        ({"pose": (0.4, 0, 0)}, r"pose = .*must be 4 finite numbers"),
        ({"pose": (0.4, 0, np.inf, 0)}, r"pose = .*must be 4 finite numbers"),
        ({"corner_radius": -1.0}, r"corner_radius = -1.0: must be a length in m > 0"),
        ({"approach": [0, 0, 1.0]}, r"leans 0.0..0.0 deg.*a fillet needs 35..55 deg"),
        ({"approach": [0, -np.sin(1.1), np.cos(1.1)]}, r"leans 63.0..63.0 deg"),
        ({"points": [[-0.1, 0, -1e-3], [0.1, 0, 0]]}, r"1.\d\d mm below the plate: z must be >= 0"),
        ({"joint": "groove"}, r"leans 45.0 deg: over a groove at most 20 deg"),
        ({"joint": "groove", "groove_width": 0.02}, r"groove_width = 0.02: must be in 0.0005..0.003 m"),
        ({"joint": "groove", "groove_width": 0.0}, r"groove_width = 0.0: must be"),
        (
            {"joint": "groove", "approach": [0, 0, 1.0], "points": [[-0.1, 0, 0.01], [0.1, 0, 0.01]]},
            r"a groove lies in the plate's plane",
        ),
    ],
)
def test_bad_parts_are_refused(options: dict, message: str) -> None:
    arguments = {"points": STRAIGHT, "approach": TO_RIGHT, **options}
    with pytest.raises(SeamError, match=message):
        Workpiece.from_polyline(**arguments)


def test_a_groove_may_lean_by_its_limit() -> None:
    lean = np.deg2rad(20.0)
    y = np.linspace(-0.1, 0.1, 31)
    points, approach = leaning(np.column_stack((0.02 * np.sin(y / 0.1 * np.pi), y, 0 * y)))
    across = approach * [1.0, 1.0, 0.0] / R
    Workpiece.from_polyline(points, np.cos(lean) * UP + np.sin(lean) * across, joint="groove")


def test_unknown_name_lists_the_names() -> None:
    with pytest.raises(SeamError, match=r"'box': must be one of \['flat', 'cylinder', 'rectangular'\]"):
        catalogue.get("box")
    part = s_curve()
    assert catalogue.get(part) is part


def test_surface_is_checked() -> None:
    with pytest.raises(SeamError, match=r"triangles has shape \(0, 3, 3\)"):
        Surface(triangles=np.empty((0, 3, 3)), material=np.empty(0, np.int32))
    with pytest.raises(SeamError, match="not finite"):
        Surface(triangles=np.full((1, 3, 3), np.nan), material=np.zeros(1, np.int32))
    with pytest.raises(SeamError, match=r"material has shape \(2,\): must be \(1,\)"):
        Surface(triangles=np.zeros((1, 3, 3)), material=np.zeros(2, np.int32))


# -- parts from mesh files ------------------------------------------------------------------------------


def box(lower: tuple[float, ...], upper: tuple[float, ...]) -> Array:
    (x0, y0, z0), (x1, y1, z1) = lower, upper
    v = np.array(
        [
            [x0, y0, z0],
            [x1, y0, z0],
            [x1, y1, z0],
            [x0, y1, z0],
            [x0, y0, z1],
            [x1, y0, z1],
            [x1, y1, z1],
            [x0, y1, z1],
        ]
    )
    faces = [[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7], [0, 1, 5], [0, 5, 4]]
    faces += [[1, 2, 6], [1, 6, 5], [2, 3, 7], [2, 7, 6], [3, 0, 4], [3, 4, 7]]
    return v[np.array(faces)]


def extrusion(profile: Array, half_length: float) -> Array:
    """A closed prism along x; profile (y, z) counter-clockwise seen from +x, corner 0 sees all others."""
    n = len(profile)
    ends = [np.column_stack((np.full(n, x), profile)) for x in (-half_length, half_length)]
    fan = np.array([[0, k, k + 1] for k in range(1, n - 1)])
    k, after = np.arange(n), (np.arange(n) + 1) % n
    low, high = ends
    sides = (np.stack((low[k], low[after], high[after]), 1), np.stack((low[k], high[after], high[k]), 1))
    return np.concatenate((high[fan], low[fan[:, ::-1]], *sides))


# Counter-clockwise from the fillet, which sees every corner of this L of plate and wall.
PROFILE = np.array([[0, 0], [0, 0.03], [0.008, 0.03], [0.008, -0.02], [-0.09, -0.02], [-0.09, 0.0]])[::-1]
PROFILE = np.roll(PROFILE, 1, axis=0)


def write_stl(path: Path, triangles: Array) -> Path:
    rows = np.zeros(len(triangles), [("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")])
    rows["v"] = triangles
    path.write_bytes(b" " * 80 + np.uint32(len(rows)).tobytes() + rows.tobytes())
    return path


def write_obj(path: Path, triangles: Array) -> Path:
    vertices, index = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices]
    lines += ["f {} {} {}".format(*face) for face in index.reshape(-1, 3) + 1]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")
    return path


L_OF_TWO_BOXES = np.concatenate(
    (box((-0.2, -0.09, -0.02), (0.2, 0.04, 0)), box((-0.19, 0, 0), (0.19, 0.008, 0.03)))
)
L_IN_ONE = extrusion(PROFILE, 0.2)
SEAM = [[-0.15, 0.0, 0.0], [0.15, 0.0, 0.0]]


def tube(n: int = 48) -> Array:
    """A pipe that stands upright: hollow all round."""
    t = np.linspace(0, 2 * np.pi, n + 1)[:, None]

    def ring(radius: float, z: float) -> Array:
        return np.column_stack((radius * np.cos(t), radius * np.sin(t), 0 * t + z))

    def band(a: Array, b: Array) -> Array:
        return np.concatenate((np.stack((a[:-1], b[:-1], b[1:]), 1), np.stack((a[:-1], b[1:], a[1:]), 1)))

    rings = [ring(0.056, 0.03), ring(0.056, 0.0), ring(0.05, 0.0), ring(0.05, 0.03), ring(0.056, 0.03)]
    return np.concatenate([band(a, b) for a, b in pairwise(rings)])


@pytest.mark.parametrize("triangles", [L_OF_TWO_BOXES, L_IN_ONE, tube()], ids=["boxes", "one", "tube"])
def test_convex_pieces_have_the_surface_of_the_mesh(triangles: Array) -> None:
    pieces = tuple(convex_pieces(triangles))
    rng = np.random.default_rng(11)
    direction = rng.normal(size=(600, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    # From far outside, and from the free space beside the wall or within the tube.
    starts = [
        rng.uniform(low, high, (600, 3)) - direction,
        rng.uniform([-0.15, -0.03, 5e-3], [0.15, -5e-3, 0.02], (600, 3)),
    ]
    if len(triangles) > 100:
        starts[1] = rng.uniform([-0.03, -0.03, 5e-3], [0.03, 0.03, 0.025], (600, 3))
    for origin in starts:
        seen, _ = first_hit(triangles, origin, direction)
        felt = into_solids(pieces, origin, direction)
        np.testing.assert_array_equal(np.isfinite(seen), np.isfinite(felt))
        hit = np.isfinite(seen)
        assert hit.mean() > 0.2
        assert np.abs(seen[hit] - felt[hit]).max() < 1e-4


def test_pieces_are_few_where_the_mesh_is_simple() -> None:
    assert len(convex_pieces(L_OF_TWO_BOXES)) == 2
    assert len(convex_pieces(L_IN_ONE)) <= 6
    assert len(convex_pieces(box((0.0, 0, 0), (1, 1, 1)))) == 1


def test_open_sheet_stays_a_sheet() -> None:
    # Plate and wall without backs: a closed hull of both would fill the fillet.
    sheet = L_OF_TWO_BOXES[[2, 3, 16, 17]]
    pieces = convex_pieces(sheet)
    assert 2 <= len(pieces) <= 4
    for piece in pieces:
        assert np.ptp(piece.points, axis=0).min() < 1e-3


@pytest.mark.parametrize("write", [write_stl, write_obj])
@pytest.mark.parametrize("triangles", [L_OF_TWO_BOXES, L_IN_ONE], ids=["boxes", "one"])
def test_mesh_file_gives_its_triangles(tmp_path: Path, write: Callable[..., Path], triangles: Array) -> None:
    path = write(tmp_path / f"part.{write.__name__[-3:]}", 1e3 * triangles)
    read = read_mesh(path, 1e-3)
    assert len(read) == len(triangles)
    key = np.sort(np.round(read, 6).reshape(len(read), -1).sum(axis=1))
    np.testing.assert_allclose(key, np.sort(triangles.reshape(len(read), -1).sum(axis=1)), atol=1e-5)
    part = Workpiece.from_mesh(path, SEAM, TO_RIGHT, scale=1e-3)
    assert part.name == "part"
    up = part.surface.normals[:, 2] > 0.9
    assert np.all(part.surface.material[up] == PLATE)
    assert np.all(part.surface.material[np.abs(part.surface.normals[:, 2]) < 0.1] == WALL)


def test_inside_out_mesh_is_turned(tmp_path: Path) -> None:
    read = read_mesh(write_stl(tmp_path / "in.stl", L_IN_ONE[:, ::-1]), 1.0)
    volume = np.sum(read[:, 0] * np.cross(read[:, 1], read[:, 2])) / 6
    assert volume == pytest.approx(0.4 * (0.098 * 0.02 + 0.008 * 0.03), rel=1e-4)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("part.step", b"x", r"'part.step' has the type '.step': must be .stl or .obj"),
        ("part.stl", b"", r"mesh file 'part.stl' cannot be used"),
        ("part.stl", b"solid nonsense", r"mesh file 'part.stl' cannot be used"),
        ("part.stl", b" " * 80 + b"\xff\xff\xff\xff" + b"abc", r"mesh file 'part.stl' cannot be used"),
        ("part.obj", b"not a mesh\n", r"mesh file 'part.obj' cannot be used"),
        ("part.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", r"mesh file 'part.obj' cannot be used"),
        ("part.obj", b"v nan 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n", r"mesh file 'part.obj'"),
    ],
)
def test_bad_mesh_files_are_refused(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(SeamError, match=message):
        Workpiece.from_mesh(path, SEAM, TO_RIGHT)


def test_bad_mesh_arguments_are_refused(tmp_path: Path) -> None:
    path = write_stl(tmp_path / "part.stl", 1e3 * L_IN_ONE)
    with pytest.raises(SeamError, match=r"nowhere.stl' not found"):
        Workpiece.from_mesh(tmp_path / "nowhere.stl", SEAM, TO_RIGHT)
    for scale in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(SeamError, match=r"scale = .*must be a number > 0"):
            Workpiece.from_mesh(path, SEAM, TO_RIGHT, scale=scale)
    with pytest.raises(SeamError, match=r"'part.stl' is 400 m across.*check the units \(scale = 1,"):
        Workpiece.from_mesh(path, SEAM, TO_RIGHT)
    with pytest.raises(SeamError, match=r"the seam is 10.0 mm off the mesh"):
        Workpiece.from_mesh(path, np.add(SEAM, [0, -0.05, 0.01]), TO_RIGHT, scale=1e-3)
    with pytest.raises(SeamError, match=r"pose = .*must be 4 finite"):
        Workpiece.from_mesh(path, SEAM, TO_RIGHT, scale=1e-3, pose=(1, 2, 3))


def test_too_many_triangles_are_refused(tmp_path: Path) -> None:
    path = write_stl(tmp_path / "fine.stl", tube(2600))
    with pytest.raises(SeamError, match=r"'fine.stl' has 20800 triangles: at most 20000; export it coarser"):
        read_mesh(path, 1.0)


def test_ascii_stl_and_obj_with_normals_and_relative_indices_are_read(tmp_path: Path) -> None:
    triangle = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0.02]])
    lines = "\n".join(f"vertex {x} {y} {z}" for x, y, z in triangle)
    stl = tmp_path / "ascii.stl"
    stl.write_text(f"solid a\nfacet normal 0 0 1\nouter loop\n{lines}\nendloop\nendfacet\nendsolid a\n")
    obj = tmp_path / "part.obj"
    points = "\n".join(f"v {x} {y} {z}" for x, y, z in triangle)
    obj.write_text(f"{points}\nvn 0 0 1\nf -3//1 -2//1 -1//1\n")
    for path in (stl, obj):
        np.testing.assert_allclose(read_mesh(path, 1.0), triangle[None], atol=1e-7)
