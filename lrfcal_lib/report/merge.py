"""The command ``merge``: the stations of a scene in one frame, as one cloud, and how they lie."""

import base64
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from lrfcal_lib.calibrate.cloud import Cloud
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.fit.covariance import sigma_turn_shift
from lrfcal_lib.measure.scene import station_cloud, write_scene
from lrfcal_lib.measure.stations import Joined, advice, join_stations, joined_cloud
from lrfcal_lib.plots.recording import png
from lrfcal_lib.report.reconstruct import open_scene
from lrfcal_lib.session.shown import escape
from lrfcal_lib.session.write import whole

NOT_ALL = 3  # exit code where something is left out
FRAME = (
    "The joined cloud is in the platform frame of station {}, as the calibration states it."
)
SLICE = (-0.3, 0.6)  # metres, heights of the points in the plan
ARROW = 0.35  # metres, of the view of a station in the plan
PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>Stations</title>
<style>body {{font: 15px sans-serif; margin: 2em auto; max-width: 60em}}
table {{border-collapse: collapse; margin: 1em 0}} td, th {{padding: 2px 12px; text-align: right}}
img {{max-width: 100%}}</style></head><body>
<h1>Stations</h1><p>{about}</p><p>{frame}</p>
<img alt="Stations from above" src="data:image/png;base64,{picture}">
<h2>Where they stood</h2>{stations}
<h2>Pairs</h2><p>Overlap, distance of their surfaces, and how far all pairs together put the two
from where this pair alone does.</p>{pairs}
<h2>Left out, and what to record next</h2><ul>{sentences}</ul></body></html>
"""


def merge_session(
    path: str | Path,
    calibration: str | Path,
    out: str | Path | None = None,
    untrusted: bool = False,
) -> int:
    """Join the stations of a scene and write them as one cloud.

    Parameters
    ----------
    path, calibration, out, untrusted
        See :func:`lrfcal_lib.report.reconstruct.open_scene`. The files are ``scene.ply``,
        ``.pcd``, ``.e57``, ``.html`` and ``stations.html``.

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
    scene = open_scene(path, calibration, out, untrusted)
    clouds = {n: station_cloud(scene.session, scene.rig, n) for n in scene.stations}
    joined = joined_stations(clouds, scene.rig, path)
    frame = FRAME.format(min(joined.T_world_station))
    tables = [stations_table(joined), pairs_table(joined)]
    said = [*map(str, joined.problems), *advice(joined)] or [
        "Nothing: all stations are joined, and every pair is checked by others."
    ]
    print(
        frame,
        *(table.to_string(index=False) for table in tables),
        *said,
        sep="\n",
        flush=True,
    )
    files = write_scene(
        scene.folder, scene.session, scene.rig, joined, scene.about, clouds=clouds
    )
    picture = png(stations_figure(joined, joined_cloud(clouds, joined)), dpi=110)
    stations, pairs = (table.to_html(index=False, border=0) for table in tables)
    page = scene.folder / "stations.html"
    with whole(page) as draft:
        draft.write_text(
            PAGE.format(
                about=escape(scene.about),
                frame=frame,
                picture=base64.b64encode(picture).decode(),
                stations=stations,
                pairs=pairs,
                sentences="".join(f"<li>{escape(words)}</li>" for words in said),
            )
        )
    print("written:", ", ".join(map(str, [*files, page])))
    return 0 if len(joined.T_world_station) == len(clouds) else NOT_ALL


def joined_stations(
    clouds: dict[int, Cloud], rig: CalibratedRig, path: str | Path
) -> Joined:
    """Stations with sigma in one frame; ValueError where no two of them can be joined."""
    joined = join_stations(clouds, rig)
    if len(joined.T_world_station) < 2:
        reasons = "; ".join(map(str, joined.problems))
        raise ValueError(f"{path}: no two stations can be joined: {reasons}")
    return joined


def stations_table(joined: Joined) -> pd.DataFrame:
    """Where the stations stood in the joined frame, and how well that is known."""
    rows = []
    for number, T in joined.T_world_station.items():
        turn, shift = sigma_turn_shift(joined.covariance[number])
        yaw = T.rotation.as_euler("ZYX", degrees=True)[0]
        rows.append([number, *T.translation, yaw, 1000 * shift, np.degrees(turn)])
    columns = ["station", "x_m", "y_m", "z_m", "yaw_deg", "sigma_mm", "sigma_deg"]
    return pd.DataFrame(rows, columns=columns).round(3)


def pairs_table(joined: Joined) -> pd.DataFrame:
    """How pairs of stations agree with each other, and with where all pairs together put them."""
    rows = []
    for pair in joined.pairs:
        turn, shift = joined.miss(pair)
        row = {
            "stations": f"{pair.first} and {pair.second}",
            "overlap_percent": round(100 * pair.overlap),
            "surfaces_apart_mm": 1000 * pair.rms,
            "miss_mm": 1000 * shift,
            "miss_deg": np.degrees(turn),
        }
        rows.append(row)
    return pd.DataFrame(rows).round(3)


def stations_figure(joined: Joined, cloud: Cloud) -> Figure:
    """A plan of the joined cloud with the stations and the pairs between them.

    Parameters
    ----------
    joined : Joined
    cloud : Cloud
        Of all stations, in the joined frame.

    Returns
    -------
    Figure
    """
    figure = Figure(figsize=(9, 7), layout="constrained")
    plan = figure.subplots()
    low, high = SLICE
    height = cloud.points[:, 2]
    x, y, _ = cloud.points[(height > low) & (height < high)][::3].T
    plan.plot(x, y, ".", color="0.6", ms=1)
    poses = joined.T_world_station
    for pair in joined.pairs:
        ends = [poses[pair.first].translation, poses[pair.second].translation]
        plan.plot(*np.transpose(ends)[:2], "C0-", lw=1.2)
    for number, T in poses.items():
        place, ahead = T.apply([[0, 0, 0], [0, ARROW, 0]])[:, :2]
        arrow = {"arrowstyle": "->", "color": "C3"}
        plan.annotate(number, ahead, place, color="C3", size=13, arrowprops=arrow)
    plan.set(aspect="equal", xlabel="x, m", ylabel="y, m")
    plan.set_title(
        f"Stations, where they look, and the pairs used; points {-low:.1f} m below to {high:.1f} m "
        "above the platform"
    )
    return figure
