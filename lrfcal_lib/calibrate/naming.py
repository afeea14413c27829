"""Name the sides that scans cross after the edges of the board, which the images place there."""

from dataclasses import replace

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.calibrate.observe import observe, sides_of, source_of
from lrfcal_lib.model.board import Board
from lrfcal_lib.model.camera import line_distance
from lrfcal_lib.model.geometry import DegenerateGeometry, fit_line, unit_vector
from lrfcal_lib.model.problem import Problem, ProblemKind, Stage
from lrfcal_lib.preprocess.pattern_in_image import SMALL_SQUARE_PX
from lrfcal_lib.preprocess.prepared import DroppedSide, Prepared
from lrfcal_lib.preprocess.survey import small_squares
from lrfcal_lib.solvers import find_outlying_placements, solve_camera

# metres between a side in the cloud and the board edge it is named after, at most
NAME_DISTANCE = 0.08
# between them; a side turned more is none (a cloud cut by hand, an occluder)
NAME_ANGLE = np.deg2rad(3.0)
TURNED = 3.0  # sigma by which noise may turn the line through a side


def name_sides(prepared: Prepared) -> Prepared:
    """Name the sides that scans cross: the nearest edge of the board.

    The cameras' poses come from the planes alone (Zhang and Pless), which needs no names. Sides
    farther than 8 cm from every edge have none; nor has any where nobody knows the outline of the
    board.

    Parameters
    ----------
    prepared : Prepared

    Returns
    -------
    Prepared
        With names of the sides of its scans, and the problems of :func:`rough_poses` and of sides
        without a name.
    """
    rough, problems = rough_poses(prepared)
    named: dict = {}
    if prepared.board.corners is None:
        rough = {}
    for camera, T_camera_source in rough.items():
        for placement, view in prepared.posed(camera).items():
            if placement not in prepared.scans or placement in named:
                continue
            scan = prepared.scans[placement]
            T_board_source = view.T_camera_board.inv() * T_camera_source
            source = source_of(prepared, camera, placement, None)
            sides = {}
            for side in sides_of(scan):
                p_source = source.points(side.crossed.points, side.crossed.pitch)
                sides[side.number] = T_board_source.apply(p_source)
            names, dropped = nearest_edges(prepared.board, sides)
            named[placement] = replace(scan, names=names, dropped=dropped)
            for why in dropped.values():
                problems.append(
                    Problem(Stage.SIDES, ProblemKind.OTHER_SIDE, why.words, placement)
                )
    every = (*prepared.problems, *problems)
    return replace(prepared, scans=prepared.scans | named, problems=every)


def rough_poses(prepared: Prepared) -> tuple[dict[str, RigidTransform], list[Problem]]:
    """Poses ``T_camera_source`` of the cameras from the planes alone, by camera, and a list of
    Problem.

    Problems are placements that disagree with all others, and why a camera has no pose.
    """
    rough = {}
    problems = []
    misses: dict = {}  # rms distance between planes, by placement and camera; 0 where they agree
    for camera in prepared.views:
        observations = observe(prepared, camera)
        try:
            inliers, outlying = find_outlying_placements(observations)
            solution = solve_camera(observations.select(inliers), "zhang_pless")
        except DegenerateGeometry as error:
            problems.append(
                Problem(Stage.SIDES, ProblemKind.NO_POSE, str(error), camera=camera)
            )
            continue
        rough[camera] = solution.transform
        for placement in observations.placements.tolist():
            misses.setdefault(placement, {})[camera] = outlying.get(placement, 0.0)
    for placement, by_camera in misses.items():
        if any(by_camera.values()):
            words = f"{_disagreement(prepared, placement, by_camera)}; left out"
            problems.append(Problem(Stage.SIDES, ProblemKind.OTHER_PLANE, words, placement))
    return rough, problems


def _disagreement(prepared, placement, misses):
    """How the scan and the images of a placement disagree, and what may be wrong."""
    wrong = [camera for camera, miss in misses.items() if miss]
    off = f"its plane is {1000 * max(misses.values()):.0f} mm rms off the"
    if not len(wrong) == len(misses) > 1:
        return f"camera {wrong[0]}: {off} scan"
    causes = "another surface, mixed readings"
    views = {
        c: {placement: seen[placement]}
        for c, seen in prepared.views.items()
        if placement in seen
    }
    if small_squares(views, prepared.board.pattern):
        causes += (
            f"; or the images: squares below {SMALL_SQUARE_PX:.0f} px, whose distance may be "
            "biased"
        )
    return f"scan: {off} board in the images of all {len(misses)} cameras ({causes})"


def nearest_edges(
    board: Board, sides: dict[int, np.ndarray]
) -> tuple[dict[int, str], dict[int, DroppedSide]]:
    """Edges of a board that sides of a scan lie on, each given once.

    Parameters
    ----------
    board : Board
    sides : dict of int to ndarray, shape (n, 3)
        Points by side number, board frame, metres.

    Returns
    -------
    names : dict of int to str
    dropped : dict of int to DroppedSide
        Why the others have no name.
    """
    lines = board.lines()
    names = {}
    dropped = {}
    medians = [
        np.median(np.abs(line_distance(points[:, None, :2], lines)), axis=0)
        for points in sides.values()
    ]
    cost = np.reshape(medians, (-1, len(lines)))
    numbers = list(sides)
    for row, column in zip(*linear_sum_assignment(cost), strict=True):
        number = numbers[row]
        edge = board.edges[column]
        distance = cost[row, column]
        turn, allowed = _turn(sides[number], lines[column])
        if distance > NAME_DISTANCE:
            dropped[number] = DroppedSide(edge, distance)
        elif turn > allowed:
            dropped[number] = DroppedSide(edge, distance, turn)
        else:
            names[number] = edge
    return names, dropped


def _turn(points, line):
    """Angle between a side and an edge, and how large it may be, radians: what noise may turn the
    line through its points is allowed.
    """
    if len(points) <= 2:
        return 0.0, NAME_ANGLE
    _, direction, rms = fit_line(points)
    flat = unit_vector(direction[:2])
    noise = TURNED * rms * np.sqrt(12 / len(points)) / np.ptp(points @ direction)
    return np.arcsin(min(abs(flat @ line[:2]), 1.0)), np.hypot(NAME_ANGLE, noise)
