"""Reconstruction: occlusion, lenses, exposures, mixed pixels, normals, files, and lengths of boards."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import binom
from shared import DATA

from lrfcal_lib.calibrate import cloud as clouds
from lrfcal_lib.calibrate.mixed import mixed
from lrfcal_lib.calibrate.painting import Painter, View
from lrfcal_lib.calibrate.reconstruct import GREY, reconstruct
from lrfcal_lib.measure.cloud_files import write_pcd
from lrfcal_lib.measure.features import flatness, largest_plane
from lrfcal_lib.model.camera import CameraModel, fold, project
from lrfcal_lib.model.kinematics import AS_RECORDED, MIRROR_TURN
from lrfcal_lib.session.read import Sweep, open_session
from lrfcal_lib.session.stated import LrfInfo
from lrfcal_lib.simulate import beam
from lrfcal_lib.simulate.record import placements_of, stops_of, world_of
from lrfcal_lib.simulate.rig import load_setup
from lrfcal_lib.simulate.scene import World

MODEL = CameraModel(64, 48, 50.0, 50.0, 31.5, 23.5)
WIDE = CameraModel(
    64, 48, 22.0, 22.0, 31.5, 23.5, np.array([-0.25, 0.02, 0.0, 0.0, 0.0])
)  # 110 deg, folds
STILL = RigidTransform.identity()
AHEAD = RigidTransform.from_rotation(
    Rotation.from_matrix([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
)  # looks along y
STEP = np.radians(0.25)
BEARINGS = np.radians(np.arange(60, 120.1, 0.25))
PITCH = np.radians(np.arange(-6, 6.1, 0.25))
LRF = LrfInfo(
    "made up",
    (BEARINGS[0], BEARINGS[-1]),
    STEP,
    0.005,
    spot_exit=0.016,
    spot_divergence=0.0119,
)


def view(image, model=MODEL, pose=STILL, number=0, camera="left"):
    return View(number, camera, pose, model, np.asarray(image, np.uint8))


def plain_image(level=90):
    return np.full((48, 64, 3), level)


def grid(z, half=0.2, n=40):
    x, y = np.meshgrid(np.linspace(-half, half, n), np.linspace(-half, half, n))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z)])


def paint(points, *views, step=0.04, noise=0.03):
    painter = Painter(views, step, noise)
    painter.hide(points)
    return painter.paint(points, np.tile([0.0, 0.0, -1.0], (len(points), 1)))


def plainly(points, normals, seen_from, step, noise):
    """What the compiled loops do, in NumPy, for one view."""
    model = seen_from.model
    p = seen_from.T_camera_platform.apply(points)
    uv = project(p, model)
    distance = np.linalg.norm(p, axis=1)
    cell = max(2.0, 2 * step * model.fx)
    inside = np.all((uv >= -0.5) & (uv < [model.width - 0.5, model.height - 0.5]), axis=1)
    inside &= (p[:, :2] ** 2).sum(axis=1) < fold(model) * p[:, 2] ** 2
    index = (np.where(inside[:, None], uv + 0.5, 0) // cell).astype(int) @ [1, 1000]
    nearest = np.full(100_000, np.inf)
    np.minimum.at(nearest, index[inside], distance[inside])
    cosine = np.clip(
        np.abs(np.sum(seen_from.T_camera_platform.rotation.apply(normals) * p, axis=1))
        / distance,
        0.1,
        1,
    )
    slack = noise + cell / model.fx * distance * np.sqrt(1 - cosine**2) / cosine
    seen = inside & (distance <= nearest[index] + slack)
    u, v = np.clip(uv[seen], 0, [model.width - 1, model.height - 1]).T
    i = np.minimum(v.astype(int), model.height - 2)
    j = np.minimum(u.astype(int), model.width - 2)
    f = (u - j)[:, None]
    g = (v - i)[:, None]
    image = seen_from.image.astype(float)
    top = image[i, j] * (1 - f) + image[i, j + 1] * f
    low = image[i + 1, j] * (1 - f) + image[i + 1, j + 1] * f
    return seen, (top * (1 - g) + low * g)[:, ::-1]


@pytest.mark.parametrize("model", [MODEL, WIDE])
def test_compiled_loops_do_what_plain_numpy_does(model):
    rng = np.random.default_rng(3)
    points = (
        rng.uniform([-2, -2, -1], [2, 2, 4], (20_000, 3)).astype(np.float32).astype(float)
    )
    normals = rng.normal(size=points.shape).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    turned = RigidTransform.from_rotation(Rotation.from_rotvec([0.1, 0.2, 0]))
    one = view(rng.integers(10, 240, (48, 64, 3)), model, turned)
    painter = Painter([one], 0.02, 0.03)
    painter.hide(points)
    colors, seen, source = painter.paint(points, normals)
    expected, their_colors = plainly(points, normals, one, 0.02, 0.03)
    assert (seen != expected).sum() <= 2  # a rounding at the border of a cell
    both = seen[expected]
    np.testing.assert_allclose(colors[expected][both], their_colors[both], atol=0.01)
    assert (
        (source[seen] == 0).all()
        and (source[~seen] == -1).all()
        and 500 < seen.sum() < 15_000
    )


def test_exposures_are_compared_and_taken_off():
    rng = np.random.default_rng(0)
    points = grid(1.0, 0.25, 60)
    base = np.repeat(
        rng.uniform(60, 90, (6, 8)).repeat(8, 0).repeat(8, 1)[..., None], 3, -1
    )
    v, u = np.mgrid[:48, :64]
    fall = 1 - 0.2 * ((u - 31.5) ** 2 + (v - 23.5) ** 2)[..., None] / (
        0.25 * (48**2 + 64**2)
    )
    shifts = np.array([[0, 0], [0.2, 0.05], [-0.2, 0.1], [0.1, -0.1]])
    views = []
    for k, ((x, y), gain) in enumerate(zip(shifts, (1.0, 1.5, 0.7, 2.0), strict=True)):
        at = np.roll(base, np.rint([50 * y, 50 * x]).astype(int), (0, 1))
        views.append(
            view(
                np.rint(at * fall * gain),
                pose=RigidTransform.from_translation([x, y, 0]),
                number=k,
            )
        )
    painter = Painter(views, 0.02, 0.03)
    ahead = np.tile([0.0, 0, -1], (len(points), 1))
    painter.hide(points)
    painter.compare_exposures(points, ahead)
    gains = np.exp(painter.exposures[:, 0])
    np.testing.assert_allclose(gains / gains[0], [1.0, 1.5, 0.7, 2.0], rtol=0.03)
    assert painter.exposures[0, 1] == pytest.approx(-0.21, abs=0.05)


def scan(surface, spot=True, seed=0):
    """A sweep of ``surface(direction) -> metres`` by a sensor at the origin: its noise-free and noisy Sweep."""
    offsets = np.linspace(-1, 1, 15) if spot else np.zeros(1)
    weights = np.sqrt(np.maximum(1 - offsets**2, 1e-3))
    bearing, pitch = np.meshgrid(BEARINGS, PITCH)
    radius = 0.5 * (0.016 / 2 + 0.0119)  # of the spot at two metres
    clean = (
        sum(
            w * surface(bearing + o * radius, pitch)
            for o, w in zip(offsets, weights, strict=True)
        )
        / weights.sum()
    )
    noisy = clean + np.random.default_rng(seed).normal(0, LRF.sigma_range, clean.shape)
    return [
        Sweep(1, ranges, BEARINGS, PITCH, np.arange(len(PITCH)) * 0.5)
        for ranges in (clean, noisy)
    ]


def wall(distance):
    return lambda bearing, pitch: distance / (np.sin(bearing) * np.cos(pitch))


def step_edge(bearing, pitch):
    """A wall at 1.8 m to the right, one at 2.3 m to the left."""
    return np.where(
        bearing < np.radians(90.1), wall(1.8)(bearing, pitch), wall(2.3)(bearing, pitch)
    )


def whole(sweep, views=(), **options):
    return clouds.join(reconstruct(sweep, views, STILL, AS_RECORDED, lrf=LRF, **options))


def test_mixed_pixels_go_and_sound_points_stay():
    clean, noisy = scan(step_edge)
    y = clean.ranges * np.sin(BEARINGS) * np.cos(PITCH)[:, None]
    air = np.minimum(np.abs(y - 1.8), np.abs(y - 2.3))
    gone = mixed(noisy.ranges, (STEP, STEP), LRF)
    assert (gone[air > 0.03] > 0).mean() > 0.8 and (gone[air < 0.003] > 0).mean() < 0.01
    flagged = (gone > 0) & (air > 0.03)
    assert (
        np.abs((noisy.ranges - gone)[flagged] - 1.8).mean() < 0.1
    )  # they hide from about where the nearer one is
    cloud = whole(noisy)
    assert (
        cloud.removed == (gone > 0).sum()
        and len(cloud.points) + cloud.removed == noisy.ranges.size
    )


def spots_alone(setup, placement, lines):
    """How far ideal readings (l, b) of a room are from any place their spot meets, and from one thing's reading alone.

    The second is how far the other things in the spot pull the reading, at least. Metres, NaN where nothing came back.
    """
    spots = []
    hits = []
    world = world_of(setup, placement)
    plain = beam.echo
    pitch = stops_of(setup, placement)[1].true[lines]
    bearings, pitch = np.broadcast_arrays(setup.rig.beam.bearings(), pitch[:, None])
    world.cast = lambda *rays: hits.append(World.cast(world, *rays)) or hits[-1]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(beam, "echo", lambda *spot: spots.append(spot[1:]) or plain(*spot))
        ideal = beam.ideal_readings(
            setup.rig.beam, world, bearings.ravel(), pitch.ravel(), setup.rig.T_head_lrf
        )[0]
    (distance, energy), thing = spots[0], hits[0].thing.reshape(spots[0][0].shape)
    energy = np.where(np.isfinite(distance), energy, 0.0)
    distance = np.where(np.isfinite(distance), distance, np.inf)
    off = np.abs(distance - ideal[:, None]).min(axis=1)
    pull = np.full(len(ideal), np.inf)
    things = np.unique(thing)
    for each in things[things >= 0]:
        weight = energy * (thing == each)
        some = np.flatnonzero(weight.any(axis=1))
        alone = np.average(
            np.where(weight[some] > 0, distance[some], 0.0), axis=1, weights=weight[some]
        )
        pull[some] = np.fmin(pull[some], np.abs(alone - ideal[some]))
    return off.reshape(bearings.shape), pull.reshape(bearings.shape)


def test_mixed_pixels_of_a_furnished_room():
    """A reading is mixed if it hangs more than 5 sigma off every place its spot meets: a point where nothing is.

    It is good if it is within one sigma of such a place and of what one of the things would have read alone: neither
    noise nor a second surface made it. In between, nobody minds whether a reading goes.
    """
    setup = load_setup("sim_lms221")
    lines = slice(None, None, 3)
    placement = placements_of(setup)[-1]
    session = open_session(DATA / "sim_lms221")
    sweep = session.sweep(placement.number)
    sigma = setup.rig.beam.sigma_range
    off, pull = spots_alone(setup, placement, lines)
    gone = mixed(sweep.ranges, (STEP, STEP), session.lrf)[lines] > 0
    there = np.isfinite(sweep.ranges[lines])
    bad = there & (off > 5 * sigma)
    good = there & (off < sigma) & (pull < sigma)
    assert bad.sum() > 800 and good.sum() > 25_000
    assert gone[bad].mean() > 0.95 and gone[good].mean() < 0.01


def test_a_plain_wall_loses_next_to_nothing_and_a_pinpoint_sensor_nothing():
    _, noisy = scan(wall(2.0))
    assert whole(noisy).removed < 0.001 * noisy.ranges.size
    _, edge = scan(step_edge)
    for stated in ({"spot_divergence": None}, {}):
        info = replace(LRF, spot_exit=None, **stated)
        cloud = clouds.join(reconstruct(edge, (), STILL, AS_RECORDED, lrf=info))
        assert cloud.removed == 0


def test_normals_point_to_the_sensor_up_to_the_edge():
    cloud = whole(scan(step_edge)[1])
    off = np.degrees(np.arccos(np.clip(-cloud.normals[:, 1], -1, 1)))
    assert np.median(off) < 2.5 and np.quantile(off, 0.98) < 10


def test_blocks_are_the_whole(monkeypatch, tmp_path):
    _, noisy = scan(step_edge)
    views = [view(plain_image(), pose=AHEAD), view(plain_image(140), pose=AHEAD, number=1)]
    at_once = whole(noisy, views)
    monkeypatch.setattr("lrfcal_lib.calibrate.reconstruct.BLOCK", 9 * len(BEARINGS))
    monkeypatch.setattr("lrfcal_lib.calibrate.reconstruct.KEPT", 36 * len(BEARINGS))
    blocks = list(reconstruct(noisy, views, STILL, AS_RECORDED, lrf=LRF))
    assert len(blocks) == 6
    for name in clouds.COLUMNS:
        np.testing.assert_allclose(
            getattr(clouds.join(blocks), name),
            getattr(at_once, name),
            atol=1e-6,
            err_msg=name,
        )
    assert clouds.write_ply(tmp_path / "blocks.ply", iter(blocks)) == len(at_once.points)
    clouds.write_ply(tmp_path / "whole.ply", [clouds.join(blocks)])
    assert (tmp_path / "blocks.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()


def test_what_no_image_saw_is_flagged_and_points_tell_where_they_come_from():
    _, noisy = scan(step_edge)
    noisy = replace(noisy, intensities=np.full(noisy.ranges.shape, 7.0))
    cloud = whole(noisy, [view(plain_image(), pose=AHEAD, number=5)])
    assert 0.2 < cloud.seen.mean() < 1 and (cloud.colors[~cloud.seen] == GREY).all()
    assert set(np.unique(cloud.image)) == {-1, 5} and (cloud.intensity == 7).all()
    back = (
        np.stack([np.cos(cloud.bearing), np.sin(cloud.bearing)], -1) * cloud.range[:, None]
    )
    np.testing.assert_allclose(cloud.points[:, 0], back[:, 0], atol=1e-9)
    np.testing.assert_allclose(
        cloud.points[:, 2], back[:, 1] * np.sin(cloud.pitch), atol=1e-9
    )


def test_a_moving_head_has_a_pitch_for_every_beam():
    _, noisy = scan(wall(2.0), spot=False)
    still = whole(noisy)
    moving = whole(noisy, continuous=True)
    rise = np.arctan2(moving.points[:, 2], moving.points[:, 1]) - np.arctan2(
        still.points[:, 2], still.points[:, 1]
    )
    rate = STEP / 0.5
    turn = MIRROR_TURN
    assert (
        np.abs(rise).max() < rate * 6 * turn
        and np.abs(rise[still.bearing == BEARINGS[120]]).max() < 1e-9
    )
    later = (
        (BEARINGS[124] - BEARINGS[120]) / (2 * np.pi) * turn
    )  # a degree on: the same turn of the mirror
    np.testing.assert_allclose(
        rise[still.bearing == BEARINGS[124]], rate * later, rtol=1e-6
    )


BAD = {
    "an empty sweep": (
        lambda s: replace(s, ranges=s.ranges * np.nan),
        "placement 1: an empty sweep .49 scan lines",
    ),
    "the sweep of another LRF": (
        lambda s: replace(s, bearings=s.bearings - 0.5),
        "bearings 31.35 to 91.35 deg, 'made up' sees 60.0 to 120.0 deg",
    ),
    "no scan line": (
        lambda s: replace(s, ranges=s.ranges[:0], pitch=s.pitch[:0]),
        "an empty sweep .0 scan lines",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_sweeps_are_refused(case):
    change, words = BAD[case]
    with pytest.raises(ValueError, match=words):
        whole(change(scan(wall(2.0))[1]))


def test_an_image_of_another_size_is_refused():
    with pytest.raises(
        ValueError, match="camera 'left' has 64 x 48 pixels, its image 32 x 24"
    ):
        view(np.zeros((24, 32, 3)))


def test_files_hold_everything_and_say_frame_and_units(tmp_path):
    import open3d as o3d

    cloud = whole(scan(step_edge)[1], [view(plain_image(), pose=AHEAD)])
    clouds.write_ply(tmp_path / "deep" / "c.ply", [cloud], ["session made up"])
    head = (tmp_path / "deep" / "c.ply").read_bytes().split(b"end_header")[0].decode()
    assert all(f"comment {words}" in head for words in (*clouds.ABOUT, "session made up"))
    write_pcd(tmp_path / "c.pcd", tmp_path / "deep" / "c.ply")
    for file in ("deep/c.ply", "c.pcd"):
        back = o3d.t.io.read_point_cloud(str(tmp_path / file))
        np.testing.assert_allclose(back.point.positions.numpy(), cloud.points, atol=1e-6)
        np.testing.assert_allclose(back.point.normals.numpy(), cloud.normals, atol=1e-6)
        assert (back.point.colors.numpy() == cloud.colors).all()
        for name in (
            "seen",
            "placement",
            "image",
            "pitch",
            "bearing",
            "range",
            "intensity",
            "sigma",
        ):
            values = back.point[name].numpy().ravel()
            np.testing.assert_allclose(
                values, getattr(cloud, name), rtol=1e-6, err_msg=name
            )


@pytest.mark.parametrize("number", range(3))
def test_real_sweeps_are_the_published_clouds(real_data, number):
    """A pitching SICK in a corridor (3DTK's kurt3d): points to 0.1 mm, and its largest surface is flat to 10 mm."""
    if not (real_data / "kurt3d").is_dir():
        pytest.skip(f"no kurt3d in {real_data}")
    raw = np.load(real_data / "kurt3d" / f"raw{number:03d}.npz")
    ranges = np.where(raw["range_cm"] < 3000, raw["range_cm"].astype(float) / 100, np.nan)
    bearings = np.radians(raw["beam_deg"])
    pitch = np.radians(raw["tilt_deg"])
    lrf = LrfInfo("SICK", (bearings[0], bearings[-1]), bearings[1] - bearings[0], 0.01)
    sweep = Sweep(1, ranges, bearings, pitch, np.arange(len(pitch)) * 0.1)
    cloud = clouds.join(reconstruct(sweep, (), STILL, AS_RECORDED, lrf=lrf))
    published = (
        np.loadtxt(real_data / "kurt3d" / f"scan{number:03d}.3d")[
            np.isfinite(ranges).ravel()
        ]
        / 100
    )
    miss = np.linalg.norm(cloud.points - published[:, [0, 2, 1]] * [1, 1, -1], axis=1)
    assert miss.max() < 1e-4 and np.median(miss) < 1e-5
    surface = largest_plane(cloud)
    assert surface.sum() > 10_000 and 0.001 < flatness(cloud.points[surface])[1] < 0.010


@pytest.mark.parametrize(
    ("session", "least", "limit"), [("sim_lms221", 72, 0.7), ("lms400_zed", 60, 4.5)]
)
def test_combined_lengths_of_left_out_placements_keep_their_promise(session, least, limit):
    """In the stored tables (tests/golden), which the notebooks' own test compares."""
    table = pd.read_csv(
        Path(__file__).parent / "golden" / session / "edge_summary.csv"
    ).set_index(["variant", "ends"])
    found = table.loc["combined", "image"]
    assert found.n >= least and found.mean_abs_error_mm <= limit
    low, high = binom.ppf([0.001, 0.999], found.n, 0.9)  # 78 to 99 % of 72
    assert low <= found.within_90_percent * found.n / 100 <= high
