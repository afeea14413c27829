"""Which placement of the board would help a joint estimate most if it were recorded next."""

import re
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.fit.covariance import dyads, sigma_of
from lrfcal_lib.fit.result import AXIS_NAMES
from lrfcal_lib.judge.findings import by_sign
from lrfcal_lib.judge.uncertainty import carried, chain_of
from lrfcal_lib.model.camera import pinhole, project_jacobians
from lrfcal_lib.model.geometry import (
    AHEAD,
    DegenerateGeometry,
    apply_pose,
    carry,
    length_of,
    pose_array,
    pose_transform,
)
from lrfcal_lib.model.kinematics import beams_to
from lrfcal_lib.preprocess.surfaces import row_ends
from lrfcal_lib.solvers.joint_solution import JointSolution

# how a board leans out of the upright plane that faces the LRF: about its x or y, degrees
LEANS = {
    "upright": (0, 0),
    "leaning back by 35 deg": (-35, 0),
    "leaning forward by 35 deg": (35, 0),
    "facing left by 35 deg": (0, -35),
    "facing right by 35 deg": (0, 35),
}
# where the middle of a board is put
PLACES = (
    (1.0, 1.5, 2.0, 2.5, 3.0),  # metres from the LRF
    range(-20, 21, 10),  # degrees to the left
    (-12, 0, 12),  # degrees up
    # degrees in the board's plane, anticlockwise as the rig sees it
    range(0, 360, 60),
    range(len(LEANS)),
)
LARGEST_PITCH = np.radians(30)  # of a head that is asked to look at a board
# pitch angles that images are tried at
LATTICE = np.linspace(-LARGEST_PITCH, LARGEST_PITCH, 41)
# of each camera on the head, spread over the pitch angles at which all see the board
IMAGES = 3
MARGIN = 0.04  # of the image, that a board keeps from its border, distortion included
RADIUS = 2.0  # metres: a turn counts as much as what it shifts at this distance
TURN = re.compile(r"axis_.*_plane|.*_r[xyz]|pitch_scale|pitch_by_direction")  # unknowns


@dataclass(frozen=True)
class Suggestion:
    """The placement that would shrink the uncertainty most.

    Attributes
    ----------
    T_platform_board : RigidTransform
    place : ndarray, shape (5,)
        Distance (metres), bearing, elevation and turn (degrees), number of `LEANS`.
    pitches : ndarray, shape (k,)
        Of the images, radians; empty where no camera is on the head.
    gain, median_gain : float
        By how much the standard deviation of axis and cameras together shrinks, a fraction, at the
        propagated noise; of all candidates, what a placement chosen blindly brings.
    """

    T_platform_board: RigidTransform
    place: np.ndarray
    pitches: np.ndarray
    gain: float
    median_gain: float

    def sentence(self) -> str:
        """What to record next and what it brings."""
        distance, bearing, elevation, turn, lean = self.place
        words = (
            f"Record next: board {distance:.1f} m ahead, {abs(bearing):.0f} deg to the "
            f"{by_sign(bearing, 'left', 'right')}, {abs(elevation):.0f} deg "
            f"{by_sign(elevation, 'up', 'down')}, turned by {turn:.0f} deg in its plane, "
            f"{list(LEANS)[int(lean)]}"
        )
        if len(self.pitches):
            # a board so near fills the image at one pitch only
            angles = dict.fromkeys(f"{pitch:+.0f}" for pitch in np.degrees(self.pitches))
            words += f"; images at pitch {', '.join(angles)} deg"
        return (
            f"{words}. The standard deviations of axis and cameras would shrink by about "
            f"{100 * self.gain:.0f} %; a placement chosen at random would bring "
            f"{100 * self.median_gain:.0f} %."
        )


