"""The promises of the top-level files."""

import os
import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TOP_LEVEL = {
    "notebooks", "lrfcal_lib", "data", "tests", "reports", "environment.txt", "README.md", "LICENSE", "CITATION.cff",
    "Makefile", "pyproject.toml", ".ci", ".gitignore", ".gitattributes",
}  # fmt: skip


def requirements():
    lines = [line.split("#")[0].strip() for line in (ROOT / "environment.txt").read_text().splitlines()]
    return [line for line in lines if line]


def git(*arguments):
    return subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True)


def normal(name):
    return re.sub(r"[-_.]+", "-", name).lower()


def test_every_package_is_pinned_exactly_and_once():
    names = []
    for line in requirements():
        pin = re.fullmatch(r"([A-Za-z0-9._-]+)==\d[\w.]*", line)
        assert pin, f"'{line}' is no exact pin"
        names.append(normal(pin[1]))
    assert len(names) == len(set(names)) and len(names) > 100


def test_direct_packages_say_why():
    direct = (ROOT / "environment.txt").read_text().split("# What those need in turn")[0]
    lines = [line for line in direct.splitlines() if "==" in line]
    assert len(lines) >= 15
    assert all(re.search(r"==\S+\s+# \w+$", line) for line in lines)


def test_what_the_package_needs_is_pinned():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    needs = project["project"]["dependencies"] + sum(project["project"]["optional-dependencies"].values(), [])
    needs += project["build-system"]["requires"]
    pinned = {normal(line.split("==")[0]) for line in requirements()}
    assert {normal(re.match(r"[\w.-]+", need)[0]) for need in needs} <= pinned


def test_pins_are_what_runs_here():
    from importlib.metadata import version

    pins = dict(line.split("==") for line in requirements())
    for name in ("numpy", "scipy", "opencv-python-headless", "pandas", "matplotlib", "nbval", "pytest"):
        assert version(name) == pins[name]


def test_quick_start_is_exactly_two_commands():
    section = (ROOT / "README.md").read_text().split("## Quick start")[1].split("\n## ")[0]
    (block,) = re.findall(r"```sh\n(.*?)```", section, re.S)
    assert block.split("\n") == ["make report", "make test", ""]


def test_readme_lists_every_notebook_and_every_method():
    from lrfcal_lib.solvers import METHODS

    text = (ROOT / "README.md").read_text()
    for path in (ROOT / "notebooks").glob("*.ipynb"):
        assert f"(notebooks/{path.name})" in text
    for method in METHODS:
        assert f"| `{method}` |" in text


def test_files_the_readme_points_to_exist():
    text = (ROOT / "README.md").read_text()
    for target in re.findall(r"\]\(([^)#:]+)\)", text):
        assert (ROOT / target).is_file(), target


def test_ci_runs_make_test_and_nothing_else():
    script = ROOT / ".ci" / "run"
    lines = [line for line in script.read_text().splitlines() if line and not line.startswith(("#", "set ", "cd "))]
    assert lines == ["make test"]
    assert os.access(script, os.X_OK)


def test_nothing_else_lies_at_the_top():
    done = git("ls-files", "-co", "--exclude-standard")
    if done.returncode:
        pytest.skip("no git checkout")
    assert {line.split("/")[0] for line in done.stdout.splitlines()} <= TOP_LEVEL


def test_reports_and_recordings_are_ignored_by_git():
    ignored = ["reports/x/index.html", "reports/.sessions/x/session.json", ".venv/x"]
    done = git("check-ignore", "--no-index", *ignored, "reports/README.md", "reports/readme.png")
    if done.returncode > 1:
        pytest.skip("no git checkout")
    assert done.stdout.split() == ignored


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
            write_command(tmp_path / "bin" / name.replace("_", "-"), script)
        environment = {"PATH": f"{tmp_path / 'bin'}:/usr/bin:/bin", "HOME": str(tmp_path), "MISSING": missing}
        return subprocess.run([".ci/setup"], cwd=tmp_path, env=environment, capture_output=True, text=True)

    return run


def test_setup_keeps_the_environment_until_environment_txt_changes(run_setup, tmp_path):
    calls = tmp_path / "calls"
    assert run_setup().returncode == 0
    assert calls.read_text().count("-m venv") == 1 and "-r environment.txt" in calls.read_text()
    calls.write_text("")
    assert run_setup().returncode == 0
    assert "venv" not in calls.read_text() and "pip" not in calls.read_text()
    with open(tmp_path / "environment.txt", "a") as file:
        file.write("# changed\n")
    run_setup()
    assert calls.read_text().count("-m venv") == 1


OLD = 'case "$*" in *version_info*) exit 1 ;; -V) echo Python 3.9.2 ;; esac'
NO_VENV = 'case "$*" in *ensurepip*) exit 1 ;; *python%d*) echo python3.12-venv ;; esac'
TOLD = {
    "read-only": ({"touch": "exit 1"}, 1, "{} cannot be written: copy the repository to a folder"),
    "old python": ({"python3": OLD}, 1, "Python 3.11 or newer is needed, Python 3.9.2 was found"),
    "no venv": ({"python3": NO_VENV, "id": "echo 1000"}, 1, "sudo apt-get install -y python3.12-venv"),
    "no libraries": ({"missing": "libusb-1.0-0", "id": "echo 1000"}, 0, "sudo apt-get install -y libusb-1.0-0"),
}


@pytest.mark.parametrize("case", TOLD)
def test_setup_says_what_to_do(run_setup, tmp_path, case):
    commands, status, words = TOLD[case]
    done = run_setup(**commands)
    assert done.returncode == status and words.format(tmp_path) in done.stderr
    assert status == 0 or not (tmp_path / ".venv").exists()


def test_setup_that_failed_is_done_again(run_setup, tmp_path):
    assert run_setup(python3=FAKE_PYTHON + 'case "$*" in *pip*) exit 3 ;; esac').returncode != 0
    assert not (tmp_path / ".venv" / "stamp").exists()


def test_setup_installs_missing_libraries_as_root(run_setup, tmp_path):
    assert run_setup("libusb-1.0-0", id="echo 0", apt_get='echo "apt-get $*" >>calls').returncode == 0
    assert re.search(r"apt-get install .*libusb-1.0-0", (tmp_path / "calls").read_text())


def lab(tmp_path, uid, *arguments):
    """What `make lab` calls, with a set-up and a JupyterLab that only tell."""
    write_command(tmp_path / ".ci" / "setup", "")
    write_command(tmp_path / ".venv" / "bin" / "jupyter", 'echo "$* LRFCAL_SESSION=$LRFCAL_SESSION"')
    write_command(tmp_path / "bin" / "id", f"echo {uid}")
    (tmp_path / "notebooks").mkdir(exist_ok=True)
    shutil.copy(ROOT / "Makefile", tmp_path)
    environment = {"PATH": f"{tmp_path / 'bin'}:/usr/bin:/bin", "HOME": str(tmp_path)}
    call = ["make", "-s", "lab", *arguments]
    return subprocess.run(call, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True).stdout


@pytest.mark.parametrize("name", ["plain", "a b", "it's $HOME; \"x\""])
def test_the_lab_opens_any_session_and_as_root(tmp_path, name):
    (tmp_path / name).mkdir()
    said = lab(tmp_path, 0, "SESSION=" + name.replace("$", "$$"))
    assert said.strip().endswith(f"LRFCAL_SESSION={tmp_path.resolve() / name}") and "--allow-root" in said
    assert "--allow-root" not in lab(tmp_path, 1000) and lab(tmp_path, 1000).strip().endswith("LRFCAL_SESSION=")
