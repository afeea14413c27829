"""What the first screen of a report shows: verdict, picture, numbers, the poses to use."""

import json

import numpy as np
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


def main_verdict(verdicts):
    """The verdict that stands first: one with a record, else any; None without."""
    return max(verdicts, key=lambda entry: entry["record"] is not None, default=None)


def sentences_below(verdict):
    """Sentences of a verdict that the first screen does not tell in numbers."""
    if verdict is None:
        return []
    errors = (verdict["record"] or {}).get("expected_error_at_m", {})
    # the answer comes first, then a sentence for each distance
    return verdict["sentences"][1 + len(errors) :]


def first_picture(drawn):
    """The figure of the first screen, as HTML; '' where no notebook drew one of them."""
    figures = {}
    for of_notebook, _ in drawn.values():
        figures |= of_notebook
    return next(filter(None, map(figures.get, PICTURES)), "")


def headline(out, verdict):
    """Numbers of the first screen as far as there are any, by kind: expected errors, edges."""
    numbers = {}
    if verdict and verdict["record"] and verdict["record"]["expected_error_at_m"]:
        errors = pd.DataFrame(verdict["record"]["expected_error_at_m"])
        numbers["cloud"] = dict(errors.loc["cloud_mm"])
        numbers["image"] = dict(errors.drop("cloud_mm").max())
        numbers["known"] = _known_share(out / "tables" / "placements.csv")
    if (out / "tables" / "edge_lengths.csv").is_file():
        numbers["edges"] = _edge_numbers(pd.read_csv(out / "tables" / "edge_lengths.csv"))
    return numbers


def handed_over(file):
    """The poses that a calibration file hands over, as words by camera; None without a file."""
    if not file.is_file():
        return None
    record = json.loads(file.read_text())
    poses = {}
    for name, camera in record["cameras"].items():
        values = POSE_UNITS * [*camera["rotvec_rad"], *camera["translation_m"]]
        sigmas = POSE_UNITS * np.array(list(camera["sigma"].values()), float)
        poses[name] = [
            f"{value:z.{n}f} ± {sigma:.{n}f}"
            for value, sigma, n in zip(values, sigmas, POSE_DIGITS, strict=True)
        ]
    sources = {camera["maps"].split(" to ")[0] for camera in record["cameras"].values()}
    return {"method": record["method"], "poses": poses, "sources": sorted(sources)}


def _known_share(file):
    """How well a standard deviation from n placements is known: to one part in sqrt(2 (n - 1))."""
    used = 0
    if file.is_file():
        used = pd.read_csv(file).used.sum()
    return (2 * (used - 1)) ** -0.5 if used > 1 else 0.0


def _edge_numbers(lengths):
    """Number, mean absolute error and its scatter of measured edges, the best way; {} without.

    Those of all edges too, where some have an end that no image shows, and those of the paper's
    rule.
    """
    lengths = lengths.dropna(subset="error_mm")
    lengths = lengths.assign(error=lengths.error_mm.abs())
    own = lengths[lengths.source != "paper"]
    best = next((way for way in MEASURED if (own.variant == way).any()), None)
    if best is None:
        return {}
    every = own[own.variant == best]
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
        "paper": lengths[lengths.source == "paper"].error.mean(),
    }
