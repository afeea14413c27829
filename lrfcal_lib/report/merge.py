"""The command ``merge``: the stations of a scene in one frame, as one cloud, and how they lie."""

import base64
from io import BytesIO
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from lrfcal_lib.calibrate.cloud import Cloud
from lrfcal_lib.calibrate.rig import CalibratedRig
from lrfcal_lib.measure.scene import station_cloud, write_scene
from lrfcal_lib.measure.stations import Joined, advice, join_stations, joined_cloud
from lrfcal_lib.report.reconstruct import open_scene
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
    print(FRAME.format(min(joined.T_world_station)))
    for table in (stations_table(joined), pairs_table(joined)):
        print(table.to_string(index=False))
    print(*sentences(joined), sep="\n", flush=True)
    asked = (scene.folder, scene.session, scene.rig)
    files = write_scene(*asked, joined, scene.about, clouds=clouds)
    page = scene.folder / "stations.html"
    with whole(page) as draft:
        draft.write_text(stations_page(joined, joined_cloud(clouds, joined), scene.about))
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
        x, y, z = T.translation.round(3)
        variance = np.diag(joined.covariance_of(number))
        row = {
            "station": number,
            "x_m": x,
            "y_m": y,
            "z_m": z,
            "yaw_deg": T.rotation.as_euler("ZYX", degrees=True)[0].round(2),
            "sigma_mm": 1000 * np.sqrt(variance[3:].sum()).round(4),
            "sigma_deg": np.degrees(np.sqrt(variance[:3].sum())).round(3),
        }
        rows.append(row)
    return pd.DataFrame(rows)


def pairs_table(joined: Joined) -> pd.DataFrame:
    """How pairs of stations agree with each other, and with where all pairs together put them."""
    rows = []
    for pair in joined.pairs:
        turn, shift = joined.miss(pair)
        row = {
            "stations": f"{pair.first} and {pair.second}",
            "overlap_percent": round(100 * pair.overlap),
            "surfaces_apart_mm": round(1000 * pair.rms, 1),
            "miss_mm": round(1000 * shift, 1),
            "miss_deg": round(np.degrees(turn), 3),
        }
        rows.append(row)
    return pd.DataFrame(rows)


def sentences(joined: Joined) -> list[str]:
    """What was not joined and why, and what to record next."""
    said = [*map(str, joined.problems), *advice(joined)]
    return said or [
        "Nothing: all stations are joined, and every pair is checked by others."
    ]


def stations_page(joined: Joined, cloud: Cloud, about: str) -> str:
    """A page with the plan of the stations, residuals by pair and what to record next.

    Parameters
    ----------
    joined : Joined
    cloud : Cloud
        Of all stations, in the joined frame.
    about : str
        Where it is from.

    Returns
    -------
    str
        HTML that needs no other file.
    """
    picture = BytesIO()
    stations_figure(joined, cloud).savefig(picture, dpi=110)
    return PAGE.format(
        about=about,
        frame=FRAME.format(min(joined.T_world_station)),
        picture=base64.b64encode(picture.getvalue()).decode(),
        stations=stations_table(joined).to_html(index=False, border=0),
        pairs=pairs_table(joined).to_html(index=False, border=0),
        sentences="".join(f"<li>{words}</li>" for words in sentences(joined)),
    )


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
    label = f"points {-low:.1f} m below to {high:.1f} m above the platform"
    plan.plot(x, y, ".", color="0.6", ms=1, label=label)
    for pair in joined.pairs:
        ends = [joined.T_world_station[n].translation for n in (pair.first, pair.second)]
        plan.plot(*np.transpose(ends)[:2], "-", color="C0", lw=1.2)
    places = np.array([T.translation for T in joined.T_world_station.values()])
    ahead = np.array(
        [T.rotation.apply([0, ARROW, 0]) for T in joined.T_world_station.values()]
    )
    plan.quiver(
        *places.T[:2], *ahead.T[:2], color="C3", angles="xy", scale_units="xy", scale=1
    )
    words = "stations, and where they look at pitch 0"
    plan.plot(*places.T[:2], "o", color="C3", ms=4, label=words)
    for number, beside in zip(joined.T_world_station, places - 0.4 * ahead, strict=True):
        plan.annotate(
            f"{number}", beside[:2], color="C3", fontsize=13, ha="center", va="center"
        )
    plan.plot([], [], "-", color="C0", label="pairs used")
    plan.set(aspect="equal", xlabel="x, m", ylabel="y, m", title="Stations from above")
    figure.legend(loc="outside upper center", ncols=3, markerscale=2, fontsize=9)
    return figure
