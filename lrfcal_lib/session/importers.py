"""Other people's recordings as sessions."""

import re
from os import PathLike
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.model.board import Board, Chessboard
from lrfcal_lib.model.camera import INTRINSIC_NAMES
from lrfcal_lib.model.geometry import (
    length_of,
    lrf_to_platform,
    polar_to_points,
)
from lrfcal_lib.session.files import (
    LARGEST_TEXT,
    SessionError,
    check_amount,
    naming,
    read_bytes,
    reading,
    short,
)
from lrfcal_lib.session.images import image_size
from lrfcal_lib.session.stated import CameraInfo, LrfInfo, transform_to_json
from lrfcal_lib.session.write import SessionWriter

# LaserSeteroCalibration (https://github.com/suijingfeng/LaserSeteroCalibration), folder
# ZED_STEREO_LASER_SWEEP. The authors' platform: pitch axis along x through (y = 0, z = 0.2 m) of
# their cloud frame; at the angle p = 90 deg the LRF looks along +y. Ours is the same platform with
# the origin on the axis and pitch = p - 90 deg.
LASERSETERO_HEAD = RigidTransform.from_translation([-0.038, 0.0045, 0.157])
LASERSETERO_CLOUD = RigidTransform.from_translation([0.0, 0.0, 0.2])  # T_cloud_platform
# The authors state dimensions to half a millimetre, and axis and scan plane parallel: assumed of
# bolted plates.
LASERSETERO_PLATFORM_SIGMA = (np.radians(0.1), 0.005)
# the LMS400 sees 70 deg: from the first to the last of these steps
STEP_DEG = 0.1
FIRST = 550
LAST = 1250
BEARINGS = np.radians(STEP_DEG * np.arange(FIRST, LAST + 1))
COUNT = 0.001  # metres, one count of the LMS400
LRF = LrfInfo(
    model="SICK LMS400",
    field_of_view=(BEARINGS[0], BEARINGS[-1]),
    bearing_step=np.radians(STEP_DEG),
    sigma_range=0.005,
    range_resolution=COUNT,
    max_range=3.0,
)
BOARD = Board(
    "chessboard 9 x 7",
    edges=("top", "right", "bottom", "left"),
    corners=None,
    pattern=Chessboard(columns=8, rows=6, square=0.0775),
    features=("left", "top"),
)
# the authors' result is printed with four digits, so made orthonormal again
T_LEFT_CLOUD = RigidTransform.from_components(
    [0.1169, -0.0500, -0.2737],
    Rotation.from_matrix(
        [[0.9990, -0.0431, 0.0149], [0.0157, 0.0168, -0.9997], [0.0429, 0.9989, 0.0175]]
    ),
)
SOURCE = (
    "LaserSeteroCalibration, ZED_STEREO_LASER_SWEEP "
    "(github.com/suijingfeng/LaserSeteroCalibration)"
)
NOTE = (
    "p_cloud = T_cloud_platform p_platform; the authors' pitch p is ours + 90 deg, their bearing b "
    "is 90 deg - ours. "
    "T_left_platform is the authors' optimum (6.7 mm rms over the boards' planes)."
)
# radians of pitch between points of two scan lines; rounding to a micrometre makes less than 1e-5
LINE_JUMP = 1e-4
# metres between published points and those rebuilt from what was recovered
LARGEST_MISS = 1e-5
# of a Calib_Results.m, and how many numbers each has: focal lengths, principal point, lens
KEYS = {"fc": 2, "cc": 2, "kc": 5}


def import_lasersetero(src: str | PathLike, dst: str | PathLike) -> float:
    """Make a session of the public LMS400 + ZED recording.

    The intrinsics stay open, so that they are estimated from the session's images; the published
    ones are kept in the session's reference.

    Parameters
    ----------
    src
        Folder with ``plane_NN.pcd``, ``left_NN.png``, ``right_NN.png`` and
        ``Calib_Results_{left,right}.m``.
    dst
        The session's.

    Returns
    -------
    float
        Metres between the published points and those rebuilt from range, bearing and pitch, at
        most.

    Raises
    ------
    SessionError
        For missing or truncated files, an existing target, or if rebuilding misses by more than
        0.01 mm.
    """
    clouds = numbered(src, "plane_*.pcd")
    published = {}
    images = {}
    cameras = []
    for name in ("left", "right"):
        published[name] = read_bouguet(Path(src) / f"Calib_Results_{name}.m")
        images[name] = numbered(src, f"{name}_*.png")
        first = next(iter(images[name].values()))
        cameras.append(CameraInfo(name, "platform", *image_size(first, read_bytes(first))))
    misses = []
    values = 0
    with SessionWriter(
        dst,
        BOARD,
        LRF,
        cameras,
        LASERSETERO_HEAD,
        licence="none stated by the authors",
        source=SOURCE,
        reference={
            "note": NOTE,
            "T_cloud_platform": transform_to_json(LASERSETERO_CLOUD),
            "T_left_platform": transform_to_json(T_LEFT_CLOUD * LASERSETERO_CLOUD),
            "cameras": published,
        },
        platform_sigma=LASERSETERO_PLATFORM_SIGMA,
    ) as writer:
        for placement, file in clouds.items():
            with naming(file):
                ranges, pitch, miss = recover_polar(read_pcd(file))
                values += ranges.size
                check_amount(values)
            writer.add_sweep(placement, ranges, BEARINGS, pitch)
            misses.append(miss)
        for name, files in images.items():
            for placement, file in files.items():
                writer.add_image(name, file, placement)
    return max(misses)


