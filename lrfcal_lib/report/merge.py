"""The command ``merge``: the stations of a scene in one frame, as one cloud, and how they lie."""

from pathlib import Path
from textwrap import fill

import numpy as np
from matplotlib.figure import Figure

from lrfcal_lib.calibrate.calibration_file import (
    load_calibration,
    refuse_untrusted,
    require_same_rig,
)
from lrfcal_lib.calibrate.cloud import Cloud, join
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.measure.features import with_sigma
from lrfcal_lib.measure.scene import Station, colored_blocks, stations_of, write_scene
from lrfcal_lib.measure.stations import Joined, advice, join_stations, joined_cloud
from lrfcal_lib.preprocess.closing_scan import without_closing
from lrfcal_lib.report.reconstruct import about_scene
from lrfcal_lib.session.read import Session, open_session
from lrfcal_lib.session.write import whole

NOT_ALL = 3  # exit code where stations are left out
FRAME = (
    "the joined cloud is in the platform frame of station {}, as the calibration states it"
)
SLICE = (-0.3, 0.6)  # metres, heights of the points in the plan
WIDTH = 150  # letters a line under the plan
ARROW = 0.35  # metres, of the view of a station in the plan


def merge_session(
    path: str | Path,
    calibration: str | Path,
    out: str | Path | None = None,
    untrusted: bool = False,
) -> int:
    """Join the stations of a scene and write them as one cloud.

    Parameters
    ----------
    path : path-like
        Of the session.
    calibration : path-like
        ``calibration.json`` of the same rig.
    out : path-like, optional
        Folder of ``scene.ply``, ``.pcd``, ``.e57``, ``.html`` and ``stations.png``;
        ``reports/<name>`` under the current folder by default.
    untrusted : bool
        Also with a calibration whose verdict is 'no', which every file then says.

    Returns
    -------
    int
        0, or 3 where stations are left out.

    Raises
    ------
    ValueError
        Where no two stations can be joined, for a calibration or a session that cannot be used, or
        a file that cannot be written.
    """
    rig = load_calibration(calibration)
    refuse_untrusted(rig, untrusted)
    session = open_session(path)
    require_same_rig(rig, session)
    clouds = {n: plain_cloud(session, rig, n) for n in stations_of(session)}
    joined = join_stations(clouds, rig)
    if len(joined.T_world_station) < 2:
        reasons = "; ".join(map(str, joined.problems))
        raise ValueError(f"{path}: no two stations can be joined: {reasons}")
    print(*sentences(joined), sep="\n", flush=True)
    folder = Path(out or Path("reports") / Path(path).resolve().name)
    about = about_scene(session, rig)
    files = write_scene(folder, session, rig, joined.T_world_station, about)
    with whole(folder / "stations.png") as draft:
        stations_figure(joined, joined_cloud(clouds, joined)).savefig(draft, dpi=110)
    print("written:", ", ".join(map(str, [*files, folder / "stations.png"])))
    return 0 if len(joined.T_world_station) == len(clouds) else NOT_ALL


def plain_cloud(session: Session, rig: CalibratedRig, number: int) -> Cloud:
    """A station without colours, with sigma."""
    sweep, _ = without_closing(session.sweep(number))
    blocks = colored_blocks(session, rig, Station(number, sweep, []))
    return join(with_sigma(block, rig) for block in blocks)


def sentences(joined: Joined) -> list[str]:
    """What was joined and how well, what was not and why, and what to record next."""
    first, *others = joined.T_world_station
    said = [FRAME.format(first)]
    for number in others:
        x, y, z = joined.T_world_station[number].translation
        turn, shift = _sigma(joined.covariance_of(number))
        yaw = joined.T_world_station[number].rotation.as_euler("ZYX", degrees=True)[0]
        said.append(
            f"station {number}: at ({x:.3f}, {y:.3f}, {z:.3f}) m, turned by {yaw:.1f} deg, "
            f"known to {1000 * shift:.1f} mm and {np.degrees(turn):.3f} deg (1 sigma)"
        )
    said += [_of_pair(joined, pair) for pair in joined.pairs]
    return [*said, *map(str, joined.problems), *advice(joined)]


def _of_pair(joined, pair):
    """How two stations agree with each other and with all others, a sentence."""
    turn, shift = joined.miss(pair)
    return (
        f"stations {pair.first} and {pair.second}: {100 * pair.overlap:.0f} % overlap, surfaces "
        f"{1000 * pair.rms:.1f} mm apart; {1000 * shift:.1f} mm and {np.degrees(turn):.3f} deg "
        "from where all pairs together put them"
    )


def _sigma(covariance):
    """Standard deviations of the length of a turn (radians) and of a shift (metres)."""
    variance = np.diag(covariance)
    return np.sqrt(variance[:3].sum()), np.sqrt(variance[3:].sum())


def stations_figure(joined: Joined, cloud: Cloud) -> Figure:
    """A plan of the joined cloud with stations and the pairs between them, and what is said of
    them.

    Parameters
    ----------
    joined : Joined
    cloud : Cloud
        Of all stations, in the joined frame.

    Returns
    -------
    Figure
    """
    figure = Figure(figsize=(11, 9.5), layout="constrained")
    plan, words = figure.subplots(2, 1, height_ratios=[3, 1])
    low, high = SLICE
    height = cloud.points[:, 2]
    thin = cloud.points[(height > low) & (height < high)][::3]
    label = f"points {-low:.1f} m below to {high:.1f} m above the platform"
    plan.plot(thin[:, 0], thin[:, 1], ".", color="0.6", ms=1, label=label)
    places = {n: T.translation[:2] for n, T in joined.T_world_station.items()}
    for pair in joined.pairs:
        ends = np.array([places[pair.first], places[pair.second]])
        plan.plot(*ends.T, "-", color="C0", lw=1.2)
    for number, T in joined.T_world_station.items():
        ahead = T.rotation.apply([0.0, ARROW, 0.0])[:2]
        plan.annotate(
            "",
            places[number] + ahead,
            places[number],
            arrowprops={"color": "C3", "width": 1},
        )
        beside = places[number] - 0.4 * ahead
        plan.annotate(
            f"{number}", beside, color="C3", fontsize=13, ha="center", va="center"
        )
    dots = np.array(list(places.values())).T
    plan.plot(
        *dots, "o", color="C3", ms=4, label="stations, and where they look at pitch 0"
    )
    plan.plot([], [], "-", color="C0", label="pairs used")
    plan.set(aspect="equal", xlabel="x, m", ylabel="y, m", title="Stations from above")
    figure.legend(loc="outside upper center", ncols=3, markerscale=2, fontsize=9)
    words.axis("off")
    lines = [fill(sentence, WIDTH) for sentence in sentences(joined)]
    words.text(0, 1, "\n".join(lines), fontsize=9, va="top")
    return figure
