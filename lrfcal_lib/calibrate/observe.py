"""What the LRF and the cameras saw of the board: moved into the frame that something is fixed to,
and stacked as observations.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.calibrate.outline import MeasuredBoard, measure_board
from lrfcal_lib.fit.covariance import dyads
from lrfcal_lib.model.board import corners_of_lines
from lrfcal_lib.model.geometry import length_of
from lrfcal_lib.model.kinematics import AS_RECORDED, TILT_AXIS, Corrections, SourceFrame
from lrfcal_lib.model.observations import CameraObservations, PlatformObservations, thin
from lrfcal_lib.preprocess.board_in_scan import BoardScan, face_points
from lrfcal_lib.preprocess.edges_in_scan import ScanSide
from lrfcal_lib.preprocess.prepared import Prepared

ONE_SCAN = "one_scan"
# neighbouring scan lines repeat each other's errors; a line in space needs few points
CROSSINGS_PER_EDGE = 24
FACE_POINTS = 150  # a placement: neighbouring ranges of a real device share their errors
PLATFORM_POINTS = 40  # per edge
LEAST_CORNER_SIGMA = 0.05  # pixels; no chessboard corner is found better
LEAST_STRETCH = 0.4  # share of an edge that must be seen before its line decides a corner
# largest |cosine| between two sides that are taken for the board's perpendicular edges
RIGHT_ANGLE = 0.15


def observe(
    prepared: Prepared,
    camera: str,
    variant: str = "half_step",
    T_head_lrf: RigidTransform | None = None,
    corrections: Corrections = AS_RECORDED,
    crossings: int = CROSSINGS_PER_EDGE,
    faces: int = FACE_POINTS,
) -> CameraObservations:
    """Pair what the LRF and one camera saw of the board.

    Parameters
    ----------
    prepared : Prepared
    camera : str
    variant : {'half_step', 'last_beam', 'one_scan'}
        Rule for the edge point; 'one_scan' is the paper's: last beams of the two edges of
        `board.features`, on the middle one of the scan lines that cross both.
    T_head_lrf : RigidTransform, optional
        Platform calibration to use instead of the session's own.
    corrections : Corrections
        Known errors of what was recorded, which are taken out of points and pitch; see
        :attr:`lrfcal_lib.solvers.joint.JointSolution.corrections`.
    crossings, faces : int
        Kept of each edge and of the face of a placement, evenly spread; without one of them
        only the other is paired.

    Returns
    -------
    CameraObservations
    """
    posed = prepared.posed(camera)
    rule = "last_beam" if variant == ONE_SCAN else variant
    on_faces = []
    crossed: list = []
    corners: list = []
    for placement, scan in prepared.scans.items():
        if placement not in posed:
            continue
        view = posed[placement]
        source = source_of(prepared, camera, placement, T_head_lrf, corrections)
        if faces:
            on_faces.append(_face(source, scan, faces))
        sides = named_sides(prepared, placement, rule)
        if variant == ONE_SCAN:
            sides = _one_scan_line(prepared.board.features, view, sides)
        crossed += _crossings(prepared, view, source, sides, crossings)
        if faces and crossings and scan.names:
            corners += _corners(prepared, view, source, rule)
    pattern = prepared.pattern_points
    model = prepared.models[camera]
    on_base = prepared.session.cameras[camera].mount == "platform"
    return CameraObservations(
        model=model,
        camera=camera,
        source="platform" if on_base else "lrf",
        pattern_points=pattern,
        pattern_sigma_px=max(model.rms_px or 0.0, LEAST_CORNER_SIGMA),
        **stack("", _boards_in_images(posed, len(pattern))),
        **stack("plane_", on_faces),
        **stack("crossing_", crossed),
        **stack("scene_", corners),
    )


def platform_observations(
    prepared: Prepared, variant: str = "half_step"
) -> PlatformObservations:
    """Two perpendicular sides and the face of the board in every sweep; no cameras are needed.

    Of each sweep the longest pair of perpendicular sides; a sweep with only one side gives that
    one.

    Parameters
    ----------
    prepared : Prepared
    variant : {'half_step', 'last_beam'}

    Returns
    -------
    PlatformObservations
    """
    sides = []
    faces = []
    for placement, scan in prepared.scans.items():
        if not scan.swept:
            continue
        feature = _feature_sides(sides_of(scan, variant))
        for number, side in enumerate(feature, 1):
            crossed = thin(side.crossed, PLATFORM_POINTS)
            sides.append(
                {
                    "points": crossed.points,
                    "covariance": crossed.covariance,
                    "pitch": crossed.pitch,
                    "placement": placement,
                    "number": number,
                }
            )
        points, pitch, covariance = face_points(scan, FACE_POINTS)
        faces.append(
            {
                "points": points,
                "covariance": covariance,
                "pitch": pitch,
                "placement": placement,
            }
        )
    return PlatformObservations(**stack("edge_", sides), **stack("face_", faces))


def outline_of(
    prepared: Prepared,
    placement: int,
    variant: str = "half_step",
    T_head_lrf: RigidTransform | None = None,
    corrections: Corrections = AS_RECORDED,
) -> tuple[MeasuredBoard, frozenset[str]]:
    """Measure the board's outline in the cloud of a placement by least squares.

    Sides of which less than 40 % is seen are missing: a stub does not carry a line to its corners.

    Parameters
    ----------
    prepared : Prepared
    placement : int
    variant : {'half_step', 'last_beam'}
    T_head_lrf : RigidTransform, optional
        The session's own platform when left out.
    corrections : Corrections

    Returns
    -------
    board : MeasuredBoard
    across : frozenset of str
        The edges found across the scan lines (where the sweep enters or leaves the board): their
        place hangs on the pitch.

    Raises
    ------
    DegenerateGeometry
        If the sweep does not cross enough scan lines to span a plane.
    """
    face, along, across = sides_in_cloud(
        prepared, placement, variant, platform_of(prepared, T_head_lrf), corrections
    )
    board = measure_board(face, along | across, prepared.board.edges)
    return board, frozenset(across)


def sides_in_cloud(
    prepared: Prepared,
    placement: int,
    variant: str,
    T_head_lrf: RigidTransform,
    corrections: Corrections,
) -> tuple[np.ndarray, dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Points of a board's face and, by name, of its sides of which enough is seen: those found
    along the scan lines, and across them; platform frame, metres.
    """
    source = SourceFrame(
        T_head_lrf, "platform", placement=placement, corrections=corrections
    )
    p_lrf, pitch, _ = face_points(prepared.scans[placement])
    along = {}
    across = {}
    for side in named_sides(prepared, placement, variant, LEAST_STRETCH):
        sides = across if side.across else along
        sides[side.name] = source.points(side.crossed.points, side.crossed.pitch)
    return source.points(p_lrf, pitch), along, across


