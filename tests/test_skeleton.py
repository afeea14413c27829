"""The promises of the top-level files."""

import re
import shutil
import subprocess
import tomllib

import pytest
import yaml
from shared import ROOT

LISTED = (ROOT / "environment.txt").read_text()
REASONS = dict(re.findall(r"^#   (\S+) +(\w+)$", LISTED, re.MULTILINE))
PINS = re.sub(r"^#.*\n|\\\n", "", LISTED, flags=re.MULTILINE).split("\n")[1:-1]
WORKFLOW = yaml.safe_load((ROOT / ".github" / "workflows" / "test.yml").read_text())


def normal(name):
    return re.sub(r"[-_.]+", "-", name).lower()


def test_every_package_is_pinned_with_its_sums_once_and_direct_ones_say_why():
    pin = re.compile(r"[A-Za-z0-9._-]+==\d[\w.]*( +--hash=sha256:[0-9a-f]{64}){1,4}")
    assert [line for line in PINS if not pin.fullmatch(line)] == []
    names = [line.split("==")[0] for line in PINS]
    assert len(set(map(normal, names))) == len(names) > 100
    assert len(REASONS) >= 15 and REASONS.keys() <= set(names)


def test_pip_takes_no_file_without_a_listed_sum():
    lines = (ROOT / ".ci" / "setup").read_text().splitlines()
    installs = [
        line for line in lines if re.search(r"pip[_ ]install ", line) and '"$@"' not in line
    ]
    own = [line for line in installs if line.endswith(" -e .")]
    assert len(own) == 1 and len(installs) == 3
    assert all("--require-hashes" in line for line in installs if line not in own)


@pytest.mark.parametrize("job", WORKFLOW["jobs"])
def test_the_workflow_runs_fixed_actions_without_rights(job):
    assert (
        WORKFLOW["permissions"] == {"contents": "read"}
        and "permissions" not in WORKFLOW["jobs"][job]
    )
    actions = [step for step in WORKFLOW["jobs"][job]["steps"] if "uses" in step]
    assert actions and all(
        re.fullmatch(r"actions/[\w-]+@[0-9a-f]{40}", step["uses"]) for step in actions
    )
    assert actions[0]["with"] == {"persist-credentials": False}


def test_the_workflow_runs_what_takes_long_once_a_week():
    assert WORKFLOW[True]["schedule"]  # YAML reads "on" so
    runs = " ".join(step.get("run", "") for step in WORKFLOW["jobs"]["long"]["steps"])
    targets = WORKFLOW["jobs"]["long"]["strategy"]["matrix"]["command"]
    assert (
        targets == ["make campaign", "make fuzz", ".ci/recordings"]
        and "${{ matrix.command }}" in runs
    )


def test_what_the_package_needs_is_pinned():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    extras = project["project"]["optional-dependencies"]
    assert extras.pop("bench") == ["gtsam"]  # who wants the comparison installs it
    needs = project["project"]["dependencies"] + sum(extras.values(), [])
    needs += project["build-system"]["requires"]
    pinned = {normal(line.split("==")[0]) for line in PINS}
    assert {normal(re.match(r"[\w.-]+", need)[0]) for need in needs} <= pinned


def git(*arguments):
    """Lines that git prints; skips the test where there is no checkout."""
    done = subprocess.run(
        ["git", "-C", str(ROOT), *arguments], capture_output=True, text=True
    )
    if done.returncode:
        pytest.skip("no git checkout")
    return done.stdout.splitlines()


FAKE_PYTHON = """
echo "python $*" >>calls
case "$*" in
    *'-m venv'*) mkdir -p .venv/bin && cp "$0" .venv/bin/python ;;
    -) [ -z "$MISSING" ] || echo "$MISSING" ;;
esac
"""


def write_command(path, script):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("#!/bin/bash\n" + script)
    path.chmod(0o755)


@pytest.fixture
def run_setup(tmp_path):
    """Runs .ci/setup in a copy of what it needs, with stand-ins for the interpreter and other commands."""
    write_command(tmp_path / "bin" / "python3", FAKE_PYTHON)
    (tmp_path / ".ci").mkdir()
    for name in ("environment.txt", ".ci/setup"):
        shutil.copy(ROOT / name, tmp_path / name)

    def run(missing="", **commands):
        for name, script in commands.items():
            write_command(tmp_path / "bin" / name, script)
        environment = {
            "PATH": f"{tmp_path / 'bin'}:/usr/bin:/bin",
            "HOME": str(tmp_path),
            "MISSING": missing,
        }
        return subprocess.run(
            ".ci/setup", cwd=tmp_path, env=environment, capture_output=True, text=True
        )

    return run


def test_setup_keeps_the_environment_until_environment_txt_changes(run_setup, tmp_path):
    calls = tmp_path / "calls"
    assert run_setup().returncode == 0
    assert (
        calls.read_text().count("-m venv") == 1
        and "-r environment.txt" in calls.read_text()
    )
    calls.write_text("")
    assert run_setup().returncode == 0
    assert "venv" not in calls.read_text() and "pip" not in calls.read_text()
    with open(tmp_path / "environment.txt", "a") as file:
        file.write("# changed\n")
    run_setup()
    assert calls.read_text().count("-m venv") == 1


OLD = 'case "$*" in *version_info*) exit 1 ;; -V) echo Python 3.9.2 ;; esac'
NO_VENV = 'case "$*" in *ensurepip*) exit 1 ;; *python%d*) echo python3.12-venv ;; esac'
PIP_SAYS = f"""{FAKE_PYTHON}
case "$*" in *environment.txt*) echo "%s" >&2; exit 1 ;; esac"""
OFFLINE = "WARNING: connection broken by 'NewConnectionError'\nERROR: No matching distribution found for numba"
TOLD = {
    "offline": (
        {"python3": PIP_SAYS % OFFLINE},
        1,
        "packages cannot be fetched: is there a network? Connect",
    ),
    "pip fails": (
        {"python3": PIP_SAYS % "ERROR: numba needs another Python"},
        1,
        "numba needs another Python",
    ),
    "read-only": (
        {"touch": "exit 1"},
        1,
        "{} cannot be written: copy the repository to a folder",
    ),
    "old python": (
        {"python3": OLD},
        1,
        "Python 3.11 or newer is needed, Python 3.9.2 was found",
    ),
    "no venv": (
        {"python3": NO_VENV, "id": "echo 1000"},
        1,
        "sudo apt-get install -y python3.12-venv",
    ),
    "no libraries": (
        {"missing": "libusb-1.0-0", "id": "echo 1000"},
        0,
        "sudo apt-get install -y libusb-1.0-0",
    ),
}


@pytest.mark.parametrize("case", TOLD)
def test_setup_says_what_to_do(run_setup, tmp_path, case):
    commands, status, words = TOLD[case]
    done = run_setup(**commands)
    assert done.returncode == status and words.format(tmp_path) in done.stderr
    assert status == 0 or not (tmp_path / ".venv").exists()
    assert case != "offline" or "numba" not in done.stderr
