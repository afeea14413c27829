"""Loops are shared in order, whoever works, and no worker outlives the process that it works for."""

import os
import pickle
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from multiprocessing import active_children, get_context
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform
from shared import ROOT, until

from lrfcal_lib.session import workers
from lrfcal_lib.session.workers import side_by_side, spread


@pytest.fixture
def two(monkeypatch):
    """Two processors, whatever this machine has, and no threads, which other tests may leave."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1}, raising=False)
    monkeypatch.setattr(workers.threading, "active_count", lambda: 1)


def test_a_loop_is_shared_in_order(two, tmp_path):
    def work(i):
        (tmp_path / str(os.getpid())).touch()
        until(lambda: len(list(tmp_path.iterdir())) == 2)  # both take part
        return i

    with side_by_side():
        assert spread(work, range(10)) == list(range(10))
        assert spread(lambda i: spread(lambda k: k + i, range(3)), range(2)) == [
            [0, 1, 2],
            [1, 2, 3],
        ]
        assert spread(abs, []) == [] and spread(abs, [-1]) == [1]


def test_poses_travel_to_the_last_digit():
    poses = RigidTransform.from_exp_coords(np.random.default_rng(0).normal(size=(500, 6)))
    there = pickle.loads(pickle.dumps(poses * poses[::-1]))
    np.testing.assert_array_equal(there.as_matrix(), (poses * poses[::-1]).as_matrix())


def process_of(item, here):
    """The process that works on this: twice in one and the same, for one of the loops within."""
    return len({os.getpid(), *spread(getpid_of, range(3))}), os.getpid() == here


def getpid_of(item):
    return os.getpid()


@pytest.mark.parametrize(
    "make",
    [partial(ProcessPoolExecutor, 2, get_context("spawn")), partial(ThreadPoolExecutor, 2)],
)
def test_an_executor_of_the_caller_does_the_work_and_is_left_alone(make):
    with make() as executor:
        with side_by_side(executor):
            done = spread(partial(process_of, here=os.getpid()), range(3))
        assert done == [(1, isinstance(executor, ThreadPoolExecutor))] * 3
        assert executor.submit(abs, -1).result() == 1


def test_outside_nothing_is_shared(two):
    assert spread(partial(process_of, here=os.getpid()), range(3)) == [(1, True)] * 3


def test_a_process_with_threads_is_not_forked(two, monkeypatch):
    monkeypatch.setattr(workers.threading, "active_count", lambda: 2)
    with side_by_side():
        assert spread(partial(process_of, here=os.getpid()), range(3)) == [(1, True)] * 3


def end_elsewhere(item, here):
    time.sleep(0.01)
    if os.getpid() != here:
        os._exit(1)  # as if the kernel had ended it
    return item


def test_what_a_dead_worker_did_not_do_is_done_here(two):
    with side_by_side():
        assert spread(partial(end_elsewhere, here=os.getpid()), range(6)) == list(range(6))
    with ProcessPoolExecutor(2) as executor, side_by_side(executor):
        assert spread(partial(end_elsewhere, here=os.getpid()), range(6)) == list(range(6))


def test_errors_and_ctrl_c_reach_the_caller_and_end_the_workers(two):
    def fail(i):
        if i == 1:
            raise ValueError(f"item {i}")
        time.sleep(0.05)
        return i

    def interrupt(i):
        if os.getpid() != parent:
            os.kill(parent, signal.SIGINT)
        time.sleep(600)

    parent = os.getpid()
    with side_by_side():
        with pytest.raises(ValueError, match="item 1"):
            spread(fail, range(6))
        with pytest.raises(KeyboardInterrupt):
            spread(interrupt, range(2))
    assert active_children() == []


LONG = """
import sys, os, time
from lrfcal_lib.session.workers import side_by_side, spread
os.sched_getaffinity = lambda pid: {0, 1}

def work(item):
    open(os.path.join(sys.argv[1], str(os.getpid())), "w").close()
    time.sleep(600)

if __name__ == "__main__":
    with side_by_side():
        spread(work, range(4))
"""


def alive(number):
    """Whether a process is there that has not ended."""
    try:
        return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.skipif(not Path("/proc/self/stat").is_file(), reason="looks into /proc")
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_no_worker_outlives_its_parent(tmp_path, how):
    (program := tmp_path / "long.py").write_text(LONG)
    (folder := tmp_path / "workers").mkdir()
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, program, folder]
    parent = subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)
    until(lambda: len(os.listdir(folder)) == 2)
    parent.send_signal(how)
    assert parent.wait() != 0
    until(lambda: not any(map(alive, os.listdir(folder))), longest_s=10.0)