def stack(prefix: str, parts: Iterable[dict]) -> dict[str, Any]:
    """Parts of a table end to end: its columns by name, with a prefix; none without parts.

    The first column of a part has its rows; a number or a name alone is the same in all of them.
    """
    columns: dict = {}
    for part in parts:
        count = len(next(iter(part.values())))
        for key, value in part.items():
            column = np.broadcast_to(value, np.shape(value) or count)
            columns.setdefault(prefix + key, []).append(column)
    return {key: np.concatenate(column) for key, column in columns.items()}


def source_of(
    prepared: Prepared,
    camera: str,
    placement: int,
    T_head_lrf: RigidTransform | None,
    corrections: Corrections = AS_RECORDED,
) -> SourceFrame:
    """A placement in the frame that one of its cameras is fixed to.

    Parameters
    ----------
    prepared : Prepared
    camera : str
    placement : int
    T_head_lrf : RigidTransform or None
        See :func:`platform_of`.
    corrections : Corrections

    Returns
    -------
    SourceFrame
    """
    mount = prepared.session.cameras[camera].mount
    pitch = prepared.views[camera][placement].pitch
    T_head_lrf = platform_of(prepared, T_head_lrf)
    return SourceFrame(T_head_lrf, mount, pitch, placement, corrections)


def platform_of(
    prepared: Prepared, T_head_lrf: RigidTransform | None = None
) -> RigidTransform:
    """The platform to use.

    Parameters
    ----------
    prepared : Prepared
    T_head_lrf : RigidTransform, optional

    Returns
    -------
    RigidTransform
        The one given, else the session's, else a tilt axis along x.
    """
    for T in (T_head_lrf, prepared.session.T_head_lrf):
        if T is not None:
            return T
    return RigidTransform.identity()


@dataclass(frozen=True)
class SweepSide:
    """A side of the board in a sweep.

    Attributes
    ----------
    number : int
        Within the placement.
    name : str
        Of the board's edge; empty where it has none.
    crossed : recarray
        Where the scan crosses it: rows of the edges of a BoardScan.
    across : bool
        Whether it was found across the scan lines.
    straight : ScanSide or None
        None for a single shot, which shows one point.
    """

    number: int
    name: str
    crossed: np.recarray
    across: bool
    straight: ScanSide | None

    @property
    def length(self) -> float:
        """Of the stretch that the sweep shows, metres."""
        return self.straight.length if self.straight else 0.0


def sides_of(scan: BoardScan, variant: str = "half_step") -> list[SweepSide]:
    """The sides of the board in a sweep, those found along the scan lines first.

    Parameters
    ----------
    scan : BoardScan
        With its edges.
    variant : {'half_step', 'last_beam'}

    Returns
    -------
    list of SweepSide
    """
    edges = scan.edges[variant]
    sides = []
    for number in np.unique(edges.side[edges.side >= 0]).tolist():
        straight = scan.side_of.get(number)
        across = straight is not None and straight.across
        sides.append(
            SweepSide(
                number=number,
                name=scan.names.get(number, ""),
                crossed=edges[(edges.side == number) & (edges.across == across)],
                across=across,
                straight=straight,
            )
        )
    return sorted(sides, key=lambda side: side.across)