def numbered(folder, pattern):
    """Files by the number in their names."""
    files = {}
    for file in sorted(Path(folder).glob(pattern)):
        number = re.search(r"_(\d+)\.", file.name)
        if number:
            files[int(number[1])] = file
    if not files:
        raise SessionError(
            f"{folder}: no {pattern.replace('*', 'NN')}; is this the folder ZED_STEREO_LASER_SWEEP?"
        )
    return files


def recover_polar(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Ranges and pitch that the published points of a LaserSetero cloud were made of.

    Parameters
    ----------
    points
        Authors' cloud frame, metres, in the order of acquisition, shape (n, 3).

    Returns
    -------
    ranges : ndarray, shape (L, B)
        Metres on the sensor's grid of 1 mm at the bearings `BEARINGS`, NaN outside the published
        part.
    pitch : ndarray, shape (L,)
        Radians.
    miss : float
        Largest distance between published and rebuilt points, metres.

    Raises
    ------
    ValueError
        If the rebuilt points miss by more than 0.01 mm, or lie where the LMS400 does not see.

    Notes
    -----
    With n the offset of the scan plane from the axis, S the distance ahead inside it and p the
    authors' angle, ``y + i z = (n - i S) exp(i p)``: the modulus gives S, the argument p. A new
    scan line starts where the bearing restarts or the pitch jumps.
    """
    side, ahead, offset = LASERSETERO_HEAD.translation
    p_platform = LASERSETERO_CLOUD.inv().apply(points)
    x, y, z = p_platform.T
    across = x - side
    along = np.sqrt(np.maximum(y**2 + z**2 - offset**2, 0.0)) - ahead
    ranges = np.round(np.hypot(across, along) / COUNT) * COUNT
    # 0.1 deg, so no .5 to round
    steps = np.round(np.degrees(np.arctan2(along, across)) / STEP_DEG).astype(int)
    if steps.min() < FIRST or steps.max() > LAST:
        raise ValueError(
            f"bearings reach {STEP_DEG * steps.min():.1f} .. "
            f"{STEP_DEG * steps.max():.1f} deg, the LMS400 sees 55 .. 125 deg"
        )
    bearing = BEARINGS[steps - FIRST]
    # Once more with the exact range and bearing: now the pitch carries the rounding of the
    # published points only.
    S = ranges * np.sin(bearing) + ahead
    pitch = np.arctan2(z, y) + np.arctan2(S, offset) - np.pi / 2
    restarts = np.diff(steps) >= 0
    jumps = np.abs(np.diff(pitch)) > LINE_JUMP
    line = np.cumsum(np.r_[True, restarts | jumps]) - 1
    pitch = np.bincount(line, pitch) / np.bincount(line)

    rebuilt = lrf_to_platform(
        polar_to_points(ranges, bearing), pitch[line], LASERSETERO_HEAD
    )
    miss = length_of(rebuilt - p_platform).max()
    if not miss <= LARGEST_MISS:
        raise ValueError(
            f"rebuilding the points misses by {1000 * miss:.4f} mm, more than "
            f"{1000 * LARGEST_MISS:g} mm; not points of this rig?"
        )
    # scan lines of few points are long as well
    check_amount(len(pitch) * len(BEARINGS))
    on_grid = np.full((len(pitch), len(BEARINGS)), np.nan)
    on_grid[line, steps - FIRST] = ranges
    return on_grid, pitch, miss


def source_text(file):
    """Text of somebody else's file."""
    return read_bytes(file, most=LARGEST_TEXT).decode(errors="replace")


def read_pcd(file: str | PathLike) -> np.ndarray:
    """Points (n, 3) of an ASCII PCD file with the fields x y z.

    SessionError for a missing file, other fields, binary data, or fewer points than the header
    states.
    """
    head, _, body = source_text(file).partition("DATA ascii")
    stated = re.search(r"^FIELDS\s+x\s+y\s+z\s*$.*^POINTS (.*?)$", head, re.M | re.S)
    if not body or not stated:
        raise SessionError(f"{file}: expected an ASCII PCD file with the fields x y z")
    with reading(file, "{}; damaged?"):
        points = np.array(body.split(), dtype=float)
        promised = int(stated[1])
    if points.size != 3 * promised or points.size == 0:
        raise SessionError(
            f"{file}: {points.size / 3:g} points, the header states {promised}; truncated?"
        )
    if not np.isfinite(points).all():
        raise SessionError(f"{file}: holds coordinates that are not finite; damaged?")
    return points.reshape(-1, 3)


def read_bouguet(file: str | PathLike) -> dict:
    """Intrinsics of a ``Calib_Results.m`` of Bouguet's toolbox, as JSON has them; SessionError if
    something is missing.
    """
    listed = dict(re.findall(r"^(\w+)\s*=\s*\[([-+.\deE;\s]+)\]", source_text(file), re.M))
    with naming(file):
        values = {
            key: np.array(listed.get(key, "").replace(";", " ").split(), float)
            for key in KEYS
        }
        lacking = [key for key, n in KEYS.items() if len(values[key]) != n]
        if lacking:
            raise ValueError(f"no value of {short(lacking)}; is this a Calib_Results.m?")
        endless = [key for key, array in values.items() if not np.isfinite(array).all()]
        if endless:
            raise ValueError(f"values of {short(endless)} are not finite; damaged?")
    intrinsics = np.concatenate(list(values.values()))
    return {"intrinsics": dict(zip(INTRINSIC_NAMES, intrinsics.tolist(), strict=True))}
