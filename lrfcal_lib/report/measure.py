"""The command ``measure``: lengths in a scene between picked places."""

from pathlib import Path

from lrfcal_lib.calibrate.calibration_file import (
    load_calibration,
    refuse_untrusted,
    require_same_rig,
)
from lrfcal_lib.measure.lengths import features_of_station, measure, read_picks
from lrfcal_lib.measure.scene import stations_of
from lrfcal_lib.session.read import open_session
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
    path : path-like
        Of the session.
    calibration : path-like
        ``calibration.json`` of the same rig.
    picks : path-like
        The list that ``scene.html`` of the station saves.
    out : path-like, optional
        ``reports/<name>/lengths.csv`` under the current folder by default.
    station : int, optional
        In whose frame the places are; needed where there are several.
    untrusted : bool
        Also with a calibration whose verdict is 'no'.

    Returns
    -------
    int
        0.

    Raises
    ------
    ValueError
        For a file that cannot be used or written, or a place where there is nothing to measure.
    """
    table = read_picks(picks)
    rig = load_calibration(calibration)
    refuse_untrusted(rig, untrusted)
    session = open_session(path)
    require_same_rig(rig, session)
    numbers = stations_of(session)
    if station is None and len(numbers) == 1:
        station = numbers[0]
    if station not in numbers:
        raise ValueError(
            f"{path}: its stations are {', '.join(map(str, numbers))}: say with --station in "
            "whose scene.html the places were picked"
        )
    lengths = measure(features_of_station(session, rig, station), table)
    file = Path(out or Path("reports") / Path(path).resolve().name / "lengths.csv")
    with whole(file) as draft:
        lengths.to_csv(draft, index=False, float_format="%.6f")
    for row in lengths.to_dict("records"):
        low, high = 1000 * row["low_m"], 1000 * row["high_m"]
        print(
            f"{row['name']}: {1000 * row['length_m']:.1f} mm, 90 % in {low:.1f} to {high:.1f}"
        )
    print(f"{file}: {len(lengths)} lengths")
    return 0