def named_sides(
    prepared: Prepared, placement: int, variant: str = "half_step", stretch: float = 0.0
) -> Iterator[SweepSide]:
    """The sides of a placement that have names, one by one.

    Parameters
    ----------
    prepared : Prepared
    placement : int
    variant : {'half_step', 'last_beam'}
    stretch : float
        Share of an edge that the sweep must show.

    Yields
    ------
    SweepSide
    """
    for side in sides_of(prepared.scans[placement], variant):
        if side.name and side.length >= stretch * prepared.board.lengths()[side.name]:
            yield side


def _boards_in_images(posed, corners):
    """What the images of one camera show of the board and its so many corners of the pattern:
    columns by name.
    """
    unseen = np.full((corners, 2), np.nan)
    for placement, view in posed.items():
        yield {
            "board_poses": [view.T_camera_board.as_matrix()],
            "placements": placement,
            "board_covariance": [view.covariance],
            "pattern_pixels": [unseen if view.pixels is None else view.pixels],
        }


def _face(source, scan, count):
    """At most `count` points of a board's face: columns by name."""
    p_lrf, pitch, covariance = face_points(scan, count)
    return {
        "points": source.points(p_lrf, pitch),
        "covariance": source.covariance(covariance, pitch),
        "pitch": pitch,
        "placement": source.placement,
    }


def _one_scan_line(features, view, sides):
    """The paper's choice: of the two edges of `features`, the points of the middle one of the lines
    crossing both.
    """
    sides = [
        side
        for side in sides
        if side.name in features and view.edge(side.name) and not side.across
    ]
    if len(sides) != 2:
        return
    both = np.intersect1d(*(side.crossed.line for side in sides))
    middle = both[len(both) // 2 :][:1]
    for side in sides:
        yield replace(side, crossed=side.crossed[np.isin(side.crossed.line, middle)])


def _crossings(prepared, view, source, sides, count):
    """At most `count` crossings of each named side with the image line of the same edge."""
    middle = np.mean(prepared.scans[source.placement].sweep.pitch)
    for side in sides:
        edge = view.edge(side.name)
        if edge is None:
            continue
        crossed = thin(side.crossed, count)
        p_lrf = crossed.points
        pitch = crossed.pitch
        sigma_pitch = prepared.pitch_noise.sigma(pitch, middle)
        by_pitch = source.by_pitch(p_lrf, pitch) * sigma_pitch[:, None]
        pitch_error = dyads(by_pitch)
        yield {
            "points": source.points(p_lrf, pitch),
            "pitch": pitch,
            "covariance": source.covariance(crossed.covariance, pitch) + pitch_error,
            "radius": prepared.session.lrf.spot_radius(length_of(p_lrf)),
            "background": crossed.background,
            "lines": np.broadcast_to(edge.line, p_lrf.shape),
            "line_sigma": np.sqrt(edge.covariance[0, 0]),
            "placement": source.placement,
            "edge": side.name,
            "across": side.across,
        }


def _corners(prepared, view, source, variant):
    """Corners of the outline that the cloud and the image can both name: where two fitted edges
    meet.
    """
    if not prepared.scans[source.placement].swept:
        return
    board, _ = outline_of(
        prepared, source.placement, variant, source.T_head_lrf, source.corrections
    )
    names = prepared.board.edges
    for name in board.corners:
        before = names[names.index(name) - 1]
        edge = view.edge(name)
        previous = view.edge(before)
        if edge is None or previous is None:
            continue
        corner = board.corner_point(name)
        _, y, z = np.column_stack([corner, board.T_platform_plane[:, 3]])
        pitch, middle = np.arctan2(z, y)
        sigma = prepared.pitch_noise.sigma(pitch, middle)
        T_source_platform = source.T_source_platform
        error = T_source_platform.rotation.apply(sigma * np.cross(TILT_AXIS, corner))
        # not averaged down: neighbours share errors
        scatter = max(board.scatter[name], board.scatter[before])
        yield {
            "points": T_source_platform.apply(corner)[None],
            "covariance": [scatter**2 * np.eye(3) + dyads(error)],
            "pixels": [corners_of_lines(np.stack([previous.line, edge.line]))[1]],
            "sigma_px": np.sqrt(edge.covariance[0, 0] + previous.covariance[0, 0]),
            "placement": source.placement,
        }


def _feature_sides(sides):
    """The longest pair of perpendicular sides, else the longest side: tuple of SweepSide."""
    pairs = []
    for pair in combinations(sides, 2):
        one, other = (side.straight.direction for side in pair)
        if abs(one @ other) < RIGHT_ANGLE:
            pairs.append(pair)
    features = pairs or [(side,) for side in sides]
    return max(features, key=lambda it: np.prod([side.length for side in it]), default=())
