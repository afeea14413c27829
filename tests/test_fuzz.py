"""Some of the cases of ``make fuzz``: whatever is damaged, only our own errors come out, within bounds."""

import subprocess
import sys

import fuzz


def test_damaged_sessions_and_rig_files(tmp_path):
    """In a process of its own: memory is bounded, and what this one holds is none of theirs."""
    out = tmp_path / "findings.jsonl"
    subprocess.run([sys.executable, fuzz.__file__, "--cases", "250", "--workers", "1", "--out", str(out)], check=False)
    assert out.read_text() == ""
