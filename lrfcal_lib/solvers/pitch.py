"""Errors of the recorded pitch, found from the boards that cameras on the base see.

Equations (5) and (16), with points in the planes of boards and of sight.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import fdtrc

from lrfcal_lib.fit.covariance import sigma_of
from lrfcal_lib.fit.least_squares import Block, solve
from lrfcal_lib.fit.padding import among
from lrfcal_lib.fit.residuals import sight_normals
from lrfcal_lib.fit.robust import rms
from lrfcal_lib.model.geometry import (
    POSE,
    POSE_NAMES,
    DegenerateGeometry,
    cross,
    fit_plane,
    gradient_by_pose,
    move_pose,
    pose_array,
    tilt,
)
from lrfcal_lib.model.observations import CameraObservations
from lrfcal_lib.solvers.plane_start import start_from_planes

# independent numbers: a plane's distance and two angles; an edge's offset and angle
PLANE_NUMBERS = 3
EDGE_NUMBERS = 2
FEWEST = 4  # placements, to compare sweeps
# offset (radians) and stretch: hold what one sweep cannot show, and the common offset
PRIOR = (np.radians(5.0), 0.5)
# metres, of one independent number: weighs the data against `PRIOR`; their level comes from the
# residuals
SIGMA = 0.003
LEVEL = 0.01  # a larger model must beat the last one wanted with this p-value


@dataclass(frozen=True)
class PitchModel:
    """One of the nested models, solved.

    Attributes
    ----------
    name : str
        'none', 'direction' (+offset for sweeps with direction +1, -offset for -1), 'sweep' (an
        offset each), or 'sweep_stretch' (an offset and a stretch about the middle each).
    offset, offset_sigma, stretch : ndarray, shape (p,)
        Radians to *add* to the recorded pitch of each placement, and relative: the corrected pitch
        is ``pitch + offset + stretch (pitch - middle)``. Offsets of single sweeps are those from
        their mean.
    misfit : float
        What the models are compared by, in units of `SIGMA`: sum over the placements of the mean
        square distance of the fitted scan plane from the camera's plane, and over their edges of
        the mean square distance of the crossings from the planes of sight; mean over the cameras.
    plane_rms : float
        Root mean square distance of scan planes from the cameras' planes, metres.
    n_parameters : int
    converged : bool
    F, p_value : float
        Test against the model before (nan for the first): would the misfit fall so much by chance?
    """

    name: str
    offset: np.ndarray
    offset_sigma: np.ndarray
    stretch: np.ndarray
    misfit: float
    plane_rms: float
    n_parameters: int
    converged: bool
    F: float = np.nan
    p_value: float = np.nan

    def tested(self, small, numbers):
        """The model with F and p-value against a smaller one, of so many independent numbers."""
        more = self.n_parameters - small.n_parameters
        free = numbers - self.n_parameters
        if more <= 0 or free <= 0:
            return self
        F = (small.misfit - self.misfit) / more / (self.misfit / free)
        return replace(self, F=F, p_value=fdtrc(more, free, max(F, 0.0)))


@dataclass(frozen=True)
class PitchErrors:
    """What the recordings say about the recorded pitch.

    Attributes
    ----------
    placements : ndarray of int, shape (p,)
    direction : ndarray of int, shape (p,)
    direction_offset, direction_sigma : float
        Radians to add to the recorded pitch of sweeps with direction +1 (and to subtract for -1),
        with its standard deviation (`Solution.trusted`, with the noise at the level of the
        residuals). nan where the sweeps all go one way.
    models : dict of str to PitchModel
    wanted : str
        The model that the data ask for: each larger one must beat the last one wanted with p <
        0.01.
    """

    placements: np.ndarray
    direction: np.ndarray
    direction_offset: float
    direction_sigma: float
    models: dict[str, PitchModel]
    wanted: str


class _Rows(NamedTuple):
    """Points (n, 3) at their recorded pitch (platform frame), and the planes of a camera that they
    should lie in: faces in those of boards, crossings in planes of sight.
    """

    points: np.ndarray
    scatter: np.ndarray  # (n, 3), from the plane that fits the points of a face best
    normal: np.ndarray  # (n, 3), camera frame
    distance: np.ndarray  # of the plane from the camera, metres
    pitch: np.ndarray
    placement: np.ndarray  # index
    camera: np.ndarray  # index
    # root of a point's share in the mean square of its face, or of its edge, over `SIGMA`
    weight: np.ndarray


def estimate_pitch_errors(
    cameras: dict[str, CameraObservations],
    direction: dict[int, int],
    middle: dict[int, float],
) -> PitchErrors:
    """Estimate errors of the recorded pitch together with the cameras' poses, in nested models.

    Parameters
    ----------
    cameras : dict of str to CameraObservations
        Cameras fixed to the platform (``source='platform'``), with recorded pitch; their board
        poses are used, their crossings, and the face points of the first.
    direction : dict of int to int
        Sweep direction (+1 or -1; 0 for a single shot) of each placement.
    middle : dict of int to float
        Pitch about which a sweep is stretched, radians.

    Returns
    -------
    PitchErrors

    Raises
    ------
    DegenerateGeometry
        With fewer than four placements that the LRF and all cameras see.
    ValueError
        When a camera is not fixed to the platform.
    """
    placements = _common_placements(cameras)
    count = len(placements)
    turn = np.array([direction[p] for p in placements])
    seen = [obs.select(placements) for obs in cameras.values()]
    rows = gather(seen)
    middles = np.array([middle[p] for p in placements])
    away = rows.pitch - middles[rows.placement]
    # offset and stretch of each placement by the unknowns of a model
    every = np.eye(2 * count).reshape(2, count, -1)
    each = every[..., :count]
    by_unknowns = {"none": each[..., :0]}
    if {-1, 1} <= set(turn):
        by_unknowns["direction"] = each @ turn[:, None]
    by_unknowns |= {"sweep": each, "sweep_stretch": every}

    poses = np.array([pose_array(start_from_planes(obs))[0] for obs in cameras.values()])
    # errors of the LRF are common to all cameras, and count once
    edges = [{*zip(o.crossing_placement, o.crossing_edge, strict=True)} for o in seen]
    numbers = PLANE_NUMBERS * count + EDGE_NUMBERS * max(map(len, edges))
    models = {}
    by_direction = (np.nan, np.nan)
    for name, by_unknown in by_unknowns.items():
        by_offset, by_stretch = by_unknown[:, rows.placement]
        solution = _solve(name, rows, by_offset + away[:, None] * by_stretch, poses)
        model = _model(name, solution, rows, by_unknown, numbers)
        if name == "direction":
            by_direction = (solution.parameters[-1], model.offset_sigma.max())
        if name == "none":
            wanted = before = model
        if model.tested(wanted, numbers).p_value < LEVEL:
            wanted = model
        models[name] = before = model.tested(before, numbers)
    return PitchErrors(placements, turn, *by_direction, models, wanted.name)


def _common_placements(cameras):
    """Numbers of the placements that the LRF and all cameras see."""
    placements = next(iter(cameras.values())).plane_placement
    for name, obs in cameras.items():
        if obs.source != "platform":
            raise ValueError(
                f"camera '{name}' has source '{obs.source}': pitch errors need cameras fixed to "
                "the platform"
            )
        placements = np.intersect1d(placements, obs.placements)
    if len(placements) < FEWEST:
        raise DegenerateGeometry(
            f"{len(placements)} placements seen by the LRF and all cameras: at least {FEWEST} "
            "needed to compare sweeps"
        )
    return placements


def gather(cameras):
    """The rows of all cameras, which see the same placements; the faces are those of the first."""
    faces = cameras[0]
    placements, face = np.unique(faces.plane_placement, return_inverse=True)
    scatter = np.zeros_like(faces.plane_points)
    for index in range(len(placements)):
        points = faces.plane_points[face == index]
        normal, distance, _ = fit_plane(points)
        scatter[face == index] = np.outer(points @ normal - distance, normal)
    unit = SIGMA * np.sqrt(len(cameras))
    parts = []
    for number, obs in enumerate(cameras):
        board = obs.board_poses[np.argsort(obs.placements)][face]
        on_board = _Rows(
            points=faces.plane_points,
            scatter=scatter,
            normal=board[:, :3, 2],
            distance=np.vecdot(board[:, :3, 2], board[:, :3, 3]),
            pitch=faces.plane_pitch,
            placement=face,
            camera=np.full_like(face, number),
            weight=_shares(face) / unit,
        )
        placement = np.searchsorted(placements, obs.crossing_placement)
        _, edge = np.unique(obs.crossing_edge, return_inverse=True)
        on_sight = _Rows(
            points=obs.crossing_points,
            scatter=np.zeros_like(obs.crossing_points),
            normal=sight_normals(obs.crossing_lines, obs.model),
            distance=np.zeros_like(obs.crossing_pitch),
            pitch=obs.crossing_pitch,
            placement=placement,
            camera=np.full_like(placement, number),
            weight=_shares(placement + len(placements) * edge) / unit,
        )
        parts += [on_board, on_sight]
    return _Rows(*map(np.concatenate, zip(*parts, strict=True)))


def _shares(part):
    """Weights of rows by the part they belong to: the squares of one part's sum up to 1."""
    _, index, count = np.unique(part, return_inverse=True, return_counts=True)
    return 1 / np.sqrt(count[index])


