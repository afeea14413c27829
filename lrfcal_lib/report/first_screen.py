"""What the first screen of a report shows: verdict, picture, numbers, the poses to use."""

import json
from contextlib import suppress

import pandas as pd

from lrfcal_lib.model.geometry import POSE_UNITS

PICTURES = (
    "scene",
    "cloud",
    "clouds_of_boards",
    "frames",
)  # of the first screen, the best first
# of rotation vector, degrees, and translation, millimetres
POSE_DIGITS = (2, 2, 2, 1, 1, 1)
MEASURED = ("combined", "half_step", "last_beam")  # edge lengths, the best way first
NO_VERDICT = {"sentences": [], "record": None}


def first_screen(out, verdicts, figures):
    """What the first screen of a report in a folder shows, by the names of its template."""
    # the one with a record, else any
    main = max(verdicts, key=lambda entry: bool(entry["record"]), default=NO_VERDICT)
    errors = (main["record"] or {}).get("expected_error_at_m", {})
    return {
        "main": main,
        # the answer comes first, then a sentence for each distance, which numbers tell
        "rest": main["sentences"][1 + len(errors) :],
        "picture": next(filter(None, map(figures.get, PICTURES)), ""),
        "headline": headline(out / "tables", errors),
        "handed": handed_over(out / "calibration.json"),
    }


def headline(tables, errors):
    """Numbers as far as there are any, by kind: expected errors, by distance, and edges."""
    numbers = {}
    if errors:
        expected = pd.DataFrame(errors)
        numbers["cloud"] = dict(expected.loc["cloud_mm"])
        numbers["image"] = dict(expected.drop("cloud_mm").max())
        with suppress(FileNotFoundError):
            used = pd.read_csv(tables / "placements.csv").used.sum()
            if used > 1:  # to this part n placements tell a standard deviation
                numbers["known"] = (2 * (used - 1)) ** -0.5
    with suppress(FileNotFoundError):
        numbers["edges"] = _edge_numbers(pd.read_csv(tables / "edge_lengths.csv"))
    return numbers


def handed_over(file):
    """The poses that a calibration file hands over, as words by camera; None without a file."""
    if not file.is_file():
        return None
    record = json.loads(file.read_text())
    poses = {}
    for name, camera in record["cameras"].items():
        values = POSE_UNITS * [*camera["rotvec_rad"], *camera["translation_m"]]
        sigmas = POSE_UNITS * pd.Series(camera["sigma"], dtype=float)
        poses[name] = [
            f"{value:z.{n}f} ± {sigma:.{n}f}"
            for value, sigma, n in zip(values, sigmas, POSE_DIGITS, strict=True)
        ]
    sources = {camera["maps"].split(" to ")[0] for camera in record["cameras"].values()}
    return {"method": record["method"], "poses": poses, "sources": sorted(sources)}


def _edge_numbers(lengths):
    """Number, mean absolute error and its scatter of measured edges, the best way; {} without.

    Those of all edges too, where some have an end that no image shows, and those of the paper's
    rule.
    """
    lengths = lengths.assign(error=lengths.error_mm.abs()).dropna(subset="error")
    of_paper = lengths.source == "paper"
    own = lengths[~of_paper]
    if own.empty:
        return {}
    every = own[own.variant == min(own.variant, key=MEASURED.index)]
    part = every[every.ends == "image"]
    if part.empty:
        part = every
    by_paper = own[(own.variant == "last_beam") & (own.ends == "scan")]
    return {
        "n": len(part),
        "mean": part.error.mean(),
        "sigma": part.groupby("placement").error.mean().sem(),
        "every_n": len(every),
        "every": every.error.mean(),
        "rule_n": len(by_paper),
        "rule": by_paper.error.mean(),
        "paper": lengths[of_paper].error.mean(),
    }
