"""The start value of the joint estimate that leads to the best minimum, among closed forms.

And what contradicts all others: found, named and left out.

Cameras from planes, about the stated axis, by equations (4) to (6) and (16); a board lies where the
images and where the scans put it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.fit.padding import medians
from lrfcal_lib.model.geometry import (
    DegenerateGeometry,
    length_of,
    polar_to_points,
    pose_array,
    pose_transform,
)
from lrfcal_lib.model.kinematics import SourceFrame, platform_from_head
from lrfcal_lib.model.observations import CameraObservations, JointObservations, thin
from lrfcal_lib.model.problem import Problem, ProblemKind, Stage
from lrfcal_lib.solvers.joint_model import JointState, Levels, Unknowns, gather, undisturbed
from lrfcal_lib.solvers.joint_residuals import face_heights, minimum
from lrfcal_lib.solvers.plane_start import start_from_planes

START_SOFTNESS = 0.2  # spot radii
POINTS = 30  # a plane
VIEWS = 24  # a camera; closed forms do not get much better with more
# mean half squared residual; a start value this good is not searched further
GOOD_START = 0.7
ROUGH_MISS = 0.08  # metres, of a start value's boards from where images put them
# of all that is left out: what it counts against a start value
PENALTY = 16.0
FEW_STEPS = 8  # of a minimisation that only has to show where it leads
CONTRADICTS = ProblemKind.CONTRADICTS
LARGEST_SHARE = 0.3  # of the placements that may contradict the others
LAST_MISS = 0.025  # metres, of a board from where images of it put it
MOST_SIGMA = 4.0  # by which images may put a board elsewhere, of what is stated of them
FAR_MISS = 5.0  # times the usual miss: an image puts the board elsewhere


@dataclass(frozen=True)
class Start:
    """A start value of the joint estimate.

    Attributes
    ----------
    kept : JointObservations
        Without what contradicts it.
    state : JointState
    left_out : list of Problem
    share : float
        The larger one of the placements, and of the images of the others, that are left out.
    badness : float
        Mean half squared residual of what is kept; the share that is left out counts against it.
    miss : float
        By how much the closed form, before any step, puts points off their boards, metres (median).
    converged : bool
        Whether the few steps led to the end.
    """

    kept: JointObservations
    state: JointState
    left_out: list[Problem]
    share: float
    badness: float
    miss: float
    converged: bool


def best_start(obs: JointObservations, unknowns: Unknowns, levels: Levels) -> Start:
    """The most promising start value.

    More than 30 % of the placements that contradict the rest raise DegenerateGeometry: nobody knows
    which ones are wrong.
    """
    data = gather(obs, levels)
    tried = []
    for states in start_states(obs, unknowns.axis):
        for state in states:
            tried += attempts(obs, state, data, unknowns)
        best = min(tried, key=lambda start: start.badness)
        if best.badness < GOOD_START:
            break
    if best.miss > ROUGH_MISS:  # a camera that was knocked is to be named, not refused
        refuse_contradiction(best.kept, best.state, ROUGH_MISS)
    if best.share > LARGEST_SHARE:
        words = "; ".join(map(str, best.left_out[:8]))
        raise DegenerateGeometry(
            f"{len(best.left_out)} placements or images of {len(obs.placements)} placements "
            f"contradict the others ({words}); check that images and scans carry the right numbers"
        )
    return best


def attempts(obs, state, data, unknowns):
    """Two Starts: a few steps without what contradicts a start value, and where a rough one leaves
    something out, judged again by the rest.

    What still contradicts may have led the rest astray: either may be the better one.
    """
    heights = np.abs(face_heights(state, data, state.boards))
    miss = np.median(medians(heights, data.face["used"]))
    for _ in range(2):
        kept, fitting, left_out = without_contradictions(obs, state, data)
        cut = gather(kept, data.levels) if left_out else data
        found = minimum(fitting, cut, coarse(unknowns), steps=FEW_STEPS)
        placements = sum(problem.camera is None for problem in left_out)
        images = (len(left_out) - placements) / len(obs.view_camera)
        share = max(placements / len(obs.placements), images)
        cost = np.nan_to_num(found.cost_history[-1], nan=np.inf) / kept.count
        badness = cost * (1 + PENALTY * share)
        yield Start(kept, found.state, left_out, share, badness, miss, found.converged)
        if not left_out or share > LARGEST_SHARE:
            break
        state = state_of(obs, found.state.head, found.state.cameras)


def without_contradictions(obs, state, data):
    """Leave out images that put the board far off where it was scanned, and placements of which
    none is left. Every placement has one.
    """
    place = obs.view_placement
    boards = boards_in_images(obs, state.head, state.cameras)
    heights = face_heights(state, data, boards, place)
    misses = medians(np.abs(heights), data.face["used"][place])
    wrong = misses > max(LAST_MISS, FAR_MISS * np.median(misses))
    good = place[~wrong]
    left_out = []
    for row in np.setdiff1d(place, good):
        miss = 1000 * misses[place == row].min()
        why = f"the scan is {miss:.0f} mm off where its image puts the board"
        left_out.append(of_placement(obs.placements[row], CONTRADICTS, why))
    for view in np.flatnonzero(wrong & np.isin(place, good)):
        number = int(obs.placements[place[view]])
        camera = obs.cameras[obs.view_camera[view]]
        words = (
            f"image of '{camera}' at {np.degrees(obs.view_pitch[view]):.1f} deg: it puts the board "
            f"{1000 * misses[view]:.0f} mm off the scan; the image is left out"
        )
        left_out.append(Problem(Stage.JOINT, CONTRADICTS, words, number, camera))
    rest = obs.keep(view=~wrong).select(obs.placements[good])
    return rest, state_of(rest, state.head, state.cameras), left_out


def coarse(unknowns: Unknowns) -> Unknowns:
    """The unknowns without those of the edges: from far away, beams on the wrong side would blow
    up the softness.
    """
    of_edges = ("edge_log_odds", "edge_log_softness")
    sensor = tuple(name for name in unknowns.sensor if name not in of_edges)
    return replace(unknowns, sensor=sensor, sides=False)


def start_states(obs: JointObservations, axis: bool = True) -> Iterator[list[JointState]]:
    """Start values to choose from, made one by one: each with those of the cameras' other minima.

    From the stated platform, then from an axis along x through the mirror, which may turn
    backwards; with cameras from the planes of whole sweeps. Where the axis is no unknown, only the
    first. Raises DegenerateGeometry when no
    placement gives the pose of a board.
    """
    if len(obs.face_range) == 0:
        raise DegenerateGeometry(
            "no ranges on the boards' faces: a start value needs them; give one as start="
        )
    both_ways = Rotation.from_euler("z", [[0.0], [np.pi]])
    heads = [*RigidTransform.from_rotation(both_ways)]
    if obs.T_head_lrf is not None:
        heads.insert(0, obs.T_head_lrf)
    if not axis:
        del heads[1:]
    reasons = []
    for head in heads:
        try:
            yield _states(obs, head)
        except (DegenerateGeometry, np.linalg.LinAlgError) as error:
            reasons.append(str(error))
    if len(reasons) == len(heads):
        every = "; ".join(dict.fromkeys(reasons))
        raise DegenerateGeometry(f"no start value for the joint estimate: {every}")


def _states(obs, head):
    """States with an axis: with the best pose of every camera, then with each other one of one
    camera.
    """
    minima = [_camera(obs, camera, head) for camera in range(len(obs.cameras))]
    best = np.array([poses[0] for poses in minima])
    choices = [best]
    for camera, poses in enumerate(minima):
        for pose in poses[1:]:
            other = best.copy()
            other[camera] = pose
            choices.append(other)
    return [state_of(obs, pose_array(head), cameras) for cameras in choices]


def _camera(obs, camera, head):
    """Poses of a camera, the best one first, from its first views of boards and the sweeps over
    these, joined by a roughly known axis.
    """
    name = obs.cameras[camera]
    mine = np.flatnonzero(obs.view_camera == camera)
    first = mine[np.unique(obs.view_placement[mine], return_index=True)[1]]
    views = thin(first, VIEWS)
    placements = obs.view_placement[views]
    rows = np.concatenate(
        [thin(np.flatnonzero(obs.face_placement == p), POINTS) for p in placements]
    )
    if len(rows) == 0:
        raise DegenerateGeometry(f"camera '{name}' never sees a board that the scans hit")
    image = views[np.searchsorted(placements, obs.face_placement[rows])]
    frame = SourceFrame(head, obs.mounts[camera], obs.view_pitch[image])
    p_lrf = polar_to_points(obs.face_range[rows], obs.face_bearing[rows])
    seen = CameraObservations(
        None,
        name,
        plane_points=frame.points(p_lrf, obs.face_pitch[rows]),
        plane_placement=obs.face_placement[rows],
        placements=placements,
        board_poses=obs.view_pose[views],
        board_covariance=obs.view_covariance[views],
    )
    return pose_array(start_from_planes(seen))


def state_of(obs: JointObservations, head: np.ndarray, cameras: np.ndarray) -> JointState:
    """All unknowns from an axis and the cameras (as in JointState): boards from first images."""
    _, first = np.unique(obs.view_placement, return_index=True)
    boards = boards_in_images(obs, head, cameras)[first]
    sensor = np.array([0.0, 0.0, np.log(START_SOFTNESS), 0.0, 0.0])
    return undisturbed(obs, head, cameras, sensor, boards)


def boards_in_images(
    obs: JointObservations, head: np.ndarray, cameras: np.ndarray
) -> np.ndarray:
    """``T_platform_board`` (v, 3, 4) from the views, each by itself.

    `head` and `cameras` as in JointState.
    """
    on_head = obs.on_head[obs.view_camera]
    pitch = obs.view_pitch * on_head
    T_head_lrf = pose_transform(np.where(on_head[:, None, None], head, np.eye(3, 4)))
    T_platform_lrf = platform_from_head(pitch) * T_head_lrf
    T_platform_camera = T_platform_lrf * pose_transform(cameras[obs.view_camera]).inv()
    return pose_array(T_platform_camera * RigidTransform.from_matrix(obs.view_pose))


def of_placement(number, kind, why):
    """The Problem of a placement."""
    return Problem(Stage.JOINT, kind, f"{why}; left out", placement=int(number))


def without_blind_cameras(obs, required):
    """Leave out cameras that never see a board; refuse them where everything is required."""
    why = "it never sees the board, its pose stays open"
    blind = np.delete(obs.cameras, obs.view_camera).tolist()
    left_out = [
        Problem(Stage.JOINT, ProblemKind.NO_IMAGES, why, camera=camera) for camera in blind
    ]
    if required and left_out:
        words = "; ".join(map(str, left_out))
        raise DegenerateGeometry(f"{words}; leave it out with obs.with_cameras")
    return obs.with_cameras(np.setdiff1d(obs.cameras, blind)), left_out


def without_lost_placements(obs):
    """Leave out placements that no image shows: nothing says where their board is at the start."""
    lost = np.delete(obs.placements, obs.view_placement)
    why = "no image shows the board"
    left_out = [of_placement(number, ProblemKind.TOO_LITTLE, why) for number in lost]
    if not len(obs.view_placement):
        raise DegenerateGeometry("; ".join(map(str, left_out)))
    return obs.select(obs.placements[obs.view_placement]), left_out


def refuse_contradiction(
    obs: JointObservations, state: JointState, most: float, left_out: Sequence[Problem] = ()
) -> None:
    """Raise DegenerateGeometry where images put the boards of a third of the placements more than
    `most` metres (and `MOST_SIGMA` of what is stated of the images) off where they are.

    Placements that were left out for that already count with them.
    """
    place = obs.view_placement
    if not len(place):
        return
    boards = boards_in_images(obs, state.head, state.cameras)
    misses = length_of(boards[..., 3] - state.boards[place, :, 3])
    stated = np.sqrt(np.linalg.trace(obs.view_covariance[:, 3:, 3:]))
    before = sum(p.kind == CONTRADICTS and p.camera is None for p in left_out)
    shown = np.unique(place)
    limit = np.maximum(most, MOST_SIGMA * ndimage.median(stated, place, shown))
    wrong = np.sum(ndimage.median(misses, place, shown) > limit)
    every = len(shown) + before
    if wrong and 3 * (wrong + before) > every:
        raise DegenerateGeometry(
            f"images and scans contradict each other: for {wrong + before} of {every} placements "
            f"the board lies more than {1000 * most:.0f} mm off where the images put it; check "
            "that images and scans carry the right numbers"
        )