def pitch_blocks(state, rows, by_unknown):
    """Distances of points from their planes, and the unknowns of the pitch with their prior.

    The state are poses of the cameras (c, 3, 4), and unknowns that change the pitch of the rows by
    ``by_unknown @ unknowns``; the Jacobian has 6 columns of each camera, then the unknowns.
    """
    poses, errors = state
    cameras = len(poses)
    pose = poses[rows.camera]
    q = tilt(rows.points, by_unknown @ errors)
    R = pose[:, :, :3]
    rotated = np.matvec(R, q)
    turn = cross(q, np.vecmat(rows.normal, R))[:, :1]  # about the tilt axis
    distances = np.vecdot(rows.normal, rotated + pose[:, :, 3]) - rows.distance
    by_pose = among(gradient_by_pose(rotated, rows.normal), rows.camera, cameras)
    prior = np.repeat(PRIOR, rows.placement.max() + 1)[: len(errors)]
    columns = np.eye(6 * cameras + len(errors))[6 * cameras :]
    return [
        Block(distances, np.concatenate([by_pose, turn * by_unknown], axis=1), rows.weight),
        Block(errors, columns, 1 / prior),
    ]


def _solve(name, rows, by_unknown, poses):
    """The Solution of one model, the cameras and unknowns of the pitch together."""
    first = 6 * len(poses)
    count = by_unknown.shape[1]
    sweeps = np.arange(count) % (rows.placement.max() + 1)

    def move(state, step):
        """Retraction of poses and unknowns of the pitch."""
        poses, errors = state
        return move_pose(poses, step[:first].reshape(-1, 6)), errors + step[first:]

    return solve(
        lambda state: pitch_blocks(state, rows, by_unknown),
        (poses, np.zeros(count)),
        move,
        names=[*POSE_NAMES] * len(poses) + ["pitch"] * count,
        method=f"pitch_{name}",
        read=lambda state: (None, state[1]),  # unknowns of the pitch
        groups=np.concatenate([rows.placement, sweeps]),
        required=False,
        limit=10.0,
    )


