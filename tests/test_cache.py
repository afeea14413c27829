"""Stages are worked out once, and again as soon as anything that they depend on is different."""

import os
import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from shared import QUICK

from lrfcal_lib.session import cache
from lrfcal_lib.session.read import open_session


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv(cache.VARIABLE, str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def session(tmp_path):
    return open_session(shutil.copytree(QUICK, tmp_path / "quick"))


class Stage:
    """A stage that knows how often it was worked out."""

    def __init__(self):
        self.calls = 0

        def stage(session, *args, **options):
            """Counts."""
            self.calls += 1
            if "fail" in options:
                raise ValueError("no board")
            return {"count": self.calls, "values": np.arange(3.0)}

        self.run = cache.cached(stage)


def test_the_same_is_worked_out_once(folder, session):
    stage = Stage()
    first = stage.run(session, 1, joint=True)
    again = stage.run(open_session(session.path), 1, joint=True)
    assert stage.calls == again["count"] == 1 and np.array_equal(
        first["values"], again["values"]
    )
    assert sorted(file.suffix for file in folder.iterdir()) == [".lock", ".pickle"]


def test_what_is_kept_is_read_without_writing(folder, session):
    """A folder of root's may be read by others."""
    stage = Stage()
    stage.run(session)
    for lock in folder.glob("*.lock"):
        lock.unlink()
    stage.run(session)
    assert stage.calls == 1 and list(folder.glob("*.lock")) == []


def test_nothing_is_kept_unless_a_folder_is_named(session, tmp_path, monkeypatch):
    monkeypatch.delenv(cache.VARIABLE, raising=False)
    stage = Stage()
    stage.run(session), stage.run(session)
    assert stage.calls == 2 and list(tmp_path.rglob("*.pickle")) == []


def other_scan(session, patch):
    session.scans["ranges"][0, 0] += 0.001


def other_image(session, patch):
    file = Path(session.image_records[-1].file)
    file.write_bytes(file.read_bytes() + b"\0")


OTHERS = {  # arguments of the second call, or what is changed before it
    "argument": (2,), "option": (1, "joint"), "scan": other_scan, "image": other_image,
    "missing image": lambda session, patch: Path(session.image_records[0].file).unlink(),
    "statement": lambda session, patch: replace(session, platform_sigma=(0.1, 0.1)),
    "library": lambda session, patch: patch.setattr(cache, "source_digest", lambda: "another version"),
}  # fmt: skip


@pytest.mark.parametrize("other", OTHERS.values(), ids=OTHERS)
def test_what_is_different_is_worked_out_again(folder, session, monkeypatch, other):
    stage = Stage()
    stage.run(session, 1)
    if isinstance(other, tuple):
        stage.run(session, other[0], **dict.fromkeys(other[1:], True))
    else:
        stage.run(other(session, monkeypatch) or session, 1)
    assert stage.calls == 2


@pytest.mark.parametrize("mode", [0o777, 0o1777, 0o775, 0o702])
def test_a_folder_that_others_may_write_to_is_refused(folder, session, mode):
    folder.mkdir()
    folder.chmod(mode)
    stage = Stage()
    with pytest.raises(
        ValueError, match=f"others may write to '{folder}' .*mode {mode:o}.*chmod go-w"
    ):
        stage.run(session)
    folder.chmod(0o755)
    stage.run(session)
    assert stage.calls == 1


def owned_by_nobody(kept, patch):
    if os.geteuid():
        pytest.skip("only root can give files away")
    os.chown(kept, 65534, 65534)


def linked(kept, patch):
    kept.rename(kept.parents[1] / "elsewhere")
    kept.symlink_to(kept.parents[1] / "elsewhere")


FOREIGN = {
    "others may write to .*owner 65534": owned_by_nobody, "is a link, not a file": linked,
    "others may write to .*mode 666.*chmod go-w": lambda kept, patch: kept.chmod(0o666),
    "others may write to .*mode 620.*chmod go-w": lambda kept, patch: kept.chmod(0o620),
    "others may rename what is in .*mode 777.*chmod go-w": lambda kept, patch: kept.parents[1].chmod(0o777),
}  # fmt: skip


@pytest.mark.parametrize("told", FOREIGN)
def test_what_is_not_ours_is_not_unpickled(folder, session, monkeypatch, told):
    stage = Stage()
    stage.run(session)
    (kept,) = folder.glob("*.pickle")
    kept.write_bytes(b"cos\nabort\n(tR.")  # ends this process where it is unpickled
    FOREIGN[told](kept, monkeypatch)
    with pytest.raises(ValueError, match=told):
        stage.run(session)


def test_of_two_at_the_same_time_the_second_waits(folder, session):
    stage = Stage()
    slow = cache.cached(lambda of: time.sleep(0.2) or stage.run.__wrapped__(of))
    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(slow, [session, session]))
    assert stage.calls == 1 and [one["count"] for one in found] == [1, 1]


def test_what_was_made_of_a_session_can_be_the_first_argument(folder, session):
    stage = Stage()
    for shift in (0.0, 0.0, 0.001):
        stage.run(SimpleNamespace(prepared=SimpleNamespace(session=session), shift=shift))
    assert stage.calls == 2
