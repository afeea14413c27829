"""Lights of a placement: what is wrong with scans and images is seen."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from shared import QUICK

from lrfcal_lib.acquire.checks import check_image, check_placement, check_scan
from lrfcal_lib.session.read import open_session


@pytest.fixture(scope="module")
def quick():
    return open_session(QUICK)


def test_good_placements_are_green(quick):
    for number in (1, 2, 3, 4):
        lights = check_placement(quick, number)
        assert [light.name for light in lights] == [
            "scan",
            "edges",
            "camera left",
            "camera right",
        ]
        assert {light.state for light in lights} == {"ok"}
    (scene,) = check_placement(quick, 5)
    assert scene.state == "ok" and "scene: 85 scan lines" in scene.text


def some(sweep, which):
    return replace(
        sweep,
        ranges=sweep.ranges[which],
        pitch=sweep.pitch[which],
        time_s=sweep.time_s[which],
    )


@pytest.mark.parametrize(("change", "state", "text"), [
    (lambda image: image, "ok", ""),
    (lambda image: cv2.GaussianBlur(image, (0, 0), 2.5), "warn", "blurred"),
    (lambda image: (image * 0.12).astype(np.uint8), "warn", "too dark"),
    (lambda image: np.clip(image * 2.5, 0, 255).astype(np.uint8), "warn", "overexposed"),
    (lambda image: (image * 0.1 + 100).astype(np.uint8), "warn", "little contrast"),
    (np.zeros_like, "bad", "no chessboard with"),
])  # fmt: skip
def test_images_that_are_blurred_dark_bright_or_empty_are_seen(quick, change, state, text):
    image = change(quick.read_image(quick.images("left", 2)[0]))
    light = check_image(image, quick.board, name="camera left")
    assert light.state == state and text in light.text and light.name == "camera left"


@pytest.mark.parametrize(("change", "state", "text"), [
    (lambda sweep: None, "bad", "no scan line with a range"),
    (lambda sweep: replace(sweep, ranges=np.random.default_rng(1).uniform(1, 9, sweep.ranges.shape)), "bad",
     "no board: "),
    (lambda sweep: some(sweep, slice(None, len(sweep.pitch) // 2)), "warn", "line hits it: sweep farther"),
    (lambda sweep: some(sweep, slice(0, None, 10)), "warn", "take a smaller step"),
])  # fmt: skip
def test_the_board_missing_cut_off_or_hardly_hit_is_seen(quick, change, state, text):
    first, *rest = check_scan(change(quick.sweep(2)), quick)
    assert first.state == state and text in first.text and bool(rest) == (state == "warn")