def _model(name, solution, rows, by_unknown, numbers):
    """What a Solution says about the pitch; offsets and stretches are ``by_unknown @ unknowns``.

    The stated sigmas only weigh faces against edges, the level comes from the residuals.
    """
    poses, errors = solution.state
    _, p, free = by_unknown.shape
    distances = solution.residuals[: len(rows.weight)] / rows.weight
    # what a scan scatters about its own plane tells nothing of the pitch
    scatter = np.matvec(poses[rows.camera][:, :, :3], rows.scatter)
    away = distances - np.vecdot(rows.normal, scatter)
    misfit = np.sum((rows.weight * away) ** 2)
    offsets, stretches = by_unknown
    if free >= p:  # the offset common to all sweeps goes with the cameras' poses
        free -= 1
        offsets = offsets - offsets.mean(axis=0)
    level = misfit / max(numbers - POSE - free, 1)
    known = replace(solution, covariance=level / solution.inflation * solution.covariance)
    own = slice(POSE * len(poses), None)
    of_unknowns = known.trusted[own, own]
    return PitchModel(
        name,
        offset=offsets @ errors,
        offset_sigma=sigma_of(offsets @ of_unknowns @ offsets.T),
        stretch=stretches @ errors,
        misfit=misfit,
        plane_rms=rms(distances[rows.distance != 0]),  # planes of sight hold the camera
        n_parameters=POSE + free,
        converged=solution.converged,
    )
