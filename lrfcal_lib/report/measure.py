"""The command ``measure``: lengths in a scene between picked places."""

from pathlib import Path

from lrfcal_lib.measure.features import with_sigma
from lrfcal_lib.measure.lengths import features_of_station, measure, read_picks
from lrfcal_lib.report.merge import NOT_ALL, joined_stations
from lrfcal_lib.report.reconstruct import open_scene
from lrfcal_lib.session.write import whole


def measure_session(
    path: str | Path,
    calibration: str | Path,
    picks: str | Path,
    out: str | Path | None = None,
    station: int | None = None,
    untrusted: bool = False,
) -> int:
    """Measure lengths between picked places, print them and write them as CSV.

    Parameters
    ----------
    path, calibration, untrusted
        See :func:`lrfcal_lib.report.reconstruct.open_scene`.
    picks : path-like
        The list that ``scene.html`` saves.
    out : path-like, optional
        ``reports/<name>/lengths.csv`` under the current folder by default.
    station : int, optional
        Whose ``scene.html`` it was; that of 'merge' unless given, and every length is then the
        weighted mean of the stations that show both its ends.

    Returns
    -------
    int
        0, or 3 where a length could not be measured.

    Raises
    ------
    ValueError
        For a file that cannot be used or written, or stations that cannot be joined.
    """
    table = read_picks(picks)
    scene = open_scene(path, calibration, None, untrusted)
    numbers = scene.stations
    if station is not None:
        if station not in numbers:
            raise ValueError(
                f"{path}: there is no station {station}; its stations are "
                f"{', '.join(map(str, numbers))}"
            )
        numbers = (station,)
    scenes = {n: features_of_station(scene.session, scene.rig, n) for n in numbers}
    poses = None
    if len(scenes) > 1:
        clouds = {n: with_sigma(each.cloud, scene.rig) for n, each in scenes.items()}
        poses = joined_stations(clouds, scene.rig, path).T_world_station
        scenes = {n: scenes[n] for n in poses}
    lengths = measure(scenes, table, poses)
    file = Path(out or scene.folder / "lengths.csv")
    with whole(file) as draft:
        lengths.to_csv(draft, index=False, float_format="%.6f")
    for row in lengths.itertuples():
        words = f"not measured, {row.problem}"
        if not row.problem:
            words = (
                f"{1000 * row.length_m:.1f} mm, 90 % in {1000 * row.low_m:.1f} to "
                f"{1000 * row.high_m:.1f}, from station {row.stations}"
            )
        print(f"{row.name}: {words}")
    measured = (lengths.problem == "").sum()
    print(f"{file}: {measured} of {len(lengths)} lengths")
    return 0 if measured == len(lengths) else NOT_ALL