def suggest_placement(solution: JointSolution, rig: CalibratedRig) -> Suggestion:
    """The board pose and pitch angles of images that would make axis and cameras known best.

    Of a grid of poses that the LRF and all cameras see, the one that leaves the least sum of their
    variances.

    Parameters
    ----------
    solution
    rig
        As the solution has it.

    Raises
    ------
    DegenerateGeometry
        When no pose of the grid is seen by all.
    """
    grid = np.array(list(product(*PLACES)))
    boards = board_poses(solution, grid)
    seen, pitches = pitches_of_images(boards, solution, rig)
    if len(seen) == 0:
        raise DegenerateGeometry(
            f"none of {len(grid)} board poses lies wholly in the view of the LRF and of all "
            f"cameras at a pitch within {np.degrees(LARGEST_PITCH):.0f} deg: check the field of "
            "view and the calibration"
        )
    boards = boards[seen]
    known = solution.score().information.sum(axis=0)
    added = sum(candidate_information(boards, pitches, solution, rig))
    left = total_sigma(known + added, solution) / total_sigma(known, solution)
    best = np.argmin(left)
    if "head" not in solution.observations.mounts:
        pitches = pitches[:, :0]
    return Suggestion(
        T_platform_board=pose_transform(boards[best]),
        place=grid[seen[best]],
        pitches=pitches[best],
        gain=1 - left[best],
        median_gain=1 - np.median(left),
    )


def total_sigma(information, solution):
    """Standard deviation of axis and cameras together, metres at 2 m, from information (..., c, c).

    What is not observed counts as known to a metre at 2 m, so that it can be compared as well.
    """
    unit = dyads(scales_of(solution))
    scaled = np.linalg.inv(information * unit + np.eye(len(unit)))
    asked = solution.columns(*AXIS_NAMES, *solution.transforms)
    return length_of(sigma_of(scaled)[..., asked])


def scales_of(solution: JointSolution) -> np.ndarray:
    """How much of each pose, (c,), shifts what lies 2 m away by a metre; 1 of other unknowns."""
    turns = [bool(TURN.fullmatch(name)) for name in solution.solution.names]
    return np.where(turns, 1 / RADIUS, 1.0)


def group_sigma(covariance: np.ndarray, solution: JointSolution) -> dict[str, np.ndarray]:
    """Standard deviations of axis and cameras, metres at 2 m, from covariances of the unknowns.

    Parameters
    ----------
    covariance : ndarray, shape (..., c, c)
    solution

    Returns
    -------
    dict of str to ndarray, shape (...)
        Of the axis and of each camera, by its name in words, as far as they were unknown.
    """
    sigma = sigma_of(covariance) / scales_of(solution)
    columns = {"the axis": solution.columns(*AXIS_NAMES)}
    for camera in solution.transforms:
        columns[f"camera '{camera}'"] = solution.columns(camera)
    return {name: length_of(sigma[..., index]) for name, index in columns.items() if index}


def outline(solution: JointSolution) -> np.ndarray:
    """Corners of the board, shape (e, 3), metres.

    Parameters
    ----------
    solution
    """
    return np.insert(solution.observations.corners, 2, 0.0, axis=1)


def board_middle(solution: JointSolution) -> np.ndarray:
    """Middle of the board, metres, and a 1 that poses (..., 3, 4) shift, shape (4,).

    Parameters
    ----------
    solution
    """
    return np.append(outline(solution).mean(axis=0), 1.0)


def sights(boards: np.ndarray, solution: JointSolution) -> np.ndarray:
    """From the LRF to the middles of boards ``T_platform_board`` (n, 3, 4): metres, (n, 3)."""
    return boards @ board_middle(solution) - solution.T_head_lrf.translation


def board_poses(solution, grid):
    """``T_platform_board`` (n, 3, 4) of boards at the places (n, 5) of a grid, see `PLACES`."""
    distance, bearing_elevation, turn, lean = np.split(grid, [1, 3, 4], axis=1)
    gaze = Rotation.from_euler("ZX", bearing_elevation, degrees=True)
    leans = np.array([*LEANS.values()])[lean[:, 0].astype(int)]
    tip = Rotation.from_euler("xy", leans, degrees=True)
    spin = Rotation.from_euler("z", turn, degrees=True)
    rotation = solution.T_head_lrf.rotation * gaze * AHEAD * tip * spin
    middle = solution.T_head_lrf.apply(distance * gaze.apply([0.0, 1.0, 0.0]))
    return pose_array(carry(rotation, outline(solution).mean(axis=0), middle))


