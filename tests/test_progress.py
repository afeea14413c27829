"""How long something will still take, in words."""

import pytest

from lrfcal_lib.session.progress import LINE_S, Progress, duration


def test_what_is_left_follows_from_what_is_done():
    now = [100.0]
    progress = Progress(lambda: now[0])
    assert progress.left(0.0) == ""
    now[0] += 30.0
    assert progress.seconds == 30.0
    assert progress.left(0.25) == "about 90 s left"
    assert progress.left(0.1) == "about 4 min left"  # 270 s
    assert progress.left(1.0) == ""


def test_a_line_is_due_now_and_then():
    now = [0.0]
    progress = Progress(lambda: now[0])
    told = []
    for _ in range(7):
        now[0] += LINE_S / 2
        told.append(progress.due())
    assert told == [False, True, False, True, False, True, False]


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.4, "0 s"), (99.0, "99 s"), (100.0, "2 min"), (3600.0, "60 min")],
)
def test_durations_in_words(seconds, words):
    assert duration(seconds) == words
