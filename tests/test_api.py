"""What everyone types: functions in one place, a command, help and representations of a readable length."""

import importlib
import pydoc
import re
import tomllib
from types import SimpleNamespace

import pytest
from shared import QUICK, ROOT

from lrfcal_lib import __main__ as command_line
from lrfcal_lib import api
from lrfcal_lib.session.read import open_session
from lrfcal_lib.session.stated import CameraInfo, LrfInfo, from_json


def test_the_functions_of_the_methods_page_are_there():
    page = (ROOT / "notebooks" / "METHODS.md").read_text()
    names = re.findall(r"^\| `([a-z_.]+)\.([a-z_]+)\(", page, re.M)
    assert len(names) == 10
    for module, function in names:
        own = getattr(importlib.import_module(f"lrfcal_lib.{module}"), function)
        assert getattr(api, function) is own and function in api.__all__


def test_the_command_is_the_one_of_the_module():
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    module, function = scripts["lrfcal"].split(":")
    assert getattr(importlib.import_module(module), function) is command_line.program


def test_a_process_of_its_own_ends_as_the_verb_does(monkeypatch):
    done = []
    collector = SimpleNamespace(
        set_threshold=done.append, freeze=lambda: done.append("all")
    )
    monkeypatch.setattr(command_line, "gc", collector)
    monkeypatch.setattr(command_line, "main", lambda: 3)
    with pytest.raises(SystemExit) as ended:
        command_line.program()
    assert ended.value.code == 3 and done == [command_line.MADE_BETWEEN_SEARCHES, "all"]


def test_a_session_is_one_line():
    shown = repr(open_session(QUICK))
    assert len(shown) < 150 and "sim_quick: 4 placements" in shown


@pytest.mark.parametrize("kind", [LrfInfo, CameraInfo])
def test_help_shows_plain_types_and_limits_still_hold(kind):
    words = pydoc.plain(pydoc.render_doc(kind)).split("Data and other attributes")[0]
    assert "Validator" not in words and "pydantic" not in words
    with pytest.raises(ValueError, match="is missing"):
        from_json(kind, {})
