"""Stages are worked out once, and again as soon as anything that they depend on is different."""

import os
import pickle
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lrfcal_lib.preprocess.prepared import prepare_scans
from lrfcal_lib.session import cache
from lrfcal_lib.session.read import open_session

QUICK = Path(__file__).resolve().parents[1] / "data" / "sim_quick"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv(cache.VARIABLE, str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def session(tmp_path):
    shutil.copytree(QUICK, tmp_path / "quick")
    return open_session(tmp_path / "quick")


@pytest.fixture
def calls():
    return []


@pytest.fixture
def stage(calls):
    @cache.cached
    def stage(session, *args, **options):
        """Says so."""
        calls.append((args, options))
        return {"count": len(calls), "values": np.arange(3.0)}

    return stage


def test_the_same_is_worked_out_once(folder, session, stage, calls):
    first, again = stage(session, 1, joint=True), stage(open_session(session.path), 1, joint=True)
    assert len(calls) == 1 and again["count"] == 1 and np.array_equal(first["values"], again["values"])
    assert [file.suffix for file in folder.iterdir()] == [".pickle"]


def test_nothing_is_kept_unless_a_folder_is_named(session, stage, calls, tmp_path, monkeypatch):
    monkeypatch.delenv(cache.VARIABLE, raising=False)
    stage(session), stage(session)
    assert len(calls) == 2 and list(tmp_path.rglob("*.pickle")) == []


def other_argument(session, stage, monkeypatch):
    stage(session, 2)


def other_option(session, stage, monkeypatch):
    stage(session, 1, joint=True)


def other_statement(session, stage, monkeypatch):
    stage(replace(session, platform_sigma=(0.1, 0.1)), 1)


def other_scan(session, stage, monkeypatch):
    session.scans["ranges"][0, 0] += 0.001
    stage(session, 1)


def other_image(session, stage, monkeypatch):
    file = Path(session.image_records[-1].file)
    file.write_bytes(file.read_bytes() + b"\0")
    stage(session, 1)


def missing_image(session, stage, monkeypatch):
    Path(session.image_records[0].file).unlink()
    stage(session, 1)


def other_library(session, stage, monkeypatch):
    monkeypatch.setattr(cache, "library", lambda: b"another version")
    stage(session, 1)


OTHERS = (other_argument, other_option, other_statement, other_scan, other_image, missing_image, other_library)


@pytest.mark.parametrize("other", OTHERS, ids=lambda other: other.__name__)
def test_what_is_different_is_worked_out_again(folder, session, stage, calls, monkeypatch, other):
    session = replace(session, scans={key: values.copy() for key, values in session.scans.items()})
    stage(session, 1)
    other(session, stage, monkeypatch)
    assert len(calls) == 2


@pytest.mark.parametrize("mode", [0o777, 0o1777, 0o775, 0o702])
def test_a_folder_that_others_may_write_to_is_refused(folder, session, stage, calls, mode):
    folder.mkdir()
    folder.chmod(mode)
    with pytest.raises(ValueError, match=f"others may write to '{folder}' .*mode {mode:o}.*chmod go-w"):
        stage(session)
    folder.chmod(0o755)
    stage(session)
    assert len(calls) == 1


def test_a_folder_of_somebody_else_is_refused(folder, session, stage, monkeypatch):
    folder.mkdir()
    found = folder.stat()
    monkeypatch.setattr(cache.os, "geteuid", lambda: found.st_uid + 1)
    if found.st_uid == 0:  # who may write anywhere
        os.chown(folder, 1, -1)
        monkeypatch.setattr(cache.os, "geteuid", lambda: 0)
    with pytest.raises(ValueError, match="others may write"):
        stage(session)


def test_the_folder_is_made_for_oneself(folder, session, stage):
    before = os.umask(0)
    try:
        stage(session)
    finally:
        os.umask(before)
    assert folder.stat().st_mode & 0o777 == 0o700


def test_a_stage_that_fails_leaves_nothing(folder, session):
    @cache.cached
    def fails(session):
        raise ValueError("no board")

    for _ in range(2):
        with pytest.raises(ValueError, match="no board"):
            fails(session)
    assert not folder.exists()


def test_a_kept_stage_is_the_stage_itself(folder, session):
    fresh, kept = prepare_scans(session), prepare_scans(session)
    assert kept is not fresh and pickle.dumps(kept) == pickle.dumps(pickle.loads(pickle.dumps(fresh)))
    assert prepare_scans.__doc__.startswith("The board in every sweep") and list(kept.scans) == list(fresh.scans)