def pitches_of_images(boards, solution, rig):
    """Which of some boards (n, 3, 4) LRF and cameras see wholly, (m,), and pitch angles (m, k) of
    images of them, radians.
    """
    points = apply_pose(boards, outline(solution))
    bearing, pitch, _ = beams_to(points, rig.T_head_lrf)
    low, high = rig.lrf.field_of_view
    inside = (bearing > low) & (bearing < high)
    inside &= np.abs(pitch) < LARGEST_PITCH
    visible = np.tile(inside.all(axis=1), (len(LATTICE), 1))
    for name, camera in rig.cameras.items():
        poses = pose_array(rig.camera_at(name, LATTICE))
        # far outside the image a lens model would fold back
        uv = pinhole(apply_pose(poses[..., None, :, :], points), camera.model)
        visible &= camera.model.shows(uv, MARGIN * camera.model.size).all(axis=-1)

    seen, ends = row_ends(visible.T)
    first, last = LATTICE[ends].T
    return seen, np.linspace(first, last, IMAGES, axis=1)


def candidate_information(boards, pitches, solution, rig):
    """Information that boards would add about the shared unknowns, shape (n, c, c) by image.

    `boards` (n, 3, 4) are ``T_platform_board``, `pitches` (n, k) those of the images. Points of a
    board that a scan knows, with its errors, are compared with where images show them; all images
    share the errors of the one scan.
    """
    obs = solution.observations
    beams = beams_to(apply_pose(boards, points_of_face(solution)), solution.T_head_lrf)
    images = [pitches if mount == "head" else pitches[:, :1] for mount in obs.mounts]
    count = sum(at.shape[1] for at in images)
    by_scan = np.sqrt(count) * scan_sigma(solution, boards)[:, None]
    for camera, at in zip(obs.cameras, images, strict=True):
        model = rig.cameras[camera].model
        by_image = image_sigma(solution, camera, model)
        chain = chain_of(rig, camera)
        for pitch in at.T:
            p_camera, by_link, _ = carried(chain, *beams, image_pitch=pitch[:, None])
            sigma = np.hypot(by_image, by_scan * model.fx / p_camera[..., 2])
            J = project_jacobians(p_camera, model)[0] @ by_link @ chain.links
            J /= sigma[..., None, None]
            J = J.reshape(len(boards), -1, J.shape[-1])
            yield J.mT @ J


def points_of_face(solution):
    """Points (e, 3) half-way from the middle of the board to its corners, metres.

    They are spread about the middle as the face is.
    """
    corners = outline(solution)
    return (corners + corners.mean(axis=0)) / 2


def scan_sigma(solution, boards):
    """Standard deviation of each of the :func:`points_of_face` of boards in a scan, metres, (n,).

    As in the recorded scans, in proportion to how large the boards look from the LRF, and never
    less.
    """
    by_shift = np.linalg.inv(solution.board_information()[:, 3:, 3:])
    variance = len(outline(solution)) * np.linalg.trace(by_shift) / 3
    usual = np.median(variance * solid_angle(solution, solution.board_poses))
    return np.sqrt(np.maximum(usual / solid_angle(solution, boards), variance.min()))


def solid_angle(solution, boards):
    """How large boards (n, 3, 4) look from the LRF, relative to their area, (n,)."""
    sight = sights(boards, solution)
    return np.abs(np.vecdot(sight, boards[:, :, 2])) / length_of(sight) ** 3


def image_sigma(solution, camera, model):
    """Standard deviation of each of the :func:`points_of_face` in images of a camera, pixels.

    So that together they tell shifts of the board as well as the recorded images do.
    """
    obs = solution.observations
    number = obs.cameras.index(camera)
    views = obs.view_camera == number
    by_shift = np.linalg.inv(obs.view_covariance[views])[:, 3, 3]
    by_pixel = (model.fx / obs.view_pose[views, 2, 3]) ** 2
    variance = solution.noise["view_scale"] ** 2 * np.median(by_pixel / by_shift)
    if obs.mounts[number] == "head":  # all points of an image share the error of its pitch
        variance += (model.fx * solution.noise["sigma_pitch"]) ** 2
    return np.sqrt(variance * len(obs.corners))
